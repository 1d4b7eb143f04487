"""Compares the grades of mixtures that `calmwalk calm build` and `grace_uq build` make, on held-out DFT data.

    python grades.py CALMWALK DATASETS WORK [Si Mo W] [--epochs N]

The Python has ASE, SciPy and gracemaker (tensorpotential 0.6.2.1), whose programs are beside it. DATASETS has
`<element>_<source>_train.xyz` and `_test.xyz` (energy, forces): Si and Mo of Zuo et al., J. Phys. Chem. A 124, 731 (2020), W of
Li et al., npj Comput. Mater. 6, 70 (2020). For each element, gracemaker trains a small GRACE-1L potential without the hottest molecular dynamics and without surfaces. Both
programs build a mixture from these training frames with three random seeds, the projection of the features being the same.
Held out are the test set, the hottest frames and the surfaces. `calmwalk calm score` grades them with each mixture.

Prints Spearman's ρ of the grade and the length of the error of the force, and the area under the ROC curve for errors above
1 eV/Å, of γ and γ_nbr, over all held-out atoms; ρ also of two other averages of γ, which count all neighbours within the cutoff
alike, or within the first coordination shell. Steps whose result stands in WORK are not repeated.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from ase.calculators.singlepoint import SinglePointCalculator
from ase.io import read, write
from scipy.stats import rankdata, spearmanr

SEEDS = (42, 43, 44)
LARGE = 1.0  # eV/Å
CUTOFF = {"Si": 5.0, "Mo": 5.5, "W": 5.5}  # Å
SHELL = {"Si": 2.8, "Mo": 2.9, "W": 2.95}  # Å; beyond the first coordination shell, 2.35, 2.73 and 2.75 Å, and within the second
HOTTEST = {"Si": "3374 K", "Mo": "6000 K", "W": "Md 4000"}

INPUT = """
seed: 42
cutoff: {cutoff}

data:
  filename: "{frames}"
  reference_energy: 0

potential:
  preset: "GRACE_1LAYER_latest"
  scale: True
  shift: True
  kwargs: {{lmax: 3, n_rad_max: 8, prod_func_n_max: 8, max_order: 4, n_mlp_dens: 8, n_rad_base: 8, embedding_size: 16}}
  param_dtype: float64

fit:
  loss: {{ energy: {{ type: huber, weight: 20, delta: 0.01 }}, forces: {{ type: huber, weight: 5, delta: 0.01 }} }}
  optimizer: Adam
  opt_params: {{ "learning_rate": 0.01, "amsgrad": True }}
  scheduler: cosine_decay
  scheduler_params: {{ "minimum_learning_rate": 0.0005 }}
  maxiter: {epochs}
  batch_size: 2
  train_max_n_buckets: 1
  checkpoint_freq: 1
  progressbar: False
  train_shuffle: True
  jit_compile: True
"""


def run(*command, where):
    """A program's run in a directory; its output stands in `log.txt` there."""
    with open(where / "log.txt", "a") as log:
        code = subprocess.run([str(word) for word in command], cwd=where, stdout=log, stderr=log).returncode
    if code:
        sys.exit(f"{command[0]} failed: see {where / 'log.txt'}")


def gracemaker(name):
    return Path(sys.executable).parent / name


def dataset(element, part, datasets):
    """The frames of a file."""
    found = list(datasets.glob(f"{element}_*_{part}.xyz"))
    if len(found) != 1:
        sys.exit(f"{datasets}: {len(found)} files {element}_*_{part}.xyz; expected one")
    return read(found[0], ":")


def frames(element, datasets, work):
    """Writes training and held-out frames, with energy and forces alone."""
    held_out, training = dataset(element, "test", datasets), []
    for atoms in dataset(element, "train", datasets):
        new = HOTTEST[element] in atoms.info["description"] or atoms.info["config_type"] == "Surface"
        (held_out if new else training).append(atoms)
    for name, found in [("training", training), ("held_out", held_out)]:
        for atoms in found:
            results = {key: atoms.calc.results[key] for key in ("energy", "forces")}
            atoms.info, atoms.calc = {}, SinglePointCalculator(atoms, **results)
        write(work / f"{name}.extxyz", found)


def train(element, epochs, work):
    text = INPUT.format(cutoff=CUTOFF[element], frames=work / "training.extxyz", epochs=epochs)
    (work / "input.yaml").write_text(text)
    run(gracemaker("gracemaker"), "input.yaml", where=work)
    (work / "trained").touch()


def potential(work):
    """model.yaml and the final checkpoint."""
    folder = work / "seed" / "42"
    return folder / "model.yaml", folder / "checkpoints" / "checkpoint"


def reference_mixture(seed, output, work):
    model, checkpoint = potential(work)
    options = ["--model-yaml", model, "--checkpoint", f"{checkpoint}.index"]
    options += ["--train-data", model.with_name("training_set.pkl.gz"), "--artifact-path", output]
    options += ["--n-workers", 1, "--seed", seed, "--restart", "--no-export"]
    run(gracemaker("grace_uq"), "build", *options, where=work)


