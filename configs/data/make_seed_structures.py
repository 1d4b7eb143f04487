"""Makes the seed structures of the demo campaigns: aluminium_seeds.extxyz and silicon_seeds.extxyz.

Needs ASE. Each frame has the info key `name`; no two atoms are closer than `least` ångström.
"""

from pathlib import Path

import numpy as np
from ase import Atoms
from ase.build import bulk, diamond111, fcc111
from ase.io import write
from ase.neighborlist import neighbor_list


def scaled(atoms, factor):
    """The same structure at `factor` times its volume."""
    atoms = atoms.copy()
    atoms.set_cell(atoms.cell * factor ** (1 / 3), scale_atoms=True)
    return atoms


def strained(atoms, strain):
    """The same structure with r → r (1 + ε)."""
    atoms = atoms.copy()
    atoms.set_cell(atoms.cell @ (np.eye(3) + strain), scale_atoms=True)
    return atoms


def vacancy(atoms):
    atoms = atoms.copy()
    del atoms[len(atoms) // 2]
    return atoms


def slab(atoms, vacuum):
    """Periodic in its plane only, `vacuum` Å on each side."""
    atoms.center(vacuum=vacuum, axis=2)
    atoms.pbc = [True, True, False]
    return Atoms(atoms.symbols, atoms.positions, cell=atoms.cell, pbc=atoms.pbc)


SHEAR = [[0.02, 0.04, 0.0], [0.0, -0.01, 0.0], [0.0, 0.0, 0.0]]
UNIAXIAL = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.04]]


def aluminium():
    a = 4.05
    fcc = bulk("Al", "fcc", a=a, cubic=True)
    cell = fcc * (2, 2, 2)
    bcc = bulk("Al", "bcc", a=(2 * 17.0) ** (1 / 3), cubic=True)
    yield "fcc-100", cell
    yield "fcc-097", scaled(cell, 0.97)
    yield "fcc-103", scaled(cell, 1.03)
    yield "vacancy", vacancy(fcc * (2, 2, 3))
    yield "slab-111", slab(fcc111("Al", (2, 4, 6), a=a, orthogonal=True), vacuum=6.0)
    yield "bcc", bcc * (3, 3, 3)
    yield "sheared", strained(cell, SHEAR)
    yield "uniaxial", strained(cell, UNIAXIAL)


def silicon():
    a = 5.431
    diamond = bulk("Si", "diamond", a=a, cubic=True)
    cell = diamond * (2, 2, 2)
    # The outer layers would hang on one bond each: without them the slab ends with double layers.
    surface = diamond111("Si", (3, 3, 8), a=a)
    surface = surface[[atom.tag not in (1, 8) for atom in surface]]
    # β-tin of silicon near its coexistence with diamond: a = 4.69 Å, c/a = 0.55.
    half, c = 0.5, 0.55 * 4.69
    beta_tin = Atoms(
        "Si4",
        scaled_positions=[[0, 0, 0], [half, 0, 0.25], [half, half, half], [0, half, 0.75]],
        cell=[4.69, 4.69, c],
        pbc=True,
    )
    yield "diamond-100", cell
    yield "diamond-095", scaled(cell, 0.95)
    yield "diamond-105", scaled(cell, 1.05)
    yield "vacancy", vacancy(cell)
    yield "slab-111", slab(surface, vacuum=6.0)
    yield "beta-tin", beta_tin * (2, 2, 3)
    yield "sheared", strained(cell, SHEAR)
    yield "uniaxial", strained(cell, UNIAXIAL)


def finish(name, atoms, least):
    shortest = neighbor_list("d", atoms, least + 1.0).min()
    assert shortest > least, f"{name}: {shortest:.3f} Å"
    atoms.info = {"name": name}
    print(f"{name:12} {len(atoms):3} atoms {shortest:.3f} Å {atoms.get_volume() / len(atoms):.2f} Å³ per atom")
    return Atoms(atoms.symbols, atoms.positions, cell=atoms.cell, pbc=atoms.pbc, info=atoms.info)


if __name__ == "__main__":
    here = Path(__file__).parent
    write(here / "aluminium_seeds.extxyz", [finish(*seed, least=2.3) for seed in aluminium()])
    write(here / "silicon_seeds.extxyz", [finish(*seed, least=2.0) for seed in silicon()])
