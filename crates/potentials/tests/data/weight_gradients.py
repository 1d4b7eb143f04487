"""TensorFlow's derivatives of a loss with respect to the weights of two GRACE models, for the tests of `grace::training`.

    python weight_gradients.py MODEL WORK

Needs ASE and gracemaker (tensorpotential 0.6.2.1), whose programs are beside the Python. MODEL holds `model.yaml` and `checkpoint`
of `configs/data/al_eam_1l`. In WORK, gracemaker trains a small two-layer model for aluminium and nickel for a few epochs, unless
it stands there already; its energies mean little. Writes beside this file

    two_layers_trained.npz                     the export of that model
    weight_gradients_al_eam_1l.npz             and
    weight_gradients_two_layers_trained.npz    a loss and its derivatives

The loss of a structure of n atoms with energy E, forces F and virial W = −dE/dstrain (eV, symmetric) is

    L = a E + Σ F_bar·F + Σ W_bar W + E² / 4n + ½ Σ F² + Σ W² / 4n

with random numbers a, F_bar, W_bar. The file has them, the structure (numbers; positions and rows of the cell in Å; pbc), loss,
energy, forces, virial [3, 3], and `gradient_NAME` for each trained array NAME of the export, under all its names and in its shape.
Everything is in double precision, without XLA.
"""

import os
import subprocess
import sys
from pathlib import Path

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

import numpy as np
import tensorpotential  # sets variables of TensorFlow
import tensorflow as tf
import yaml
from ase import Atoms
from ase.io import read, write
from tensorpotential.calculator import TPCalculator
from tensorpotential.cli.prepare import construct_model
from tensorpotential.data.databuilder import GeometricalDataBuilder
from tensorpotential.instructions.base import load_instructions, save_instructions_dict
from tensorpotential.tensorpot import TensorPotential
from tensorpotential.tpmodel import execute_instructions

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[3] / "configs" / "data"

ELEMENTS = {"Al": 0, "Ni": 1}
CUTOFF = 4.5  # Å, of the two-layer model
PRESET = dict(lmax=[2, 2], indicator_lmax=1, n_rad_max=[4, 3], prod_func_n_max=[4, 3], n_mlp_dens=5, n_rad_base=5, embedding_size=6)
# Where the preset has constants: units of each hidden layer, 64, and channels of I1, 12.
HIDDEN, CHANNELS = 12, 5

INPUT = """
seed: 1
cutoff: {cutoff}
data: {{ filename: frames.extxyz, reference_energy: 0 }}
potential: {{ filename: untrained.yaml, param_dtype: float64 }}
fit:
  loss: {{ energy: {{ type: huber, weight: 20, delta: 0.01 }}, forces: {{ type: huber, weight: 5, delta: 0.01 }} }}
  optimizer: Adam
  opt_params: {{ learning_rate: 0.01, amsgrad: True }}
  scheduler: cosine_decay
  scheduler_params: {{ minimum_learning_rate: 0.001 }}
  maxiter: 10
  checkpoint_freq: 1
  batch_size: 2
  progressbar: False
  train_shuffle: True
  jit_compile: False
"""


def gracemaker(name, *words, where):
    """Runs one of its programs in a directory; the output stands in `log.txt` there."""
    with open(where / "log.txt", "a") as log:
        command = [str(Path(sys.executable).parent / name), *map(str, words)]
        if subprocess.run(command, cwd=where, stdout=log, stderr=log).returncode:
            sys.exit(f"{name} failed: see {where / 'log.txt'}")