def export(artifact, work):
    """The export of the model, with the projection of the features."""
    model, checkpoint = potential(work)
    options = ["-p", model, "-c", checkpoint, "export_kokkos", "-o", work / "kokkos.npz", "--uq-artifacts", artifact]
    run(gracemaker("grace_utils"), *options, where=work)


def own_mixture(seed, output, calmwalk, work):
    options = ["--model", work / "kokkos.npz", work / "training.extxyz", "--rng-seed", seed, "--output", output]
    run(calmwalk, "calm", "build", *options, where=work)


def roc_auc(score, positive):
    """Probability that a positive atom has the larger score, ties counted half."""
    count = positive.sum()
    return (rankdata(score)[positive].sum() - count * (count + 1) / 2) / (count * (len(score) - count))


def measure(artifact, calmwalk, element, work):
    """Components; ρ and AUC of γ, of γ_nbr; ρ of two other averages; share of atoms with γ > 1; errors of the forces, eV/Å."""
    scored, shell = work / "scored.extxyz", SHELL[element]
    options = ["--model", work / "kokkos.npz", "--artifact", artifact, work / "held_out.extxyz", "--output", scored]
    options += ["--gamma-nbr", "uniform", "--gamma-nbr", f"uniform:{shell}"]
    run(calmwalk, "calm", "score", *options, where=work)
    known, found = read(work / "held_out.extxyz", ":"), read(scored, ":")
    errors = np.concatenate([f.get_forces() - k.get_forces() for f, k in zip(found, known, strict=True)])
    errors = np.linalg.norm(errors, axis=1)
    names = ("gamma", "gamma_nbr", "gamma_nbr_uniform", f"gamma_nbr_uniform_{shell}")
    *grades, uniform, first_shell = (np.concatenate([f.arrays[name] for f in found]) for name in names)
    large = errors > LARGE
    components = int((np.load(artifact)["counts_0"] > 0).sum())
    quality = [function for grade in grades for function in (spearmanr(grade, errors)[0], roc_auc(grade, large))]
    averages = [spearmanr(grade, errors)[0] for grade in (uniform, first_shell)]
    return [components, *quality, *averages, (grades[0] > 1).mean()], errors


def once(path, make):
    if not path.exists():
        make()
    return path


def compare(element, epochs, calmwalk, datasets, work):
    work.mkdir(parents=True, exist_ok=True)
    once(work / "training.extxyz", lambda: frames(element, datasets, work))
    once(work / "trained", lambda: train(element, epochs, work))
    table = {"grace_uq build": [], "calmwalk calm build": []}
    for seed in SEEDS:
        path = work / f"grace_uq_{seed}.npz"
        once(path, lambda: reference_mixture(seed, path, work))
        once(work / "kokkos.npz", lambda: export(path, work))
        table["grace_uq build"].append(measure(path, calmwalk, element, work)[0])
        path = work / f"calmwalk_{seed}.npz"
        once(path, lambda: own_mixture(seed, path, calmwalk, work))
        found, errors = measure(path, calmwalk, element, work)
        table["calmwalk calm build"].append(found)
    training, held_out = (read(work / f"{name}.extxyz", ":") for name in ("training", "held_out"))
    atoms = [sum(map(len, found)) for found in (training, held_out)]
    rms, large = np.sqrt(np.mean(errors**2)), (errors > LARGE).sum()
    print(
        f"\n{element}: {len(training)} training frames ({atoms[0]} atoms), {len(held_out)} held out ({atoms[1]} atoms); "
        f"errors of held-out forces: root mean square {rms:.2f} eV/Å, {large} atoms above {LARGE:.0f} eV/Å\n"
    )
    columns = ["build", "random seed", "components", "ρ(γ)", "AUC(γ)", "ρ(γ_nbr)", "AUC(γ_nbr)", "ρ(uniform)",
               f"ρ(uniform, {SHELL[element]} Å)", "γ > 1"]
    print(f"| {' | '.join(columns)} |")
    print("|" + " --- |" * len(columns))
    for name, rows in table.items():
        for seed, (components, *quality, above) in zip(SEEDS, rows, strict=True):
            numbers = " | ".join(f"{value:.4f}" for value in quality)
            print(f"| `{name}` | {seed} | {components} | {numbers} | {100 * above:.1f} % |")
    for column, name in enumerate(("ρ(γ)", "AUC(γ)", "ρ(γ_nbr)", "AUC(γ_nbr)"), start=1):
        reference, own = (np.array([row[column] for row in rows]) for rows in table.values())
        spread = max(np.ptp(reference), np.ptp(own))
        print(f"{name}: means {reference.mean():.4f}, {own.mean():.4f}; spreads {np.ptp(reference):.4f}, {np.ptp(own):.4f}; "
              f"difference {'within' if abs(reference.mean() - own.mean()) <= spread else 'BEYOND'} the larger spread")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calmwalk", type=Path)
    parser.add_argument("datasets", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--epochs", type=int, default=60, help="of the training")
    parser.add_argument("elements", nargs="*", default=list(CUTOFF))
    arguments = parser.parse_args()
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    for element in arguments.elements:
        work = arguments.work.resolve() / element
        compare(element, arguments.epochs, arguments.calmwalk.resolve(), arguments.datasets.resolve(), work)


if __name__ == "__main__":
    main()
