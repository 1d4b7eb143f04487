"""Makes the data of ../nickel-aluminium-hydrogen.toml: ni_al_h_eam_1l/ and nickel_aluminium_hydrogen_seeds.extxyz.

    python make_nickel_aluminium_hydrogen.py CALMWALK WORK [STEP …]

CALMWALK is the program, WORK a directory for what is made on the way. The Python has ASE and gracemaker
(tensorpotential 0.6.2.1), whose programs are beside it. The steps, in this order, are

    frames    training frames and held-out frames, labelled by NiAlH_jea.eam.alloy
    train     a GRACE-1L potential on the training frames
    mixture   its CALM mixture, and the export of both
    seeds     the seed structures of the campaign
    golden    gracemaker's energies, forces and grades of six structures, for the tests
    errors    the errors of the potential on the held-out frames

All take about 10 minutes on two cores, 8 of them `train`. Random numbers are fixed, and frames and seed structures come
out the same. The order in which gracemaker's threads add is not fixed, so that its weights may differ slightly.
"""

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

import numpy as np
from ase import Atoms
from ase.build import add_adsorbate, bulk, fcc100, fcc111
from ase.calculators.singlepoint import SinglePointCalculator
from ase.geometry import get_distances
from ase.io import read, write
from ase.neighborlist import neighbor_list

HERE = Path(__file__).resolve().parent
MODEL = HERE / "ni_al_h_eam_1l"
LABELS = HERE / "NiAlH_jea.eam.alloy"

# Lattice parameters of the label source at 0 K, Å.
NICKEL, ALUMINIUM, NI3AL = 3.520, 4.050, 3.568
TEMPERATURES = (300.0, 600.0)  # K

INPUT = """
seed: 42
cutoff: 5.65

data:
  filename: "{frames}"
  reference_energy: 0
  stress_units: eV/A3

potential:
  preset: "GRACE_1LAYER_latest"
  scale: True
  shift: True
  kwargs: {{lmax: 3, n_rad_max: 8, prod_func_n_max: 8, max_order: 4, n_mlp_dens: 8, n_rad_base: 8, embedding_size: 16}}
  dense_nbr: True
  param_dtype: float64

fit:
  loss: {{
    energy: {{ type: huber, weight: 20, delta: 0.01 }},
    forces: {{ type: huber, weight: 5, delta: 0.01 }},
    stress: {{ type: huber, weight: 20, delta: 0.01 }},
  }}
  optimizer: Adam
  opt_params: {{ "learning_rate": 0.01, "amsgrad": True }}
  scheduler: cosine_decay
  scheduler_params: {{ "minimum_learning_rate": 0.0002 }}
  maxiter: 150
  batch_size: 2
  train_max_n_buckets: 1
  checkpoint_freq: 50
  progressbar: False
  train_shuffle: True
  jit_compile: True
"""

DYNAMICS = """
structure = "start.extxyz"

[potential]
kind = "eam_alloy"
file = "{labels}"

[dynamics]
steps = {steps}
temperature = {temperature}
time_step = {time_step}
rng_seed = {seed}
thermostat = {{ langevin = {{ friction = 0.01 }} }}

[output]
trajectory = "trajectory.extxyz"
every = {every}
"""


def run(*command, where):
    """A program's run in a directory; its output stands in `log.txt` there."""
    with open(where / "log.txt", "a") as log:
        code = subprocess.run([str(word) for word in command], cwd=where, stdout=log, stderr=log).returncode
    if code:
        sys.exit(f"{command[0]} failed: see {where / 'log.txt'}")


def gracemaker(name):
    return Path(sys.executable).parent / name


# ---------------------------------------------------------------------------------------------------- structures


def ni3al():
    """L1_2: aluminium at the corners, nickel on the faces."""
    places = [[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]]
    return Atoms("AlNi3", scaled_positions=places, cell=[NI3AL] * 3, pbc=True)


def bare(atoms, **info):
    """Elements, positions and cell alone."""
    return Atoms(atoms.symbols, atoms.positions, cell=atoms.cell, pbc=atoms.pbc, info=info)


def host(name):
    """One cubic cell of four atoms."""
    if name == "Ni3Al":
        return ni3al()
    return bulk(name, "fcc", a={"Ni": NICKEL, "Al": ALUMINIUM}[name], cubic=True)


