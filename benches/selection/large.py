"""Measures time and memory of `calmwalk select` from a large pool of small structures.

    python large.py CALMWALK WORK [--structures N] [--strategy …]

The pool are N cells of two aluminium atoms, body-centred with random strains and displacements, which the model of
`configs/data/al_eam_1l` grades: most of their atoms are within the window. It is written once; a later run with the same N uses it
again. Prints how many atoms are within the window, the time of the whole command, s, and its peak memory, GB.
"""

import argparse
import json
import random
import resource
import subprocess
import time
from pathlib import Path

DATA = Path(__file__).resolve().parents[2] / "configs" / "data" / "al_eam_1l"
# Edge of a body-centred cell with the volume of an atom in aluminium, Å.
EDGE = 3.2


def write(path, structures):
    """Writes the pool, unless it is there."""
    if path.exists():
        return
    draw = random.Random(1)
    part = path.with_suffix(".part")
    with open(part, "w") as out:
        for _ in range(structures):
            cell = [EDGE * (1.0 + 0.08 * draw.uniform(-1, 1)) for _ in range(3)]
            moved = [edge * (0.5 + 0.1 * draw.uniform(-1, 1)) for edge in cell]
            lattice = " ".join(f"{edge if row == column else 0:.6f}" for row, edge in enumerate(cell) for column in range(3))
            out.write(f'2\nLattice="{lattice}" Properties=species:S:1:pos:R:3 pbc="T T T"\nAl 0 0 0\n')
            out.write("Al {:.6f} {:.6f} {:.6f}\n".format(*moved))
    part.rename(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calmwalk", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--structures", type=int, default=1_000_000)
    parser.add_argument("--strategy", nargs="+", default=["greedy:50", "fps:50"])
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    pool = arguments.work / f"pool_{arguments.structures}.extxyz"
    write(pool, arguments.structures)
    command = [arguments.calmwalk.resolve(), "select", "--model", DATA / "kokkos.npz", "--artifact", DATA / "gmm_artifacts.npz", pool,
               "--output", arguments.work / "selected.extxyz", "--json", "--no-element-floors", "--strategy", *arguments.strategy]
    begun = time.perf_counter()
    done = subprocess.run(list(map(str, command)), stdout=subprocess.PIPE, check=True)
    seconds = time.perf_counter() - begun
    found = json.loads(done.stdout)
    # Linux counts in KiB.
    memory = 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    counts = found["pool"]
    print(f"{counts['structures']} structures, {counts['atoms_within_window']} of {2 * counts['structures']} atoms within the window, "
          f"{len(found['picks'])} picks: {seconds:.1f} s, {1e-9 * memory:.2f} GB")


if __name__ == "__main__":
    main()
