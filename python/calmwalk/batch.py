"""Many structures as one block-diagonal graph: what an adapter gets with each call."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Counts:
    """Numbers of structures, atoms and directed bonds."""

    structures: int
    atoms: int
    bonds: int


@dataclass
class Batch:
    """S structures with A atoms and B directed bonds in all. The arrays are views of shared memory: do not write to
    them, and copy what must outlive the call.

    With padding the last structure, its atoms and its bonds are spare: the bonds are longer than every cutoff. A batch
    without padding has none, and `real` equals the shapes. Results of spare atoms are not read.

    Bonds come sorted by centre. They may be longer than the cutoff, since the list has a skin: these contribute
    exactly zero.
    """

    species: np.ndarray
    """i32[A]: index into the elements of the model."""
    structure_of_atom: np.ndarray
    """i32[A]."""
    centres: np.ndarray
    """i32[B]: atom at which a bond begins."""
    neighbours: np.ndarray
    """i32[B]: atom at which a bond ends."""
    structure_of_bond: np.ndarray
    """i32[B]."""
    bonds: np.ndarray
    """f64[B, 3]: from centre to neighbour with its periodic image, Å."""
    positions: np.ndarray
    """f64[A, 3], Å. Only a model that cannot start from bonds needs positions, cells and periodic."""
    cells: np.ndarray
    """f64[S, 3, 3]: rows are lattice vectors, Å; zeros where there is no cell."""
    periodic: np.ndarray
    """u8[S, 3]: 1 along periodic lattice vectors."""
    real: Counts
    """What of the batch is not padding."""
    kept: Any = None
    """Free for the adapter: what its evaluation puts here, a pull-back of the same inputs finds here. None
    otherwise."""
    fixed: dict[str, Any] = field(default_factory=dict)
    """Free for the adapter: keeps its entries as long as species, maps, centres and neighbours stay what they are."""

    @property
    def n_structures(self) -> int:
        """S."""
        return len(self.cells)

    @property
    def n_atoms(self) -> int:
        """A."""
        return len(self.species)

    @property
    def n_bonds(self) -> int:
        """B."""
        return len(self.bonds)


def scatter(batch: Batch, bond_gradients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turns g_b = ∂X/∂(bond b), [B, 3], of any X into ∂X/∂r of each atom, f64[A, 3], and ∂X/∂ε of each structure,
    f64[S, 3, 3]:

        ∂X/∂r_j = Σ_(b to j) g_b − Σ_(b from j) g_b,      ∂X/∂ε = Σ_b g_b ⊗ bond_b

    Forces and virial of an energy are the negatives of these.
    """
    gradients = np.empty((batch.n_atoms, 3))
    strain = np.empty((batch.n_structures, 3, 3))
    for x in range(3):
        g = bond_gradients[:, x].astype(np.float64)
        gradients[:, x] = np.bincount(batch.neighbours, g, batch.n_atoms) - np.bincount(batch.centres, g, batch.n_atoms)
        for y in range(3):
            strain[:, x, y] = np.bincount(batch.structure_of_bond, g * batch.bonds[:, y], batch.n_structures)
    return gradients, strain
