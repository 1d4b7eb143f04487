"""Measures `calmwalk select` against `grace_uq select`, on one core with one thread.

    python measure.py CALMWALK WORK [--frames N] [--picks N] [--rounds N] [--checkpoint FOLDER] [--processor-time]

The Python has ASE and gracemaker (tensorpotential 0.6.2.1). The pool are N structures of 108 aluminium atoms: the frames of
`configs/data/al_eam_1l`, whose model grades them, with random strains and displacements.

The reference gets a pool that was predicted before: grades and features of every atom are in the table that it reads, and neither
the start of Python nor imports count. calmwalk gets the bare structures, and what is timed is the whole command, the evaluation of
the model included. What picking takes, of either, is the difference to the time for one structure at random: without reading the
pool, and without evaluation.

With `--checkpoint`, a folder with `model.yaml` and `checkpoint` of the same model, the reference also gets the bare structures, and
predicts them itself. Its start, imports and compilation are those of the same job on the first 20 structures of the pool, which is
subtracted. Nothing is subtracted from calmwalk's time, so the ratio of whole jobs is a lower limit. Compilations that only a
larger pool needs count as the reference's time.

With `--processor-time`, times are those of the processor, which other programs on the machine change less than wall-clock times.

Prints the times of each round, the ratios of their medians, and how many structures both pick.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from ase.io import read, write

DATA = Path(__file__).resolve().parents[2] / "configs" / "data" / "al_eam_1l"
MODEL, ARTIFACT = DATA / "kokkos.npz", DATA / "gmm_artifacts.npz"
# Structures of the pool that shows what the reference's start takes.
FEW = 20
# Farthest points begin with a greedy pick: the reference begins with an atom that it draws otherwise.
STRATEGIES = ["calm-greedy:{}", "calm-greedy:1 fps-extrap:{}"]

REFERENCE = r"""
import contextlib, io, json, sys, time
import pandas as pd
import tensorpotential.uq.cli.select
from tensorpotential.scripts.grace_uq import main
artifact, strategy, output, *pool = sys.argv[1:]
sys.argv = ["grace_uq", "select", "--artifact", artifact, *pool, "--output", output, "--no-element-stratified",
            "--strategy", *strategy.split()]
clock = {clock}
begun = clock()
try:
    with contextlib.redirect_stdout(io.StringIO()):
        main()
except SystemExit as end:
    if end.code:
        raise
seconds = clock() - begun
print(json.dumps([seconds, [int(atoms.info["number"]) for atoms in pd.read_pickle(output)["ase_atoms"]]]))
"""

PREDICT = r"""
import numpy as np, pandas as pd
from ase.io import read
features, rows, first = np.load("z.npy"), [], 0
for atoms in read("scored.extxyz", ":"):
    n = len(atoms)
    atoms.calc = None
    rows.append(dict(ase_atoms=atoms, energy=0.0, forces=np.zeros((n, 3)), energy_predicted=0.0,
                     forces_predicted=np.zeros((n, 3)), gamma=atoms.arrays["gamma"], sigma=atoms.arrays["sigma"],
                     features=features[first:first + n]))
    first += n
