"""Trains two tiny GRACE models for Al and Cu, of one and of two layers, with their mixtures and exports: what tests
of the gracemaker adapter take. Labels come from the radial model, so nothing but gracemaker is needed. A few minutes
on one core.

    python make_gracemaker.py one WORK1        # python: one with gracemaker, whose programs are beside it
    python make_gracemaker.py two WORK2

WORK receives model.yaml, checkpoint.index and checkpoint.data-…, gmm_artifacts.npz, kokkos.npz and frames.extxyz.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

os.environ.update({name: "1" for name in ("OMP_NUM_THREADS", "TF_NUM_INTRAOP_THREADS", "TF_NUM_INTEROP_THREADS")})
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from ase import Atoms
from ase.build import bulk
from ase.calculators.singlepoint import SinglePointCalculator
from ase.io import write

from calmwalk.adapters.radial import Radial
from calmwalk.neighbours import Structure, batch_of

ELEMENTS = ["Al", "Cu"]
CUTOFF = 4.5
SMALL = {"max_order": 4, "n_mlp_dens": 4, "n_rad_base": 4, "embedding_size": 8}
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "one": ("GRACE_1LAYER_latest", {"lmax": 2, "n_rad_max": 5, "prod_func_n_max": 6, **SMALL}),
    "two": (
        "GRACE_2LAYER_latest",
        {"lmax": [3, 2], "n_rad_max": [6, 5], "prod_func_n_max": [6, 5], "indicator_lmax": 1, **SMALL},
    ),
}
INPUT = """
seed: 42
cutoff: {cutoff}
data: {{ filename: frames.extxyz, test_size: 0.1, reference_energy: 0, stress_units: eV/A3 }}
potential: {{ preset: {preset}, scale: True, shift: True, kwargs: {kwargs}, param_dtype: float64 }}
fit:
  loss:
    energy: {{ type: huber, weight: 20, delta: 0.01 }}
    forces: {{ type: huber, weight: 5, delta: 0.01 }}
    stress: {{ type: huber, weight: 20, delta: 0.01 }}
  optimizer: Adam
  opt_params: {{ learning_rate: 0.01, amsgrad: True }}
  scheduler: cosine_decay
  scheduler_params: {{ minimum_learning_rate: 0.0002 }}
  maxiter: 60
  batch_size: 4
  train_max_n_buckets: 1
  test_max_n_buckets: 1
  progressbar: False
"""


def frames() -> list[Atoms]:
    """Fifty rattled and strained crystals of 16 atoms."""
    radial = Radial(Path(__file__).resolve().parent / "data" / "radial-alcu.json", {})
    random, made = np.random.default_rng(1), []
    for number in range(50):
        atoms = bulk("Al", "fcc", a=3.6 + 0.5 * random.uniform(), cubic=True) * (2, 2, 1)
        atoms.symbols = random.choice(ELEMENTS, len(atoms), p=[number % 5 / 4, 1 - number % 5 / 4])
        atoms.set_cell(atoms.cell.array @ (np.eye(3) + 0.03 * random.standard_normal((3, 3))), scale_atoms=True)
        atoms.positions += random.normal(0, 0.05 + 0.02 * (number % 7), atoms.positions.shape)
        species = np.array([ELEMENTS.index(symbol) for symbol in atoms.symbols], dtype=np.int32)
        structure = Structure(species, atoms.positions, atoms.cell.array, (True, True, True))
        result = radial.evaluate(batch_of([structure], 5.6), False)
        stress = (-result.virials[0] / atoms.get_volume()).ravel()[[0, 4, 8, 5, 2, 1]]
        atoms.calc = SinglePointCalculator(
            atoms, energy=float(result.energies.sum()), forces=result.forces, stress=stress
        )
        made.append(atoms)
    return made


def untrained(kind: str, work: Path) -> None:
    """Writes a model of random weights, in seconds, and an artifact that has the projection and nothing else."""
    import tensorpotential  # noqa: F401  - before tensorflow

    # isort: split
    import tensorflow as tf
    from tensorpotential.cli.prepare import construct_model
    from tensorpotential.instructions.base import save_instructions_dict
    from tensorpotential.tensorpot import TensorPotential
    from tensorpotential.uq.factories import make_basis_rp_spec

    preset, kwargs = KINDS[kind]
    config = {"preset": preset, "kwargs": dict(kwargs), "dense_nbr": False}
    tf.random.set_seed(1)
    elements = {symbol: number for number, symbol in enumerate(ELEMENTS)}
    instructions, _ = construct_model(config, elements, rcut=CUTOFF, avg_n_neigh=20.0)
    save_instructions_dict(str(work / "model.yaml"), instructions, param_dtype="float64")
    potential = TensorPotential(instructions, param_dtype=tf.float64, seed=1, eager_mode=True)
    potential.save_checkpoint(checkpoint_name=str(work / "checkpoint"))
    spec = make_basis_rp_spec(str(work / "model.yaml"), rp_dim=16, normalize=True, add_density_channel=True)
    np.savez(work / "gmm_artifacts.npz", **{key: value for key, value in spec.items() if value is not None})


def program(work: Path, name: str, *words: object) -> None:
    """Runs a program of gracemaker in WORK."""
    command = [str(Path(sys.executable).parent / name), *map(str, words)]
    subprocess.run(command, check=True, cwd=work)


def main() -> None:
    kind, work = sys.argv[1], Path(sys.argv[2]).resolve()
    work.mkdir(parents=True, exist_ok=True)
    write(work / "frames.extxyz", frames())
    preset, kwargs = KINDS[kind]
    (work / "input.yaml").write_text(INPUT.format(cutoff=CUTOFF, preset=preset, kwargs=json.dumps(kwargs)))
    program(work, "gracemaker", "input.yaml")
    trained = work / "seed" / "42"
    shutil.copy(trained / "model.yaml", work)
    for part in ("index", "data-00000-of-00001"):
        shutil.copy(trained / "checkpoints" / f"checkpoint.best_test_loss.{part}", work / f"checkpoint.{part}")
    options = ["--model-yaml", "model.yaml", "--checkpoint", "checkpoint.index", "--n-clusters", 2]
    options += ["--train-data", trained / "training_set.pkl.gz", "--artifact-path", "gmm_artifacts.npz"]
    program(work, "grace_uq", "build", *options, "--n-workers", 1, "--restart", "--no-export")
    options = ["-p", "model.yaml", "-c", "checkpoint", "export_kokkos", "-o", "kokkos.npz"]
    program(work, "grace_utils", *options, "--uq-artifacts", "gmm_artifacts.npz")


if __name__ == "__main__":
    main()
