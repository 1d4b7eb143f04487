"""Measures how gracemaker trains a small GRACE-1L model further, on one core with one thread.

    python gracemaker.py CHECKPOINT WORK [--frames FILE] [--epochs N] [--random-seeds 1 2 3] [--learning-rate X] [--dense]

The Python has ASE and gracemaker (tensorpotential 0.6.2.1), whose programs are beside it. CHECKPOINT holds `model.yaml` and
`checkpoint` of `configs/data/al_eam_1l`. Every fifth of the frames, by default the seed frames of that model, is a test frame. The
others are trained with in batches of two, from the checkpoint's weights with a new optimiser: Adam with AMSGrad, learning rate
falling by half a cosine to a hundredth, Huber losses (δ 0.01) with weights 20 (energy per atom), 5 (forces) and 20 (stress).
With `--dense`, gracemaker's dense arrays of neighbours, a batch holds one frame whatever was asked for.

WORK gets `train.extxyz` and `test.extxyz`, with which other programs can do the same, and a folder for each random seed. Prints the
rate of updates, of which the first two epochs, with the compilation, are left out; and the mean absolute errors of the test frames
before the first update and after the last epoch. Runs that stand in WORK are not repeated.
"""

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

from ase.io import read, write

DATA = Path(__file__).resolve().parents[2] / "configs" / "data" / "al_eam_1l"
# Epochs with compilations.
FIRST = 2
GPA = 160.21766208  # of eV/Å³
ERRORS = {"mae/depa": ("meV/atom", 1e3), "mae/f_comp": ("meV/Å", 1e3), "mae/stress": ("GPa", GPA)}

INPUT = """
seed: {seed}
cutoff: 6.5
data: {{ filename: {work}/train.extxyz, test_filename: {work}/test.extxyz, reference_energy: 0, stress_units: eV/A3 }}
potential:
  filename: {checkpoint}/model.yaml
  checkpoint_name: {checkpoint}/checkpoint
  dense_nbr: {dense}
  param_dtype: float64
fit:
  loss:
    energy: {{ type: huber, weight: 20, delta: 0.01 }}
    forces: {{ type: huber, weight: 5, delta: 0.01 }}
    stress: {{ type: huber, weight: 20, delta: 0.01 }}
  optimizer: Adam
  opt_params: {{ learning_rate: {rate:.8f}, amsgrad: True }}
  scheduler: cosine_decay
  scheduler_params: {{ minimum_learning_rate: {last_rate:.8f}, resume_lr: False }}
  reset_epoch_and_step: True
  reset_optimizer: True
  eval_init_stats: True
  maxiter: {epochs}
  batch_size: 2
  test_batch_size: 2
  train_max_n_buckets: 1
  checkpoint_freq: {epochs}
  progressbar: False
  train_shuffle: True
  jit_compile: True
"""


def split(path, work):
    """Writes both sets of frames."""
    frames = read(path, ":")
    test = frames[::5]
    train = [atoms for number, atoms in enumerate(frames) if number % 5]
    for name, some in [("train", train), ("test", test)]:
        for atoms in some:
            # Only what ASE's calculator holds: energy, forces and stress.
            atoms.info = {}
        write(work / f"{name}.extxyz", some)
    return train, test


def cpu_seconds():
    """CPU time of the programs that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def run(folder, **values):
    """One training; its output stands in `log.txt`."""
    # A run that was interrupted left metrics, which gracemaker would append to.
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "input.yaml").write_text(INPUT.format(**values))
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "TF_NUM_INTRAOP_THREADS", "TF_NUM_INTEROP_THREADS")}
    environment = {**os.environ, **threads, "CUDA_VISIBLE_DEVICES": "", "TF_CPP_MIN_LOG_LEVEL": "3"}
    command = [str(Path(sys.executable).parent / "gracemaker"), "input.yaml"]
    begun, used = time.perf_counter(), cpu_seconds()
    with open(folder / "log.txt", "w") as log:
        if subprocess.run(command, cwd=folder, env=environment, stdout=log, stderr=log).returncode:
            sys.exit(f"gracemaker failed: see {folder / 'log.txt'}")
    (folder / "seconds.json").write_text(json.dumps([time.perf_counter() - begun, cpu_seconds() - used]))


def metrics(folder, name):
    """The table of each epoch; the first is before the first update."""
    [path] = folder.glob(f"seed/*/{name}_metrics.yaml")
    return [json.loads(line.removeprefix("- ")) for line in path.read_text().splitlines()]


def rates(epochs, atoms):
    """Updates per second of each epoch, and its duration without tests, s."""
    steps = [epoch["step"] for epoch in epochs]
    seconds = [epoch["total_time/train/per_atom"] * atoms for epoch in epochs]
    return [(step - before) / s for before, step, s in zip([0, *steps], steps, seconds)], seconds


def errors(epoch):
    return ", ".join(f"{epoch[key] * factor:.3f} {unit}" for key, (unit, factor) in ERRORS.items())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--frames", type=Path, default=DATA / "seed_frames.extxyz")
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--random-seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--dense", action="store_true")
    arguments = parser.parse_args()
    if arguments.epochs <= FIRST:
        parser.error(f"--epochs {arguments.epochs}: expected more than {FIRST}")
    work = arguments.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    # The last core that this process may use; programs that it starts inherit it.
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    train, test = split(arguments.frames, work)
    atoms = sum(map(len, train))
    print(f"{len(train)} frames ({atoms} atoms) to train with, {len(test)} for tests")
    for seed in arguments.random_seeds:
        folder = work / f"{'dense' if arguments.dense else 'sparse'}_{seed}"
        if not (folder / "seconds.json").exists():
            rate = arguments.learning_rate
            run(folder, seed=seed, work=work, checkpoint=arguments.checkpoint.resolve(), dense=arguments.dense,
                rate=rate, last_rate=rate / 100, epochs=arguments.epochs)
        trained, tested = metrics(folder, "train"), metrics(folder, "test")
        per_second, seconds = rates(trained[1:], atoms)
        later = per_second[FIRST:]
        wall, cpu = json.loads((folder / "seconds.json").read_text())
        print(f"random seed {seed}: {statistics.median(later):.2f} updates/s ({min(later):.2f}-{max(later):.2f}), "
              f"{len(train) / statistics.median(seconds[FIRST:]):.2f} frames/s; first {FIRST} epochs {sum(seconds[:FIRST]):.0f} s; "
              f"whole run {wall:.0f} s, of which it had the core for {cpu:.0f} s")
        print(f"    errors before: {errors(tested[0])}; after {trained[-1]['step']} updates: {errors(tested[-1])}", flush=True)


if __name__ == "__main__":
    main()
