"""Makes a synthetic foundation model and seed structures for the measurements of `measure.py`.

    python make_model.py WORK

The Python has ASE and gracemaker (tensorpotential 0.6.2.1), whose programs are beside it. WORK receives

    model.npz     GRACE-2L "medium" with random weights, 89 elements, and a mixture of up to 16 components an element
    seeds.extxyz  1,000 seed structures of 1 to 200 atoms, of one to six elements
    training.extxyz   the 1,068 structures of 60 atoms that the mixture is built from

The weights are those that gracemaker starts a training from, so energies mean nothing; costs are those of a trained
model. The components of an element are where gracemaker's k-means puts them for the structures of `mixture.pkl.gz`.
These are too few for covariances of 131 features each, so that every component gets the pooled covariance of its
element, and all have one threshold.
"""

import os
import subprocess
import sys
from pathlib import Path

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

import numpy as np
import pandas as pd
from ase import Atoms
from ase.build import bulk
from ase.data import atomic_numbers, chemical_symbols, covalent_radii
from ase.io import write

# Hydrogen to plutonium without the elements of which there are no data.
ELEMENTS = [symbol for symbol in chemical_symbols[1:95] if symbol not in ("Po", "At", "Rn", "Fr", "Ra")]
COMPONENTS = 16
FEATURES = 131
# σ at γ = 1. The root mean square is √131 = 11.4 for the structures of the mixture; others are much farther away.
THRESHOLD = 40.0
PRESET = dict(
    lmax=[4, 3], max_order=4, indicator_lmax=1, n_rad_max=[42, 32], prod_func_n_max=[42, 64], n_mlp_dens=16, n_rad_base=10
)


def structure(atoms, random, elements=None):
    """A rattled crystal of so many atoms, of one to six elements, with the volume of touching spheres."""
    if elements is None:
        elements = random.choice(ELEMENTS, random.integers(1, 7), replace=False)
    symbols = np.concatenate([elements, random.choice(elements, max(0, atoms - len(elements)))])[:atoms]
    random.shuffle(symbols)
    repeat = int(np.ceil((atoms / 4) ** (1 / 3)))
    crystal = bulk("Cu", "fcc", a=1.0, cubic=True) * (repeat, repeat, repeat)
    # The first `atoms` sites by height, in a cell that holds no more than them.
    sites = crystal.positions[np.lexsort(crystal.positions.T)][:atoms]
    height = np.ceil(atoms / (4 * repeat**2))
    # Light elements are as far apart as in molecular crystals.
    radius = max(1.2, *(covalent_radii[atomic_numbers[symbol]] for symbol in symbols))
    lattice = 2.0 * np.sqrt(2) * radius * random.uniform(0.97, 1.1)
    made = Atoms(symbols, lattice * sites, cell=lattice * np.array([repeat, repeat, height]), pbc=True)
    made.positions += random.normal(0.0, 0.02 * lattice, made.positions.shape)
    return made


def make_model(work):
    import tensorflow as tf
    from tensorpotential.cli.prepare import construct_model
    from tensorpotential.instructions.base import save_instructions_dict
    from tensorpotential.tensorpot import TensorPotential

    elements = {symbol: number for number, symbol in enumerate(sorted(ELEMENTS))}
    config = {"preset": "GRACE_2LAYER_latest", "kwargs": dict(PRESET), "dense_nbr": False}
    tf.random.set_seed(1)
    instructions, _ = construct_model(config, elements, rcut=6.0, avg_n_neigh=60.0)
    save_instructions_dict(str(work / "model.yaml"), instructions, param_dtype="float64")
    potential = TensorPotential(instructions, param_dtype=tf.float64, seed=1, eager_mode=True)
    potential.save_checkpoint(checkpoint_name=str(work / "checkpoint"))


def make_structures(work):
    random = np.random.default_rng(20261124)
    # The sizes are spread evenly over their logarithm; every 25th structure has one atom.
    sizes = [1 if number % 25 == 0 else int(np.exp(random.uniform(0, np.log(200.99)))) for number in range(1000)]
    seeds = [structure(size, random) for size in sizes]
    for number, seed in enumerate(seeds):
        seed.info["name"] = f"seed-{number:04}"
    write(work / "seeds.extxyz", seeds)
    frames = []
    for symbol in 12 * ELEMENTS:
        elements = [symbol, *random.choice([other for other in ELEMENTS if other != symbol], 2, replace=False)]
        frames.append(structure(60, random, elements))
    pd.DataFrame({"ase_atoms": frames}).to_pickle(work / "mixture.pkl.gz")
    write(work / "training.extxyz", frames)


def gracemaker(name, *words):
    command = [str(Path(sys.executable).parent / name), *map(str, words)]
    subprocess.run(command, check=True)


def make_mixture(work):
    artifact = work / "gmm_artifacts.npz"
    options = ["--model-yaml", work / "model.yaml", "--checkpoint", work / "checkpoint.index", "--train-data"]
    options += [work / "mixture.pkl.gz", "--artifact-path", artifact, "--n-clusters", COMPONENTS, "--min-atoms-per-cluster", 4]
    gracemaker("grace_uq", "build", *options, "--n-workers", 1, "--restart", "--no-export")


def export(work):
    artifact = work / "gmm_artifacts.npz"
    np.savez(artifact, **pooled(dict(np.load(artifact))))
    options = ["-p", work / "model.yaml", "-c", work / "checkpoint", "export_kokkos", "-o", work / "model.npz"]
    gracemaker("grace_utils", *options, "--uq-artifacts", artifact)


def pooled(arrays):
    """The artifact with the pooled covariance of each element in each of its components."""
    for element in arrays["elements"]:
        counts, scatter = arrays[f"counts_{element}"], arrays[f"scatter_{element}"]
        covariance = scatter.sum(axis=0, dtype=float) / counts.sum()
        inverse = np.linalg.inv(covariance + 1e-6 * np.eye(FEATURES))
        for slot in np.flatnonzero(counts):
            scatter[slot] = counts[slot] * covariance
            arrays[f"inv_cov_{element}"][slot] = inverse
    for key in ("interp_thresholds", "eff_interp_thresholds"):
        arrays[key][:] = THRESHOLD
    return arrays


if __name__ == "__main__":
    work = Path(sys.argv[1])
    work.mkdir(parents=True, exist_ok=True)
    steps = {"structures": make_structures, "model": make_model, "mixture": make_mixture, "export": export}
    for step in sys.argv[2:] or steps:
        steps[step](work)
