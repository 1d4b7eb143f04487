"""GRACE models of gracemaker (tensorpotential 0.6.2) in TensorFlow, from a checkpoint.

The model is a folder with `model.yaml` and a checkpoint. With the option `artifact`, the file `gmm_artifacts.npz` of
`grace_uq build`, the features are the final ones, projected with the artifact's matrix; without it they are the
invariants of the basis, block by block.

Options: `artifact`; `checkpoint`, the name of a checkpoint in the folder ("checkpoint" if not given).

XLA compiles each function anew for each number of atoms, bonds and structures, which takes seconds to a minute:
batches must be padded to few shapes. Compiled code is kept in the folder `cache`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Callable, Optional

import numpy as np

from ..adapter import (
    Energies,
    Evaluation,
    Features,
    Gradients,
    ModelInfo,
    check_options,
    identity,
    model_path,
    same_cutoff,
)
from ..batch import Batch
from ..errors import InputError

# Shapes of the inputs: A atoms, B bonds, S structures.
_INPUTS = ("species", "structure_of_atom", "centres", "neighbours", "structure_of_bond", "bonds", "structures")


class Gracemaker:
    """The adapter."""

    def __init__(
        self,
        model: Optional[Path],
        options: dict[str, Any],
        device: str = "cpu",
        precision: str = "double",
        threads: int = 1,
        cache: Optional[Path] = None,
    ) -> None:
        check_options(options, ["artifact", "checkpoint"])
        folder = model_path(model, "a folder with model.yaml and a checkpoint of gracemaker")
        yaml, checkpoint = _files(folder, options.get("checkpoint"))
        artifact = None if options.get("artifact") is None else Path(options["artifact"])
        spec = None if artifact is None else read_projection(artifact)
        self._tf = tf = _framework(threads, cache)
        self._device = _tensorflow_device(tf, device)
        with tf.device(self._device):
            self._graph = _Graph(tf, yaml, checkpoint, spec, tf.float32 if precision == "single" else tf.float64)
        self._evaluate, self._evaluate_without_forces, self._pull_back = self._graph.functions()
        self._shapes: set[tuple[str, int, int, int]] = set()
        elements, cutoffs = self._graph.elements_and_cutoffs()
        blocks = self._graph.blocks()
        data = [Path(f"{checkpoint}.index"), *sorted(folder.glob(f"{checkpoint.name}.data-*")), yaml]
        self.info = ModelInfo(
            elements=elements,
            cutoffs=cutoffs,
            features=Features("raw", blocks) if spec is None else Features("final", [_final_columns(spec, blocks)]),
            identity=identity(data, Gracemaker, _definition(spec)),
            precision=precision,
            device=device,
            padding=True,
            versions=_versions(),
            projection=None if spec is None else describe_projection(spec, blocks),
        )

    def evaluate(self, batch: Batch, features: bool) -> Evaluation:
        compiled = self._is_new("evaluate", batch)
        with self._tf.device(self._device):
            energies, values, forces, virials = self._evaluate(*self._tensors(batch))
        values = values.numpy() if features else None
        return Evaluation(energies.numpy(), values, forces.numpy(), virials.numpy(), compiled)

    def evaluate_without_forces(self, batch: Batch) -> Energies:
        compiled = self._is_new("evaluate_without_forces", batch)
        with self._tf.device(self._device):
            energies, values = self._evaluate_without_forces(*self._tensors(batch))
        return Energies(energies.numpy(), values.numpy(), compiled)

    def pull_back(
        self, batch: Batch, feature_cotangents: np.ndarray, energy_cotangents: Optional[np.ndarray] = None
    ) -> Gradients:
        compiled = self._is_new("pull_back", batch)
        if energy_cotangents is None:
            energy_cotangents = np.zeros(batch.n_atoms)
        with self._tf.device(self._device):
            cotangents = [
                self._tf.constant(array, self._tf.float64) for array in (energy_cotangents, feature_cotangents)
            ]
            gradients, strain = self._pull_back(*self._tensors(batch), *cotangents)
        return Gradients(gradients.numpy(), strain.numpy(), compiled)

    def _tensors(self, batch: Batch) -> list[Any]:
        """The inputs in the order of _INPUTS. Those of the topology stay on the device as long as it is the same."""
        tf = self._tf
        if "tensors" not in batch.fixed:
            arrays = {name: tf.constant(getattr(batch, name), tf.int32) for name in _INPUTS if hasattr(batch, name)}
            batch.fixed["tensors"] = {**arrays, "structures": tf.zeros(batch.n_structures, tf.int32)}
        tensors = {**batch.fixed["tensors"], "bonds": tf.constant(batch.bonds, tf.float64)}
        return [tensors[name] for name in _INPUTS]

    def _is_new(self, call: str, batch: Batch) -> bool:
        shape = (call, batch.n_structures, batch.n_atoms, batch.n_bonds)
        new = shape not in self._shapes
        self._shapes.add(shape)
        return new


class _Graph:
    """The instructions of a model with its weights, and the functions that run them."""

    def __init__(self, tf: Any, yaml: Path, checkpoint: Path, spec: Optional[Mapping[str, Any]], dtype: Any) -> None:
        self._tf, self._final = tf, spec is not None
        factories = importlib.import_module("tensorpotential.uq.factories")
        self._model = importlib.import_module("tensorpotential.tpmodel")
        self._names = importlib.import_module("tensorpotential.constants")
        self._features_name = importlib.import_module("tensorpotential.uq.constants").FEATURES
        self._instructions = _load(tf, factories, str(yaml), str(checkpoint), spec, dtype)
        self._reduces = factories.trace_energy_path_invariant_reduces(self._instructions)

    def elements_and_cutoffs(self) -> tuple[list[str], np.ndarray]:
        """Symbols in the model's order, and cutoffs by pair, Å."""
        cutoff, symbols, index = self._model.extract_cutoff_and_elements(self._instructions)
        by_index = {int(i): _text(symbol) for i, symbol in zip(np.asarray(index), np.asarray(symbols))}
        elements = [by_index[i] for i in range(len(by_index))]
        matrix = self._model.extract_cutoff_matrix(self._instructions)
        return elements, same_cutoff(elements, cutoff) if matrix is None else np.asarray(matrix, dtype=float)

    def blocks(self) -> list[int]:
        """Columns of the basis of each layer."""
        return [sum(_columns(reduce, source) for source in reduce.instructions) for reduce in self._reduces]

    def functions(self) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
        """Compiled functions of the inputs: energies, features, forces, virials; energies and features; and, with
        cotangents of energies and features, gradients by position and strain."""
        tf = self._tf
        signature = [self._input(name) for name in _INPUTS]
        cotangents = [tf.TensorSpec([None], tf.float64), tf.TensorSpec([None, None], tf.float64)]

        def evaluate(*inputs: Any) -> Any:
            data = dict(zip(_INPUTS, inputs))
            with tf.GradientTape() as tape:
                tape.watch(data["bonds"])
                energies, features = self._run(data)
            gradients, strain = self._scatter(data, tape.gradient(energies, data["bonds"]))
            return energies, features, -gradients, -strain

        def evaluate_without_forces(*inputs: Any) -> Any:
            return tuple(self._run(dict(zip(_INPUTS, inputs))))

        def pull_back(*inputs: Any) -> Any:
            data = dict(zip(_INPUTS, inputs))
            with tf.GradientTape() as tape:
                tape.watch(data["bonds"])
                outputs = self._run(data)
            return self._scatter(data, tape.gradient(outputs, data["bonds"], output_gradients=list(inputs[-2:])))

        return (
            tf.function(evaluate, input_signature=signature, jit_compile=True),
            tf.function(evaluate_without_forces, input_signature=signature, jit_compile=True),
            tf.function(pull_back, input_signature=signature + cotangents, jit_compile=True),
        )

    def _input(self, name: str) -> Any:
        tf = self._tf
        return tf.TensorSpec([None, 3], tf.float64) if name == "bonds" else tf.TensorSpec([None], tf.int32)

    def _run(self, inputs: Mapping[str, Any]) -> list[Any]:
        """Energies [A] and features [A, D]."""
        tf, names = self._tf, self._names
        species, atoms = inputs["species"], tf.shape(inputs["species"])[0]
        data = {
            names.BOND_IND_I: inputs["centres"],
            names.BOND_IND_J: inputs["neighbours"],
            names.BOND_MU_I: tf.gather(species, inputs["centres"]),
            names.BOND_MU_J: tf.gather(species, inputs["neighbours"]),
            names.BOND_VECTOR: inputs["bonds"],
            names.ATOMIC_MU_I: species,
            names.ATOMS_TO_STRUCTURE_MAP: inputs["structure_of_atom"],
            names.BONDS_TO_STRUCTURE_MAP: inputs["structure_of_bond"],
            # Spare atoms count as real: else XLA would compile anew for each number of real ones.
            names.N_ATOMS_BATCH_REAL: atoms,
            names.N_ATOMS_BATCH_TOTAL: atoms,
            names.N_STRUCTURES_BATCH_TOTAL: tf.shape(inputs["structures"])[0],
        }
        self._model.execute_instructions(data, self._instructions, training=False)
        energies = tf.reshape(tf.cast(data[names.PREDICT_ATOMIC_ENERGY], tf.float64), [-1])
        if self._final:
            return [energies, tf.cast(data[self._features_name], tf.float64)]
        basis = [self._model.extract_basis_functions(reduce, data) for reduce in self._reduces]
        return [energies, tf.cast(tf.concat(basis, axis=-1), tf.float64)]

    def _scatter(self, inputs: Mapping[str, Any], slope: Any) -> tuple[Any, Any]:
        """As `calmwalk.scatter`, on the device."""
        tf = self._tf
        atoms, structures = tf.shape(inputs["species"])[0], tf.shape(inputs["structures"])[0]
        sums = tf.math.unsorted_segment_sum
        gradients = sums(slope, inputs["neighbours"], atoms) - sums(slope, inputs["centres"], atoms)
        products = slope[:, :, None] * inputs["bonds"][:, None, :]
        return gradients, sums(products, inputs["structure_of_bond"], structures)


