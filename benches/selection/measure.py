"""Measures `calmwalk select` against `grace_uq select`, on one core with one thread.

    python measure.py CALMWALK WORK [--frames N] [--picks N] [--rounds N]

The Python has ASE and gracemaker (tensorpotential 0.6.2.1). The pool are N structures of 108 aluminium atoms: the frames of
`configs/data/al_eam_1l`, whose model grades them, with random strains and displacements.

The reference gets a pool that was predicted before: grades and features of every atom are in the table that it reads, and neither
the start of Python nor imports count. calmwalk gets the bare structures, and what is timed is the whole command, the evaluation of
the model included. What picking takes, of either, is the difference to the time for one structure at random: without reading the
pool, and without evaluation.

Prints the times of each round, the ratios of their medians, and how many structures both pick.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from ase.io import read, write

DATA = Path(__file__).resolve().parents[2] / "configs" / "data" / "al_eam_1l"
MODEL, ARTIFACT = DATA / "kokkos.npz", DATA / "gmm_artifacts.npz"
# Farthest points begin with a greedy pick: the reference begins with an atom that it draws otherwise.
STRATEGIES = ["calm-greedy:{}", "calm-greedy:1 fps-extrap:{}"]

REFERENCE = r"""
import contextlib, io, json, sys, time
import pandas as pd
import tensorpotential.uq.cli.select
from tensorpotential.scripts.grace_uq import main
artifact, strategy, output = sys.argv[1:]
sys.argv = ["grace_uq", "select", "--artifact", artifact, "--predicted", "predicted.pkl.gz", "--output", output,
            "--no-element-stratified", "--strategy", *strategy.split()]
begun = time.perf_counter()
try:
    with contextlib.redirect_stdout(io.StringIO()):
        main()
except SystemExit as end:
    if end.code:
        raise
seconds = time.perf_counter() - begun
print(json.dumps([seconds, [info["number"] for info in pd.read_pickle(output)["info"]]]))
"""

PREDICT = r"""
import numpy as np, pandas as pd
from ase.io import read
features, rows, first = np.load("z.npy"), [], 0
for number, atoms in enumerate(read("scored.extxyz", ":")):
    n = len(atoms)
    atoms.calc = None
    rows.append(dict(ase_atoms=atoms, energy=0.0, forces=np.zeros((n, 3)), info={"number": number}, energy_predicted=0.0,
                     forces_predicted=np.zeros((n, 3)), gamma=atoms.arrays["gamma"], sigma=atoms.arrays["sigma"],
                     features=features[first:first + n]))
    first += n
pd.DataFrame(rows).to_pickle("predicted.pkl.gz")
"""


def run(command, work):
    """Runs on one core. Returns wall-clock time, s, and what is printed."""
    one = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    environment = {**os.environ, **one, "CUDA_VISIBLE_DEVICES": "", "TF_CPP_MIN_LOG_LEVEL": "3"}
    begun = time.perf_counter()
    done = subprocess.run(["taskset", "--cpu-list", "0", *map(str, command)], cwd=work, env=environment, stdout=subprocess.PIPE,
                          stderr=open(work / "log.txt", "a"), text=True)
    if done.returncode:
        sys.exit(f"{command[0]} failed: see {work / 'log.txt'}")
    return time.perf_counter() - begun, done.stdout


def pool(frames, calmwalk, work):
    """Writes the pool, and the table of it that the reference reads."""
    random, known, made = np.random.default_rng(1), read(DATA / "seed_frames.extxyz", ":"), []
    for number in range(frames):
        atoms = known[number % len(known)].copy()
        atoms.calc, atoms.info = None, {}
        atoms.set_cell(atoms.cell * (1.0 + 0.04 * random.uniform(-1, 1)), scale_atoms=True)
        atoms.positions += 0.04 * (1 + number % 5) * random.uniform(-1, 1, atoms.positions.shape)
        made.append(atoms)
    write(work / "pool.extxyz", made)
    run([calmwalk, "calm", "score", "--model", MODEL, "--artifact", ARTIFACT, "pool.extxyz", "--output", "scored.extxyz",
         "--features", "z.npy"], work)
    run([sys.executable, "-c", PREDICT], work)
    return sum(map(len, made))


def reference(strategy, work):
    _, printed = run([sys.executable, "-c", REFERENCE, ARTIFACT, strategy, "picked.pkl.gz"], work)
    return json.loads([line for line in printed.splitlines() if line.startswith("[")][-1])


def own(calmwalk, strategy, work):
    command = [calmwalk, "select", "--model", MODEL, "--artifact", ARTIFACT, "pool.extxyz", "--output", "own.extxyz", "--threads", 1,
               "--json", "--no-element-floors", "--strategy", *strategy.replace("calm-", "").split()]
    seconds, printed = run(command, work)
    return seconds, [pick["source_frame"] for pick in json.loads(printed)["picks"]]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calmwalk", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--picks", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    calmwalk, work = arguments.calmwalk.resolve(), arguments.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    print(f"{pool(arguments.frames, calmwalk, work)} atoms in {arguments.frames} structures")
    for strategy in STRATEGIES:
        strategy = strategy.format(arguments.picks)
        times = {key: [] for key in ("reference", "reference picks", "own", "own picks")}
        for number in range(arguments.rounds):
            seconds, expected = reference(strategy, work)
            times["reference"].append(seconds)
            times["reference picks"].append(seconds - reference("random-all:1", work)[0])
            seconds, found = own(calmwalk, strategy, work)
            times["own"].append(seconds)
            times["own picks"].append(seconds - own(calmwalk, "random:1", work)[0])
            same = next((k for k, pair in enumerate(zip(found, expected)) if pair[0] != pair[1]), min(len(found), len(expected)))
            last = ", ".join(f"{key} {values[-1]:.2f} s" for key, values in times.items())
            print(f"{strategy}, round {number}: {last}; {len(found)} and {len(expected)} picks, the first {same} the same", flush=True)
        median = {key: statistics.median(values) for key, values in times.items()}
        print(f"{strategy}: ratio of whole commands {median['reference'] / median['own']:.1f}, "
              f"of picking {median['reference picks'] / median['own picks']:.1f}")


if __name__ == "__main__":
    main()
