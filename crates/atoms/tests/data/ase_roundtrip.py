"""Extended XYZ between ASE and the reader and writer of this crate.

    ase_roundtrip.py sample   writes ase_sample.extxyz and ase_sample.json (what ASE reads from it)
    ase_roundtrip.py dump F…  prints what ASE reads from the files F, as JSON
"""

import json
import sys
from pathlib import Path

import numpy as np
from ase import Atoms
from ase.build import bulk, fcc111, molecule
from ase.calculators.singlepoint import SinglePointCalculator
from ase.constraints import FixAtoms, FixCartesian
from ase.io import read, write


def plain(value):
    """Lists and scalars of Python; numbers that are not finite as text."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value


def free(atoms):
    """[n × 3], whether the constraints let an atom move."""
    mask = np.ones((len(atoms), 3), dtype=bool)
    for constraint in atoms.constraints:
        if isinstance(constraint, FixCartesian):
            mask[constraint.index] &= ~constraint.mask
        else:
            mask[constraint.index] = False
    return mask


def dump(path):
    """What ASE reads, frame by frame; results and constraints apart, as ASE holds them."""
    frames = []
    for atoms in read(path, ":"):
        arrays = {key: atoms.arrays[key] for key in atoms.arrays if key not in ("numbers", "positions")}
        frames.append(
            {
                "numbers": plain(atoms.numbers),
                "positions": plain(atoms.positions),
                "cell": plain(atoms.cell.array),
                "pbc": plain(atoms.pbc),
                "info": {key: plain(value) for key, value in atoms.info.items()},
                "arrays": {key: plain(value) for key, value in arrays.items()},
                "results": {key: plain(value) for key, value in atoms.calc.results.items()} if atoms.calc else {},
                "free": plain(free(atoms)),
            }
        )
    return frames


def sample():
    rng = np.random.default_rng(7)
    labelled = bulk("NaCl", "rocksalt", a=5.64, cubic=True)
    n = len(labelled)
    labelled.rattle(0.1, rng=rng)
    strain = rng.normal(size=(3, 3))
    labelled.calc = SinglePointCalculator(
        labelled,
        energy=-27.123456789012345,
        free_energy=-27.2,
        forces=rng.normal(size=(n, 3)),
        stress=(strain + strain.T)[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]],
        magmoms=rng.normal(size=n),
    )
    labelled.info = {
        "config_type": "rattled",
        "description": 'a "quoted" text, with = and [brackets]',
        "temperature": 300,
        "pressure": 1e-7,
        "large": 1.5e300,
        "converged": True,
        "failed": np.bool_(False),
        "steps": np.arange(3),
        "weights": np.array([0.1, 1.0, 1e20]),
        "flags": np.array([True, False, True]),
        "one": [5],
        "matrix": rng.normal(size=(2, 3)),
        "integers": np.arange(4).reshape(2, 2),
        "masks": np.array([[True, False], [False, False]]),
        "names": ["Na", "Cl ion"],
        "nested": {"a": [1, 2], "b": None},
        "not_finite": np.array([np.nan, np.inf, -np.inf]),
        "uid": "123",
        "dashed-key": "x",
        "a key": 1,
    }
    labelled.set_tags(range(n))
    labelled.set_masses(rng.uniform(20, 40, n))
    labelled.set_initial_charges(rng.normal(size=n))
    labelled.set_array("group", rng.integers(-9, 9, (n, 2)))
    labelled.set_array("surface", rng.random(n) > 0.5)
    labelled.set_array("mask", rng.random((n, 3)) > 0.5)
    labelled.set_array("label", np.array([f"site{i}" for i in range(n)]))
    labelled.set_array("tensor", rng.normal(size=(n, 9)))

    slab = fcc111("Al", (1, 2, 3), a=4.05, orthogonal=True)
    slab.set_constraint(FixAtoms([0, 3]))
    slab.info = {"name": "slab"}

    water = molecule("H2O")
    water.info = {"REF_energy": -14.2, "comment": "no cell"}
    water.arrays["REF_forces"] = rng.normal(size=(3, 3))

    wire = Atoms("W", [[0.1, 0.2, 0.3]], cell=[[3, 0.1, 0.2], [0.3, 9, 0.4], [0.5, 0.6, 9]], pbc=[True, False, False])
    wire.info = {"virial": np.array([[1.0, 0.5, 0.25], [0.5, 2.0, 0.125], [0.25, 0.125, 3.0]]), "energy": -11}

    hydride = bulk("PdH", "rocksalt", a=4.1, cubic=True)
    hydride.set_constraint([FixCartesian(1, [True, False, True]), FixAtoms([2])])
    return [labelled, slab, water, wire, hydride]


if __name__ == "__main__":
    if sys.argv[1:] == ["sample"]:
        here = Path(__file__).parent
        write(here / "ase_sample.extxyz", sample())
        text = json.dumps(dump(here / "ase_sample.extxyz"), indent=1)
        (here / "ase_sample.json").write_text(text + "\n")
    elif sys.argv[1:2] == ["dump"]:
        json.dump([frame for path in sys.argv[2:] for frame in dump(path)], sys.stdout)
    else:
        sys.exit(__doc__)