def read_projection(artifact: Path) -> dict[str, Any]:
    """The `uq_rp_*` keys of an artifact, as `load_uq_model` takes them. InputError names the file and the key."""
    model_path(artifact, "a file gmm_artifacts.npz of grace_uq build")
    try:
        arrays = np.load(artifact, allow_pickle=False)
        keys = {key: arrays[key] for key in arrays.files if key.startswith("uq_")}
    except (OSError, ValueError) as error:
        raise InputError(f"{artifact}: not an .npz file ({error})") from None
    if "uq_rp_matrix" not in keys:
        raise InputError(f"{artifact}: has no 'uq_rp_matrix', expected an artifact of grace_uq build")
    scalar = {key: value.item() for key, value in keys.items() if value.size == 1}
    transform = scalar.get("uq_feature_transform")
    return {
        "matrix": keys["uq_rp_matrix"],
        "out_dim": int(keys["uq_rp_matrix"].shape[1]),
        "seed": int(scalar.get("uq_rp_seed", 42)),
        "transform": None if transform in (None, "", "none", "linear") else str(transform),
        "normalize": bool(scalar.get("uq_rp_normalize", False)),
        "add_density_channel": bool(scalar.get("uq_rp_add_density_channel", False)),
        "density_scale": float(scalar.get("uq_rp_density_scale", 1.0)),
    }