pd.DataFrame(rows).to_pickle("predicted.pkl.gz")
"""


# The clock of the reference, in its own process, and that of a command, in this one.
CLOCKS = {"wall": ("time.perf_counter", time.perf_counter)}
CLOCKS["processor"] = ("time.process_time", lambda: sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]))
clock = "wall"


def run(command, work):
    """Runs on one core. Returns the time, s, and what is printed."""
    one = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    environment = {**os.environ, **one, "CUDA_VISIBLE_DEVICES": "", "TF_CPP_MIN_LOG_LEVEL": "3"}
    now = CLOCKS[clock][1]
    begun = now()
    done = subprocess.run(["taskset", "--cpu-list", "0", *map(str, command)], cwd=work, env=environment, stdout=subprocess.PIPE,
                          stderr=open(work / "log.txt", "a"), text=True)
    if done.returncode:
        sys.exit(f"{command[0]} failed: see {work / 'log.txt'}")
    return now() - begun, done.stdout


def pool(frames, calmwalk, work):
    """Writes the pool, and tables of it, bare and predicted, and of its first structures for the reference."""
    random, known, made = np.random.default_rng(1), read(DATA / "seed_frames.extxyz", ":"), []
    for number in range(frames):
        atoms = known[number % len(known)].copy()
        atoms.calc, atoms.info = None, {"number": number}
        atoms.set_cell(atoms.cell * (1.0 + 0.04 * random.uniform(-1, 1)), scale_atoms=True)
        atoms.positions += 0.04 * (1 + number % 5) * random.uniform(-1, 1, atoms.positions.shape)
        made.append(atoms)
    write(work / "pool.extxyz", made)
    for name, some in [("few", made[:FEW]), ("pool", made)]:
        pd.DataFrame({"ase_atoms": some}).to_pickle(work / f"{name}.pkl.gz")
    run([calmwalk, "calm", "score", "--model", MODEL, "--artifact", ARTIFACT, "pool.extxyz", "--output", "scored.extxyz",
         "--features", "z.npy"], work)
    run([sys.executable, "-c", PREDICT], work)
    return sum(map(len, made))


def reference(strategy, work, pool=("--predicted", "predicted.pkl.gz")):
    """Time, s, and the picked structures."""
    _, printed = run([sys.executable, "-c", REFERENCE.replace("{clock}", CLOCKS[clock][0]), ARTIFACT, strategy, "picked.pkl.gz", *pool], work)
    return json.loads([line for line in printed.splitlines() if line.startswith("[")][-1])


def whole_reference(strategy, checkpoint, work):
    """The same from bare structures, without start and compilation."""
    model = ["--model", checkpoint / "model.yaml", "--checkpoint", checkpoint / "checkpoint.index"]
    model += ["--n-workers", 1, "--threads-per-worker", 1]
    start, _ = reference(strategy, work, ["--dataset", "few.pkl.gz", *model])
    seconds, picks = reference(strategy, work, ["--dataset", "pool.pkl.gz", *model])
    return seconds - start, picks


def same_picks(found, expected):
    """How many of the first picks are the same."""
    return next((k for k, pair in enumerate(zip(found, expected)) if pair[0] != pair[1]), min(len(found), len(expected)))


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
    parser.add_argument("--checkpoint", type=lambda text: Path(text).resolve(), help="folder with model.yaml and checkpoint")
    parser.add_argument("--processor-time", action="store_true", help="measure processor time")
    arguments = parser.parse_args()
    global clock
    clock = "processor" if arguments.processor_time else "wall"
    if arguments.checkpoint and arguments.frames <= FEW:
        parser.error(f"--frames {arguments.frames}: expected more than {FEW} with --checkpoint")
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
            picks = f"{len(found)} and {len(expected)} picks, the first {same_picks(found, expected)} the same"
            if arguments.checkpoint:
                seconds, expected = whole_reference(strategy, arguments.checkpoint, work)
                times.setdefault("reference from bare structures", []).append(seconds)
                picks += f", from bare structures {len(expected)}, the first {same_picks(found, expected)} the same"
            last = ", ".join(f"{key} {values[-1]:.2f} s" for key, values in times.items())
            print(f"{strategy}, round {number}: {last}; {picks}", flush=True)
        median = {key: statistics.median(values) for key, values in times.items()}
        print(f"{strategy}: ratio of whole commands {median['reference'] / median['own']:.1f}, "
              f"of picking {median['reference picks'] / median['own picks']:.1f}")
        if arguments.checkpoint:
            print(f"{strategy}: ratio of whole jobs {median['reference from bare structures'] / median['own']:.1f}")


if __name__ == "__main__":
    main()
