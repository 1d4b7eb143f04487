"""MACE (mace-torch) in PyTorch.

The features are the invariants of each interaction layer: the 0e columns of `node_feats`, as MACE's own calculator
gives them with `get_descriptors(invariants_only=True)`, but as part of the graph. The model is a file of
`torch.save`, which runs code when it is read: take it only from those whom you trust.

Option: `head`, of a model with several.
"""

from __future__ import annotations

import os
import types
from pathlib import Path
from typing import Any, Optional

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

os.environ.setdefault("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # e3nn reads its constants with torch.load

import torch

if not hasattr(torch, "compiler"):  # torch before 2.1, as Debian 12 has it
    torch.compiler = types.SimpleNamespace(is_compiling=lambda: False)


class Mace:
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
        check_options(options, ["head"])
        path = model_path(model, "a MACE model, saved whole with torch.save")
        torch.set_num_threads(threads)
        self._device, self._type = torch.device(device), torch.float32 if precision == "single" else torch.float64
        torch.set_default_dtype(self._type)
        self._model = _load(path, self._device).to(self._type).eval()
        for parameter in self._model.parameters():
            parameter.requires_grad_(False)
        self._cutoff = float(self._model.r_max)
        self._head = _head(path, self._model, options.get("head"))
        columns, blocks = _invariant_columns(self._model)
        self._columns = torch.tensor(columns, device=self._device)
        self._passes = 0
        elements = _symbols(self._model.atomic_numbers.tolist())
        self.info = ModelInfo(
            elements=elements,
            cutoffs=same_cutoff(elements, self._cutoff),
            features=Features("raw", blocks),
            identity=identity([path], Mace, {"columns": columns, "head": self._head}),
            precision=precision,
            device=device,
            versions=_versions(),
        )

    def evaluate(self, batch: Batch, features: bool) -> Evaluation:
        graph, compiled = self._forward(batch), self._warming
        forces, virials = graph.backward([graph.energies], [torch.ones_like(graph.energies)], features)
        batch.kept = graph if features else None
        values = _numpy(graph.features) if features else None
        return Evaluation(_numpy(graph.energies), values, -forces, -virials, compiled)

    def evaluate_without_forces(self, batch: Batch) -> Energies:
        batch.kept = graph = self._forward(batch)
        return Energies(_numpy(graph.energies), _numpy(graph.features), self._warming)

    def pull_back(
        self, batch: Batch, feature_cotangents: np.ndarray, energy_cotangents: Optional[np.ndarray] = None
    ) -> Gradients:
        graph = batch.kept if batch.kept is not None else self._forward(batch)
        outputs, cotangents = [graph.features], [feature_cotangents]
        if energy_cotangents is not None:
            outputs.append(graph.energies)
            cotangents.append(energy_cotangents)
        tensors = [self._tensor(array, output.dtype) for array, output in zip(cotangents, outputs)]
        return Gradients(*graph.backward(outputs, tensors, keep=batch.kept is not None))

    @property
    def _warming(self) -> bool:
        """Whether the last forward pass was one of the first two, in which TorchScript optimises the code of e3nn."""
        return self._passes <= 2

    def _forward(self, batch: Batch) -> _Graph:
        """Positions are zero and the bonds are MACE's shifts, so that no cell is needed and autograd gives
        ∂/∂(bond)."""
        self._passes += 1
        fixed = self._fixed(batch)
        bonds = self._tensor(batch.bonds, torch.float64)
        near = torch.nonzero(bonds.square().sum(1) < self._cutoff**2).squeeze(1)
        bonds = bonds[near].to(self._type).requires_grad_(True)
        ends = fixed["ends"][:, near]
        output = self._model(
            {**fixed["inputs"], "shifts": bonds, "unit_shifts": torch.zeros_like(bonds), "edge_index": ends},
            compute_force=False,
        )
        owners, features = fixed["owners"][near], output["node_feats"][:, self._columns]
        return _Graph(output["node_energy"], features, bonds, ends, owners, batch.n_structures)

    def _fixed(self, batch: Batch) -> dict[str, Any]:
        """What depends on the topology alone: MACE's inputs, and for each bond its ends and its structure."""
        if "mace" not in batch.fixed:
            atoms, count = batch.n_atoms, batch.n_structures
            structures = self._tensor(batch.structure_of_atom, torch.int64)
            sizes = torch.bincount(structures, minlength=count).cumsum(0)
            species = self._tensor(batch.species, torch.int64)
            inputs = {
                "positions": torch.zeros(atoms, 3, dtype=self._type, device=self._device),
                "cell": torch.zeros(3 * count, 3, dtype=self._type, device=self._device),
                "batch": structures,
                "ptr": torch.cat([torch.zeros(1, dtype=torch.int64, device=self._device), sizes]),
                "node_attrs": torch.nn.functional.one_hot(species, len(self.info.elements)).to(self._type),
                "head": torch.full((count,), self._head, dtype=torch.int64, device=self._device),
            }
            batch.fixed["mace"] = {
                "inputs": inputs,
                "ends": self._tensor(np.stack([batch.centres, batch.neighbours]), torch.int64),
                "owners": self._tensor(batch.structure_of_bond, torch.int64),
            }
        tensors: dict[str, Any] = batch.fixed["mace"]
        return tensors

    def _tensor(self, array: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
        """A copy on the device."""
        return torch.as_tensor(array).to(device=self._device, dtype=dtype, copy=True)


class _Graph:
    """What a forward pass leaves: energies [A], features [A, D], and the bonds [b, 3] on which they depend."""

    def __init__(
        self,
        energies: torch.Tensor,
        features: torch.Tensor,
        bonds: torch.Tensor,
        ends: torch.Tensor,
        owners: torch.Tensor,
        structures: int,
    ) -> None:
        self.energies, self.features = energies, features
        self._bonds, self._ends, self._owners, self._structures = bonds, ends, owners, structures

    def backward(
        self, outputs: list[torch.Tensor], cotangents: list[torch.Tensor], keep: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """+∂/∂r [A, 3] and +∂/∂ε [S, 3, 3] of Σ cotangents·outputs."""
        (slope,) = torch.autograd.grad(outputs, self._bonds, cotangents, retain_graph=keep, allow_unused=True)
        slope = torch.zeros_like(self._bonds) if slope is None else slope
        slope, bonds = slope.double(), self._bonds.detach().double()
        atoms = torch.zeros(len(self.energies), 3, dtype=slope.dtype, device=slope.device)
        atoms.index_add_(0, self._ends[1], slope).index_add_(0, self._ends[0], -slope)
        strain = torch.zeros(self._structures, 3, 3, dtype=slope.dtype, device=slope.device)
        strain.index_add_(0, self._owners, slope[:, :, None] * bonds[:, None, :])
        return _numpy(atoms), _numpy(strain)


def _load(path: Path, device: torch.device) -> Any:
    import mace.modules  # noqa: F401  - a missing package is named before the model is read

    try:
        model = torch.load(path, map_location=device)
    except (ModuleNotFoundError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{path}: torch cannot read it ({type(error).__name__}: {error})") from error
    missing = [name for name in ("r_max", "atomic_numbers", "products", "readouts") if not hasattr(model, name)]
    if missing:
        raise InputError(f"{path}: a {type(model).__name__} without {missing[0]}, expected a MACE model")
    return model


def _head(path: Path, model: Any, name: Optional[str]) -> int:
    """Index of the head; that called Default if none is named."""
    heads = list(getattr(model, "heads", None) or ["Default"])
    if name is None:
        name = heads[0] if len(heads) == 1 else next((h for h in heads if h.lower() == "default"), None)
    if name not in heads:
        raise InputError(f"{path}: the option 'head' is {name!r}, expected one of {heads}")
    return heads.index(name)


def _invariant_columns(model: Any) -> tuple[list[int], list[int]]:
    """The 0e columns of `node_feats`, and how many each layer has."""
    columns: list[int] = []
    blocks, start = [], 0
    for product in model.products:
        irreps, before = product.linear.irreps_out, len(columns)
        for part, irrep in zip(irreps.slices(), irreps):
            if (irrep.ir.l, irrep.ir.p) == (0, 1):
                columns.extend(range(start + part.start, start + part.stop))
        blocks.append(len(columns) - before)
        start += irreps.dim
    return columns, blocks


def _symbols(numbers: list[int]) -> list[str]:
    from ase.data import chemical_symbols

    return [chemical_symbols[number] for number in numbers]


def _versions() -> dict[str, str]:
    import e3nn
    import mace

    return {"torch": torch.__version__, "mace": mace.__version__, "e3nn": e3nn.__version__}


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64)
