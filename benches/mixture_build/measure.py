"""Measures `calmwalk calm build`, features included: against `grace_uq build`, with two threads, and its memory.

    python measure.py CALMWALK WORK peer|threads|memory [--model al|paper] [--frames N] [--rounds N] [--max-feature-cache GB]

The Python has ASE and gracemaker (tensorpotential 0.6.2.1), whose programs are beside it. The models are `al`, that of
`configs/data/al_eam_1l` (its checkpoint must be named by `--checkpoint`, a folder with `model.yaml` and `checkpoint`), and
`paper`, of the size of the paper's model for aluminium (GRACE-1L, lmax 4, 8 radial functions expanded to 32, 64 products, 12
densities; cutoff 6 Å), which is made here with random weights: the time does not depend on them. The data are the frames of
`configs/data/al_eam_1l`, repeated with random displacements of 0.02 Å.

- `peer`: both programs build from N and from 3 N frames, on one core with one thread, in turn; the differences of the two
  times are those of 2 N frames in steady state, without start and compilation. Prints the ratio of each round and the median.
- `threads`: one build of 2 N frames with two threads, against two builds of N frames at once with one thread, in turn.
- `memory`: peak memory of builds from 10⁵, 2 · 10⁵ and 10⁶ atoms with two threads, in shards of 400 structures. These are 3, 5 and
  24 shards, so each of the two threads holds a shard at every size.
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

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

import numpy as np
import pandas as pd
from ase.io import read, write

DATA = Path(__file__).resolve().parents[2] / "configs" / "data" / "al_eam_1l"
PAPER = dict(lmax=4, n_rad_max=32, prod_func_n_max=64, n_mlp_dens=12, n_rad_base=8, max_order=4, embedding_size=128)
ATOMS = 108


def gracemaker(name):
    return str(Path(sys.executable).parent / name)


def frames(count, work):
    """Paths of the frames as extended XYZ and, for gracemaker, as a pickled table; in WORK."""
    text, table = work / f"{count}.extxyz", work / f"{count}.pkl.gz"
    if not table.exists():
        known, random, made = read(DATA / "seed_frames.extxyz", ":"), np.random.default_rng(1), []
        for number in range(count):
            atoms = known[number % len(known)].copy()
            atoms.info, atoms.calc = {}, None
            atoms.positions += random.normal(0.0, 0.02, atoms.positions.shape)
            made.append(atoms)
        write(text, made)
        if count * ATOMS < 200_000:
            pd.DataFrame({"ase_atoms": made}).to_pickle(table)
    return text, table


def paper_model(work):
    """model.yaml and checkpoint with random weights."""
    if not (work / "checkpoint.index").exists():
        import tensorflow as tf
        from tensorpotential.cli.prepare import construct_model
        from tensorpotential.instructions.base import save_instructions_dict
        from tensorpotential.tensorpot import TensorPotential

        tf.random.set_seed(1)
        config = {"preset": "GRACE_1LAYER_latest", "kwargs": dict(PAPER), "dense_nbr": False}
        instructions, _ = construct_model(config, {"Al": 0}, rcut=6.0, avg_n_neigh=60.0)
        save_instructions_dict(str(work / "model.yaml"), instructions, param_dtype="float64")
        potential = TensorPotential(instructions, param_dtype=tf.float64, seed=1, eager_mode=True)
        potential.save_checkpoint(checkpoint_name=str(work / "checkpoint"))
    return work


def model_of(arguments, work):
    """The folder of the checkpoint, and the export."""
    if arguments.model == "al":
        return arguments.checkpoint, DATA / "kokkos.npz"
    folder, export = paper_model(work), work / "kokkos.npz"
    if not export.exists():
        artifact = work / "export.npz"
        timed(reference(folder, frames(20, work)[1], artifact), work, cores="0,1")
        command = [gracemaker("grace_utils"), "-p", folder / "model.yaml", "-c", folder / "checkpoint", "export_kokkos"]
        timed([*command, "-o", export, "--uq-artifacts", artifact], work, cores="0,1")
    return folder, export


def reference(folder, table, output):
    command = [gracemaker("grace_uq"), "build", "--model-yaml", folder / "model.yaml"]
    command += ["--checkpoint", folder / "checkpoint.index", "--train-data", table, "--artifact-path", output]
    return [*command, "--n-workers", 1, "--threads-per-worker", 1, "--restart", "--no-export"]


def own(arguments, export, text, output, threads=1, shard_size=1000):
    command = [arguments.calmwalk, "calm", "build", "--model", export, text, "--output", output, "--restart"]
    return [*command, "--threads", threads, "--shard-size", shard_size, "--max-feature-cache", arguments.max_feature_cache]


def start(command, work, cores):
    words = ["taskset", "--cpu-list", cores, *map(str, command)]
    return subprocess.Popen(words, cwd=work, stdout=subprocess.DEVNULL, stderr=open(work / "log.txt", "a"))


def timed(command, work, cores="0"):
    """Wall-clock and processor time of a run, s."""
    begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    process = start(command, work, cores)
    if process.wait():
        sys.exit(f"{command[0]} failed: see {work / 'log.txt'}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - begun, processor


def peer(arguments, work):
    folder, export = model_of(arguments, work)
    few, many = frames(arguments.frames, work), frames(3 * arguments.frames, work)
    atoms, ratios = 2 * arguments.frames * ATOMS, []
    for number in range(arguments.rounds):
        times = {}
        for name, data in [("few", few), ("many", many)]:
            times["reference", name] = timed(reference(folder, data[1], work / "reference.npz"), work)
            times["own", name] = timed(own(arguments, export, data[0], work / "own.npz"), work)
        wall, processor = (
            {who: times[who, "many"][kind] - times[who, "few"][kind] for who in ("reference", "own")} for kind in (0, 1)
        )
        ratios.append((wall["reference"] / wall["own"], processor["reference"] / processor["own"]))
        rates = {who: f"{atoms / processor[who]:.0f}" for who in processor}
        print(f"round {number}: atoms per second of processor time {rates}, ratio {ratios[-1][1]:.1f} "
              f"(of wall times {ratios[-1][0]:.1f}); times {times}", flush=True)
    for index, name in enumerate(("wall", "processor")):
        print(f"median ratio of {name} times: {statistics.median(ratio[index] for ratio in ratios):.1f}")


def threads(arguments, work):
    _, export = model_of(arguments, work)
    one, two = frames(arguments.frames, work)[0], frames(2 * arguments.frames, work)[0]
    size, ratios = max(1, arguments.frames // 8), []
    for number in range(arguments.rounds):
        begun = time.perf_counter()
        copies = [start(own(arguments, export, one, work / f"copy{core}.npz", 1, size), work, str(core)) for core in (0, 1)]
        if any([copy.wait() for copy in copies]):
            sys.exit(f"a build failed: see {work / 'log.txt'}")
        copies = time.perf_counter() - begun
        together, _ = timed(own(arguments, export, two, work / "two.npz", 2, size), work, cores="0,1")
        ratios.append(copies / together)
        print(f"round {number}: two copies {copies:.2f} s, two threads {together:.2f} s, ratio {ratios[-1]:.3f}", flush=True)
    print(f"median ratio: {statistics.median(ratios):.3f}")


def memory(arguments, work):
    _, export = model_of(arguments, work)
    for atoms in (10**5, 2 * 10**5, 10**6):
        text = frames(-(-atoms // ATOMS), work)[0]
        command = own(arguments, export, text, work / "own.npz", threads=2, shard_size=400)
        words = ["/usr/bin/time", "--format", '{"kB": %M, "wall": %e, "user": %U}', *map(str, command)]
        found = subprocess.run(words, cwd=work, capture_output=True, text=True)
        if found.returncode:
            sys.exit(found.stderr)
        used = json.loads(found.stderr.strip().splitlines()[-1])
        print(f"{atoms} atoms: {used['kB'] / 1024:.0f} MB, {used['wall']:.0f} s, {used['user']:.0f} s of processor time", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calmwalk", type=lambda text: Path(text).resolve())
    parser.add_argument("work", type=Path)
    parser.add_argument("what", choices=["peer", "threads", "memory"])
    parser.add_argument("--model", choices=["al", "paper"], default="al")
    parser.add_argument("--checkpoint", type=lambda text: Path(text).resolve(), help="folder with model.yaml and checkpoint, for al")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--max-feature-cache", type=float, default=4, help="GB; 0: features are computed in each pass")
    arguments = parser.parse_args()
    work = arguments.work.resolve() / arguments.model
    work.mkdir(parents=True, exist_ok=True)
    {"peer": peer, "threads": threads, "memory": memory}[arguments.what](arguments, work)


if __name__ == "__main__":
    main()