OCTAHEDRAL = [[0.5, 0.5, 0.5], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]]
TETRAHEDRAL = [[x, y, z] for x in (0.25, 0.75) for y in (0.25, 0.75) for z in (0.25, 0.75)]


def sites(name, kind, repeat):
    """Positions of the interstitial sites of a repeated cubic cell, Å."""
    cell = host(name)
    places = {"octahedral": OCTAHEDRAL, "tetrahedral": TETRAHEDRAL}[kind]
    gas = Atoms(f"H{len(places)}", scaled_positions=places, cell=cell.cell, pbc=True)
    return (gas * repeat).positions


def spread(positions, cell, count, random, apart=3.4):
    """`count` of the positions at random, no two closer than `apart` ångström."""
    while True:
        chosen = positions[random.choice(len(positions), count, replace=False)]
        _, distances = get_distances(chosen, cell=cell, pbc=True)
        if distances[~np.eye(count, dtype=bool)].min() > apart:
            return chosen


def slabs():
    """Nickel (111) and aluminium (100) with 6 Å of vacuum on each side, periodic in their planes."""
    for slab in (fcc111("Ni", (2, 4, 5), a=NICKEL, orthogonal=True), fcc100("Al", (3, 3, 4), a=ALUMINIUM)):
        slab.center(vacuum=6.0, axis=2)
        yield slab


def strained(atoms, random):
    """With a random symmetric strain of about 1 %."""
    strain = random.normal(0.0, 0.01, (3, 3))
    atoms = atoms.copy()
    atoms.set_cell(atoms.cell @ (np.eye(3) + 0.5 * (strain + strain.T)), scale_atoms=True)
    return atoms


def with_hydrogen(name, kind, random):
    """32 host atoms and three hydrogen atoms far from each other."""
    atoms = host(name) * (2, 2, 2)
    return atoms + Atoms("H3", spread(sites(name, kind, (2, 2, 2)), atoms.cell, 3, random))


# -------------------------------------------------------------------------------------------------------- frames


def hot(atoms, temperature, count, random, calmwalk, work):
    """`count` frames of molecular dynamics, 0.5 ps apart, after 1 ps."""
    time_step = 0.5 if "H" in atoms.symbols else 2.0  # fs
    every = round(500.0 / time_step)
    values = dict(temperature=temperature, time_step=time_step, every=every, labels=LABELS)
    values |= dict(steps=(count + 1) * every, seed=random.integers(1 << 31))
    (work / "md.toml").write_text(DYNAMICS.format(**values))
    write(work / "start.extxyz", bare(atoms))
    run(calmwalk, "md", "md.toml", where=work)
    return read(work / "trajectory.extxyz", "2:")


def rattled(atoms, random):
    atoms = atoms.copy()
    atoms.positions += random.normal(0.0, 0.08, atoms.positions.shape)
    return atoms


def structures(hot_frames, rattled_frames, slab_frames, seed, calmwalk, work):
    """Hot crystals, also with hydrogen in octahedral sites; rattled ones with it in tetrahedral sites; hot slabs."""
    random = np.random.default_rng(seed)
    for name in ("Ni", "Al", "Ni3Al"):
        for temperature in TEMPERATURES:
            for start in (host(name) * (2, 2, 2), with_hydrogen(name, "octahedral", random)):
                start = strained(start, random)
                yield from hot(start, temperature, hot_frames, random, calmwalk, work)
        for _ in range(rattled_frames):
            yield rattled(strained(with_hydrogen(name, "tetrahedral", random), random), random)
    for slab in slabs():
        # Only a structure that is periodic in all directions has a stress, and gracemaker wants one of every frame.
        slab.pbc = True
        for temperature in TEMPERATURES:
            yield from hot(slab, temperature, slab_frames, random, calmwalk, work)


def labelled(frames, calmwalk, work):
    """The frames with energy, forces and stress of the label source, and nothing else."""
    unlabelled = [bare(frame) for frame in frames]
    write(work / "unlabelled.extxyz", unlabelled)
    (work / "label.toml").write_text(
        f'[label]\nmethod = {{ potential = {{ kind = "eam_alloy", file = "{LABELS}" }} }}\n'
    )
    command = [calmwalk, "label-file", "unlabelled.extxyz", "--config", "label.toml", "--output", "labels.extxyz"]
    run(*command, where=work)
    for atoms, found in zip(unlabelled, read(work / "labels.extxyz", ":"), strict=True):
        results = {key: found.calc.results[key] for key in ("energy", "forces", "stress")}
        atoms.calc = SinglePointCalculator(atoms, **results)
    return unlabelled