def describe_projection(spec: Mapping[str, Any], blocks: list[int]) -> dict[str, Any]:
    """What hello says about the map from the basis to the features."""
    rows, columns = spec["matrix"].shape
    return {
        "matrix": spec["matrix"].astype(float).ravel().tolist(),
        "rows": rows,
        "columns": columns,
        "normalised": spec["normalize"],
        "density_channels": _final_columns(spec, blocks) - columns,
        "density_scale": spec["density_scale"],
        "asinh": spec["transform"] == "asinh",
    }


def _final_columns(spec: Mapping[str, Any], blocks: list[int]) -> int:
    if spec["matrix"].shape[0] != sum(blocks):
        raise InputError(
            f"the artifact's projection has {spec['matrix'].shape[0]} rows, the model's basis {sum(blocks)}"
        )
    return int(spec["matrix"].shape[1]) + (1 + len(blocks) if spec["add_density_channel"] else 0)


def _definition(spec: Optional[Mapping[str, Any]]) -> Any:
    if spec is None:
        return "basis"
    return {key: value.tolist() if key == "matrix" else value for key, value in spec.items()}


def _files(folder: Path, name: Optional[str]) -> tuple[Path, Path]:
    """model.yaml and the prefix of the checkpoint's files."""
    found = sorted(file.stem for file in folder.glob("*.index"))
    name = name or ("checkpoint" if "checkpoint" in found or len(found) != 1 else found[0])
    if not (folder / "model.yaml").is_file():
        raise InputError(
            f"{folder} has no model.yaml; expected a folder with model.yaml and a checkpoint of gracemaker"
        )
    if name not in found:
        raise InputError(f"{folder} has no checkpoint '{name}'; found {found}")
    return folder / "model.yaml", folder / name