def train_two_layers(work):
    """Trains the two-layer model. Returns the folder with `model.yaml` and the path of the checkpoint."""
    folder = work / "seed" / "1"
    if not (work / "trained").exists():
        work.mkdir(parents=True, exist_ok=True)
        frames = read(DATA / "ni_al_h_eam_1l" / "seed_frames.extxyz", ":")
        write(work / "frames.extxyz", [atoms for atoms in frames if set(atoms.symbols) <= set(ELEMENTS)][::3])
        config = {"preset": "GRACE_2LAYER_latest", "kwargs": dict(PRESET)}
        statistics = dict(avg_n_neigh=40.0, constant_out_scale=0.5, atomic_shift_map={0: -3.4, 1: -4.4})
        instructions, _ = construct_model(config, ELEMENTS, rcut=CUTOFF, **statistics)
        path = work / "untrained.yaml"
        save_instructions_dict(str(path), instructions, param_dtype="float64")
        model = yaml.safe_load(path.read_text())
        for instruction in model["instructions"].values():
            if instruction.get("hidden_layers"):
                instruction["hidden_layers"] = [HIDDEN for _ in instruction["hidden_layers"]]
        model["instructions"]["I1"]["n_out"] = CHANNELS
        path.write_text(yaml.safe_dump(model, sort_keys=False))
        (work / "input.yaml").write_text(INPUT.format(cutoff=CUTOFF))
        gracemaker("gracemaker", "input.yaml", where=work)
        (work / "trained").touch()
    return folder / "model.yaml", folder / "checkpoints" / "checkpoint"


def export(model, checkpoint, work):
    """Writes two_layers_trained.npz."""
    gracemaker("grace_utils", "-p", model, "-c", checkpoint, "export_kokkos", "-o", work / "kokkos.npz", where=work)
    np.savez_compressed(HERE / "two_layers_trained.npz", **np.load(work / "kokkos.npz"))


def load(model, checkpoint):
    potential = TensorPotential(load_instructions(str(model)), param_dtype=tf.float64, eager_mode=True, jit_compile=False)
    potential.load_checkpoint(str(checkpoint), model_only=True, expect_partial=True)
    return potential.model


def rattled(symbols, sites, cell, seed):
    """Atoms at fractional sites, moved by up to 0.15 Å along each axis, so that no force vanishes."""
    atoms = Atoms(symbols, scaled_positions=sites, cell=cell, pbc=True)
    atoms.positions += np.random.default_rng(seed).uniform(-0.15, 0.15, atoms.positions.shape)
    return atoms


FCC = [[0, 0, 0], [0, 1 / 2, 1 / 2], [1 / 2, 0, 1 / 2], [1 / 2, 1 / 2, 0]]
BCC = [[k / 2, k / 2, k / 6] for k in range(6)]


def batch(atoms, elements, cutoff):
    """The bonds, as the instructions read them."""
    builder = GeometricalDataBuilder(elements, cutoff=cutoff)
    arrays = builder.join_to_batch([builder.extract_from_ase_atoms(atoms.copy())])
    return {key: tf.constant(value) for key, value in arrays.items()}


def evaluate(model, inputs):
    """Energy, forces and virial, inside or outside of a tape."""
    bonds = inputs["bond_vector"]
    with tf.GradientTape() as tape:
        tape.watch(bonds)
        data = dict(inputs)
        execute_instructions(data, model.instructions)
        energy = tf.reduce_sum(data["atomic_energy"])
    slopes = tape.gradient(energy, bonds)
    n = inputs["atomic_mu_i"].shape[0]
    begin, end = (tf.math.unsorted_segment_sum(slopes, inputs[key], n) for key in ("ind_i", "ind_j"))
    return energy, begin - end, -tf.einsum("ka,kb->ab", slopes, bonds)


def loss_and_gradients(model, inputs, a, f_bar, w_bar):
    variables = model.trainable_variables
    n = len(f_bar)
    with tf.GradientTape() as tape:
        energy, forces, virial = evaluate(model, inputs)
        loss = a * energy + tf.reduce_sum(f_bar * forces) + tf.reduce_sum(w_bar * virial)
        loss += energy**2 / (4 * n) + tf.reduce_sum(forces**2) / 2 + tf.reduce_sum(virial**2) / (4 * n)
    gradients = [tf.convert_to_tensor(gradient).numpy() for gradient in tape.gradient(loss, variables)]
    results = dict(loss=loss, energy=energy, forces=forces, virial=virial)
    return {key: value.numpy() for key, value in results.items()}, list(zip(variables, gradients, strict=True))