def make_frames(calmwalk, work):
    MODEL.mkdir(exist_ok=True)
    training = labelled(structures(5, 6, 3, 20261123, calmwalk, work), calmwalk, work)
    write(MODEL / "seed_frames.extxyz", training)
    held_out = labelled(structures(2, 3, 2, 20261124, calmwalk, work), calmwalk, work)
    write(work / "held_out.extxyz", held_out)
    for name, frames in [("training", training), ("held-out", held_out)]:
        atoms = [symbol for frame in frames for symbol in frame.symbols]
        counts = ", ".join(f"{atoms.count(symbol)} {symbol}" for symbol in ("Ni", "Al", "H"))
        print(f"{len(frames)} {name} frames: {counts}")


# --------------------------------------------------------------------------------------------------------- model


def train(calmwalk, work):
    (work / "input.yaml").write_text(INPUT.format(frames=MODEL / "seed_frames.extxyz"))
    run(gracemaker("gracemaker"), "input.yaml", where=work)


def trained(work):
    """model.yaml and the final checkpoint."""
    folder = work / "seed" / "42"
    return folder / "model.yaml", folder / "checkpoints" / "checkpoint"


def make_mixture(calmwalk, work):
    model, checkpoint = trained(work)
    artifact = work / "gmm_artifacts.npz"
    options = ["--model-yaml", model, "--checkpoint", f"{checkpoint}.index"]
    options += ["--train-data", model.with_name("training_set.pkl.gz"), "--artifact-path", artifact]
    options += ["--n-clusters", "3", "--rp-dim", "64", "--n-workers", "1", "--seed", "42", "--restart", "--no-export"]
    run(gracemaker("grace_uq"), "build", *options, where=work)
    options = ["-p", model, "-c", checkpoint, "export_kokkos", "-o", MODEL / "kokkos.npz"]
    run(gracemaker("grace_utils"), *options, "--uq-artifacts", artifact, where=work)
    shutil.copyfile(artifact, MODEL / artifact.name)


# --------------------------------------------------------------------------------------------------------- seeds


def crystal_with(name, *places):
    """32 host atoms and hydrogen at the places, in lattice parameters."""
    atoms = host(name) * (2, 2, 2)
    return atoms + Atoms(f"H{len(places)}", np.array(places) * host(name).cell[0, 0])


def vacancy_with_hydrogen(name, *steps):
    """A crystal with hydrogen in place of one atom, at these distances from it in Å."""
    atoms = host(name) * (2, 2, 2)
    place = atoms.cell.sum(axis=0) / 2
    del atoms[int(np.linalg.norm(atoms.positions - place, axis=1).argmin())]
    return atoms + Atoms(f"H{len(steps)}", place + np.array(steps))


def slab_with_hydrogen(slab):
    """Two hydrogen atoms in fcc hollows of one surface. (From Al (100) a biased walk drives hydrogen into the vacuum.)"""
    for offset in [(0, 0), (1, 2)]:
        add_adsorbate(slab, "H", 0.95, "fcc", offset=offset)
    return slab


def seed_structures():
    nickel, _ = slabs()
    octahedral, tetrahedral = [0.5, 0.5, 0.5], [0.75, 0.75, 0.75]
    yield "ni-h", crystal_with("Ni", octahedral)
    yield "ni-h-pair", crystal_with("Ni", octahedral, tetrahedral)
    yield "ni-vacancy-h2", vacancy_with_hydrogen("Ni", [-0.4, 0.0, 0.0], [0.4, 0.0, 0.0])
    yield "ni-slab-111-h", slab_with_hydrogen(nickel)
    yield "al-h", crystal_with("Al", tetrahedral)
    yield "al-vacancy-h", vacancy_with_hydrogen("Al", [1.0, 0.0, 0.0])
    yield "ni3al", ni3al() * (2, 2, 2)
    yield "ni3al-h", crystal_with("Ni3Al", octahedral)


def make_seeds(calmwalk, work):
    seeds = []
    for name, atoms in seed_structures():
        first, second, distances = neighbor_list("ijd", atoms, 4.0)
        shortest = {}
        for a, b, distance in zip(atoms.symbols[first], atoms.symbols[second], distances):
            key = "-".join(sorted((a, b)))
            shortest[key] = min(distance, shortest.get(key, np.inf))
        shown = ", ".join(f"{pair} {distance:.2f}" for pair, distance in sorted(shortest.items()))
        print(f"{name:14} {len(atoms)} atoms, shortest distances {shown} Å")
        seeds.append(bare(atoms, name=name))
    write(HERE / "nickel_aluminium_hydrogen_seeds.extxyz", seeds)


