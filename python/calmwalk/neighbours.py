"""Neighbour lists and batches of small structures, in plain numpy: for tests of adapters. calmwalk makes its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from .batch import Batch, Counts


@dataclass
class Structure:
    """Atoms, with or without periodic directions."""

    species: np.ndarray
    """i32[n]: index into the elements of a model."""
    positions: np.ndarray
    """f64[n, 3], Å."""
    cell: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """f64[3, 3]: rows are lattice vectors, Å."""
    periodic: tuple[bool, bool, bool] = (False, False, False)


def bonds_of(structure: Structure, cutoff: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All directed bonds up to a length, Å, sorted by centre: centres [b], neighbours [b], vectors [b, 3]. Tries all
    pairs of atoms in all images that can be near enough."""
    found = []
    for image in product(*(range(-n, n + 1) for n in _images(structure, cutoff))):
        shift = np.array(image) @ structure.cell
        vectors = structure.positions[None, :, :] + shift - structure.positions[:, None, :]
        near = np.einsum("ijx,ijx->ij", vectors, vectors) <= cutoff**2
        if image == (0, 0, 0):
            near &= ~np.eye(len(near), dtype=bool)
        i, j = np.nonzero(near)
        found.append((i, j, vectors[i, j]))
    centres, neighbours, vectors = (np.concatenate(part) for part in zip(*found))
    order = np.argsort(centres, kind="stable")
    return centres[order], neighbours[order], vectors[order]


def _images(structure: Structure, cutoff: float) -> list[int]:
    if not any(structure.periodic):
        return [0, 0, 0]
    # Distance between lattice planes; atoms may lie outside the cell.
    heights = 1 / np.linalg.norm(np.linalg.inv(structure.cell), axis=0)
    fractions = structure.positions @ np.linalg.inv(structure.cell)
    spread = np.ptp(fractions, axis=0)
    return [int(np.ceil(cutoff / h + s)) if p else 0 for h, s, p in zip(heights, spread, structure.periodic)]


def batch_of(structures: Sequence[Structure], cutoff: float, spare: tuple[int, int, int] = (0, 0, 0)) -> Batch:
    """One batch of structures with all bonds up to a length, Å, and spare structures, atoms and bonds: of each kind
    at least one, or all three zero."""
    bonds = [bonds_of(structure, cutoff) for structure in structures]
    atoms = [len(structure.species) for structure in structures]
    starts = np.concatenate([[0], np.cumsum(atoms)])[:-1]
    real = Counts(len(structures), sum(atoms), sum(len(vectors) for _, _, vectors in bonds))
    more_structures, more_atoms, more_bonds = spare
    last_atom, last_structure = real.atoms + more_atoms - 1, real.structures + more_structures - 1
    which = np.arange(real.structures)

    def padded(parts: list[np.ndarray], more: int, value: float, dtype: type) -> np.ndarray:
        array = np.concatenate(parts) if parts else np.empty(0)
        return np.concatenate([array, np.full((more, *array.shape[1:]), value)]).astype(dtype)

    vectors = padded([v for _, _, v in bonds], more_bonds, 0.0, np.float64)
    vectors[real.bonds :, 0] = 100 + 2 * cutoff
    return Batch(
        species=padded([s.species for s in structures], more_atoms, 0, np.int32),
        structure_of_atom=padded([np.repeat(which, atoms)], more_atoms, last_structure, np.int32),
        centres=padded([i + start for (i, _, _), start in zip(bonds, starts)], more_bonds, last_atom, np.int32),
        neighbours=padded([j + start for (_, j, _), start in zip(bonds, starts)], more_bonds, last_atom, np.int32),
        structure_of_bond=padded(
            [np.repeat(which, [len(v) for _, _, v in bonds])], more_bonds, last_structure, np.int32
        ),
        bonds=vectors,
        positions=padded([s.positions for s in structures], more_atoms, 0.0, np.float64),
        cells=padded([s.cell[None] for s in structures], more_structures, 0.0, np.float64),
        periodic=padded([np.array([s.periodic]) for s in structures], more_structures, 0, np.uint8),
        real=real,
    )