def compare_with_calculator(model, atoms, found):
    """Checks signs and units with the ASE calculator."""
    model.decorate_compute_function(jit_compile=False)
    atoms = atoms.copy()
    atoms.calc = TPCalculator(model)
    virial = -atoms.get_stress(voigt=False) * atoms.get_volume()
    expected = dict(energy=atoms.get_potential_energy(), forces=atoms.get_forces(), virial=virial)
    for key, value in expected.items():
        np.testing.assert_allclose(found[key], value, rtol=0, atol=1e-10, err_msg=key)


def names(variable, exported):
    """The names of a variable's array in the export: it has the same values, in the same order."""
    values = variable.numpy().ravel()
    return [key for key, array in exported.items() if array.dtype == float and np.array_equal(array.ravel(), values)]


def by_name(gradients, exported):
    """The gradients by the arrays' names in the export."""
    found = {}
    for variable, gradient in gradients:
        if "atomic_shift" in variable.name:
            known = ["shift_values"]  # with the constants of the model
        else:
            known = names(variable, exported)
        if not known or any(key in found for key in known):
            sys.exit(f"{variable.name} {variable.shape} is {known or 'nothing'} in the export, expected an array of its own")
        found |= {key: gradient.reshape(exported[key].shape) for key in known}
    return found


def reference(name, model, exported, atoms, seed):
    """Writes the file of one model."""
    random = np.random.default_rng(seed)
    n = len(atoms)
    a, f_bar, w_bar = (random.uniform(-0.5, 0.5, shape) for shape in ((), (n, 3), (3, 3)))
    elements = {symbol.decode(): number for number, symbol in enumerate(exported["element_names"])}
    inputs = batch(atoms, elements, float(exported["rcut"][0]))
    results, gradients = loss_and_gradients(model, inputs, a, f_bar, w_bar)
    compare_with_calculator(model, atoms, results)
    gradients = by_name(gradients, exported)
    counts = np.bincount(inputs["atomic_mu_i"], minlength=len(elements))
    # The export adds these numbers to the energies of atoms without a factor.
    np.testing.assert_allclose(gradients["shift_values"], (a + results["energy"] / (2 * n)) * counts, rtol=1e-12)
    structure = dict(numbers=atoms.numbers.astype(np.int64), positions=atoms.positions, cell=atoms.cell.array, pbc=atoms.pbc)
    arrays = structure | dict(a=a, F_bar=f_bar, W_bar=w_bar) | results
    path = HERE / f"weight_gradients_{name}.npz"
    np.savez_compressed(path, **arrays, **{f"gradient_{key}": gradient for key, gradient in gradients.items()})
    print(f"{path.name}: {len(gradients)} arrays, loss {results['loss']:.6f}, energy {results['energy']:.6f} eV")
    for key, gradient in gradients.items():
        print(f"  {key} {gradient.shape}: largest {np.abs(gradient).max():.3g}")


def main():
    checkpoint, work = (Path(word).resolve() for word in sys.argv[1:])
    aluminium = rattled("Al4", FCC, [[4.1, 0.1, 0.0], [-0.2, 4.0, 0.1], [0.0, 0.3, 4.2]], 1)
    model = load(checkpoint / "model.yaml", checkpoint / "checkpoint")
    reference("al_eam_1l", model, dict(np.load(DATA / "al_eam_1l" / "kokkos.npz")), aluminium, 2)
    alloy = rattled("AlNiAlNi3", BCC, [[3.0, 0.1, 0.0], [-0.2, 2.9, 0.1], [0.0, 0.3, 8.9]], 3)
    model, checkpoint = train_two_layers(work)
    export(model, checkpoint, work)
    exported = dict(np.load(HERE / "two_layers_trained.npz"))
    reference("two_layers_trained", load(model, checkpoint), exported, alloy, 4)


if __name__ == "__main__":
    main()