# -------------------------------------------------------------------------------------------- comparison with others


def golden_structures():
    """Five seed structures, and one that is rattled and compressed, with two hydrogen atoms 0.9 Å apart."""
    seeds = {atoms.info["name"]: atoms for atoms in read(HERE / "nickel_aluminium_hydrogen_seeds.extxyz", ":")}
    for name in ("ni-h-pair", "ni-slab-111-h", "al-h", "ni3al", "ni3al-h"):
        yield name, seeds[name]
    atoms = rattled(crystal_with("Ni3Al", [0.5, 0.5, 0.5], [0.7, 0.6, 0.6]), np.random.default_rng(7))
    atoms.set_cell(0.95 * atoms.cell, scale_atoms=True)
    yield "compressed-rattled", atoms


def make_golden(calmwalk, work):
    """In the form of al_eam_1l/golden.npz; Å, eV."""
    from tensorpotential.uq.factories import get_gmm_uq_calculator

    model, checkpoint = trained(work)
    calculator = get_gmm_uq_calculator(str(model), str(checkpoint), str(MODEL / "gmm_artifacts.npz"))
    export = np.load(MODEL / "kokkos.npz")
    structures = list(golden_structures())
    arrays = {
        "names": np.array([name for name, _ in structures]),
        "elements": np.array([symbol.decode() for symbol in export["element_names"]]),
        "cutoff": np.float64(np.ravel(export["rcut"])[0]),
    }
    for number, (_, atoms) in enumerate(structures):
        found = dict(positions=atoms.positions, cell=atoms.cell.array, pbc=atoms.pbc, numbers=atoms.numbers)
        # The calculator makes its structure periodic in all directions.
        calculator.calculate(atoms.copy())
        for key in ("energy", "forces", "stress", "dsigma_dr", "features", "gamma"):
            found[key] = calculator.results[key]
        found["sigma"] = calculator.results["atomic_sigma"]
        found["virial_sigma"] = calculator.results["virial_sigma"]
        for key, value in found.items():
            value = np.array(value)
            column = key in ("sigma", "gamma", "virial_sigma")
            arrays[f"s{number:02}_{key}"] = value.ravel() if column else value
    np.savez_compressed(MODEL / "golden.npz", **arrays)


def show_errors(calmwalk, work):
    """Root mean squares of errors on the held-out frames, by calmwalk's evaluation."""
    options = ["--model", MODEL / "kokkos.npz", work / "held_out.extxyz", "--output", work / "scored.extxyz"]
    run(calmwalk, "calm", "score", *options, where=work)
    known, found = read(work / "held_out.extxyz", ":"), read(work / "scored.extxyz", ":")
    forces = np.concatenate([f.get_forces() - k.get_forces() for f, k in zip(found, known, strict=True)])
    symbols = np.concatenate([k.symbols for k in known])
    gamma = np.concatenate([f.arrays["gamma"] for f in found])
    size = np.concatenate([k.get_forces() for k in known])
    for symbol in ("Ni", "Al", "H"):
        rows = symbols == symbol
        error, scale = (1000 * np.sqrt(np.mean(values[rows] ** 2)) for values in (forces, size))
        print(f"{symbol:2} force error {error:.1f} of {scale:.0f} meV/Å, mean γ {gamma[rows].mean():.2f}")
    energies = [(f.get_potential_energy() - k.get_potential_energy()) / len(k) for f, k in zip(found, known)]
    print(f"energy error {1000 * np.sqrt(np.mean(np.square(energies))):.2f} meV per atom")


STEPS = {
    "frames": make_frames,
    "train": train,
    "mixture": make_mixture,
    "seeds": make_seeds,
    "golden": make_golden,
    "errors": show_errors,
}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("calmwalk", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("steps", nargs="*", choices=[[], *STEPS], metavar="STEP")
    arguments = parser.parse_args()
    calmwalk, work = arguments.calmwalk.resolve(), arguments.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    for step in arguments.steps or STEPS:
        STEPS[step](calmwalk, work)


if __name__ == "__main__":
    main()