def _framework(threads: int, cache: Optional[Path]) -> Any:
    """TensorFlow, after the variables that it reads when it is imported. tensorpotential comes first, since it sets
    some."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if cache is not None:
        cache.mkdir(parents=True, exist_ok=True)
        flags = f"{os.environ.get('TF_XLA_FLAGS', '')} --tf_xla_persistent_cache_directory={cache}"
        os.environ["TF_XLA_FLAGS"] = flags.strip()
    importlib.import_module("tensorpotential")
    tf = importlib.import_module("tensorflow")
    try:
        tf.config.threading.set_intra_op_parallelism_threads(threads)
        tf.config.threading.set_inter_op_parallelism_threads(1)
    except RuntimeError:  # a second adapter in one process: the first one has set them
        pass
    return tf


def _tensorflow_device(tf: Any, device: str) -> str:
    if device == "cpu":
        return "/CPU:0"
    number = int(device.partition(":")[2] or 0)
    cards = tf.config.list_physical_devices("GPU")
    if number >= len(cards):
        raise InputError(f"the device is '{device}', but TensorFlow finds {len(cards)} GPUs")
    tf.config.experimental.set_memory_growth(cards[number], True)
    return f"/GPU:{number}"


def _load(tf: Any, factories: Any, yaml: str, checkpoint: str, spec: Optional[Mapping[str, Any]], dtype: Any) -> Any:
    """The instructions of a model, with weights of a type."""
    own = importlib.import_module("tensorpotential.metadata_utils").resolve_param_dtype(yaml)
    # Without an artifact, features are read before the projection, so that a narrow one will do.
    feature_spec = dict(spec) if spec is not None else {"out_dim": 1}
    try:
        potential, instructions = factories.load_uq_model(yaml, checkpoint, _no_compute_function(), own, feature_spec)
    except (AssertionError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{checkpoint}: tensorpotential cannot read it ({type(error).__name__}: {error})") from error
    if own != dtype:
        potential, instructions = _cast(tf, factories, potential, yaml, feature_spec, dtype)
    for instruction in instructions.values() if isinstance(instructions, dict) else instructions:
        if getattr(instruction, "dense_nbr", False):  # would need as many bonds at each atom
            instruction.dense_nbr = False
    return instructions


def _cast(tf: Any, factories: Any, source: Any, yaml: str, feature_spec: dict[str, Any], dtype: Any) -> tuple[Any, Any]:
    """The same model with weights of another type."""
    base = importlib.import_module("tensorpotential.instructions.base")
    tensorpot = importlib.import_module("tensorpotential.tensorpot")
    instructions = base.load_instructions(yaml)
    keywords = {"matrix": "projection_matrix", "transform": "feature_transform"}
    options = {keywords.get(key, key): value for key, value in feature_spec.items()}
    factories.patch_instructions_for_basis_rp_features(instructions, **options)
    potential = tensorpot.TensorPotential(
        potential=instructions, model_compute_function=_no_compute_function(), param_dtype=dtype
    )
    for new, old in zip(potential.model.variables, source.model.variables):
        new.assign(tf.cast(old, new.dtype))
    return potential, instructions


def _no_compute_function() -> Any:
    """TensorPotential wants a compute function. Ours run the instructions themselves."""
    base = importlib.import_module("tensorpotential.tpmodel").ComputeFunction
    return type("NoComputeFunction", (base,), {"__call__": lambda *_, **__: None})()


def _columns(reduce: Any, source: Any) -> int:
    """Columns of one source of a reduce."""
    collected = reduce.collector[source.name]
    return int(collected["n_out"]) * len(collected["func_collect_ind"])


def _text(symbol: Any) -> str:
    return symbol.decode() if isinstance(symbol, bytes) else str(symbol)


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    tensorflow = importlib.import_module("tensorflow")
    return {"tensorflow": tensorflow.__version__, "tensorpotential": version("tensorpotential")}
