//! Code shared by the classical potentials: supported elements and pair forces.

use atoms::{Evaluation, Neighbour, NeighbourList, PotentialError, Species, Structure, Vec3};

/// The elements of a potential and their indices in its tables.
#[derive(Clone, Debug)]
pub(crate) struct Elements {
    species: Vec<Species>,
    by_atomic_number: [u8; 119],
}

const ABSENT: u8 = u8::MAX;

impl Elements {
    /// `species` must be distinct.
    pub(crate) fn new(species: Vec<Species>) -> Self {
        let mut by_atomic_number = [ABSENT; 119];
        for (index, element) in species.iter().enumerate() {
            by_atomic_number[usize::from(element.atomic_number())] = index as u8;
        }
        Self { species, by_atomic_number }
    }

    /// The elements, in the order of the tables.
    pub(crate) fn species(&self) -> &[Species] {
        &self.species
    }

    /// Number of elements.
    pub(crate) fn len(&self) -> usize {
        self.species.len()
    }

    /// Index of a supported element in the tables.
    #[inline]
    pub(crate) fn index(&self, species: Species) -> usize {
        usize::from(self.by_atomic_number[usize::from(species.atomic_number())])
    }

    /// The indices of all atoms' elements, which must be supported.
    pub(crate) fn indices(&self, structure: &Structure, indices: &mut Vec<usize>) {
        indices.clear();
        indices.extend(structure.species.iter().map(|species| self.index(*species)));
    }

    /// Checks that a potential with these elements and this cutoff (Å) can evaluate the structure.
    pub(crate) fn check(
        &self,
        structure: &Structure,
        neighbours: &NeighbourList,
        cutoff: f64,
    ) -> Result<(), PotentialError> {
        if neighbours.cutoff() < cutoff {
            return Err(PotentialError::Cutoff { list: neighbours.cutoff(), needed: cutoff });
        }
        let known = |species: Species| self.index(species) != usize::from(ABSENT);
        match structure.species.iter().position(|species| !known(*species)) {
            None => Ok(()),
            Some(atom) => Err(PotentialError::Species {
                atom,
                species: structure.species[atom],
                known: self.species.iter().map(|s| s.symbol()).collect::<Vec<_>>().join(", "),
            }),
        }
    }
}

/// Whether the bond from `i` represents the pair: exactly one of the two directed bonds does.
#[inline]
pub(crate) fn represents_pair(i: usize, neighbour: &Neighbour) -> bool {
    let j = neighbour.atom as usize;
    j > i || (j == i && neighbour.image > [0; 3])
}

/// Adds force and virial of a pair energy E(r) of atoms i and j at d = r_j − r_i.
///
/// `slope` is E′(r) / r, eV/Å²: F_i = (E′/r) d = −F_j and W = −(E′/r) d ⊗ d.
#[inline]
pub(crate) fn add_pair_force(out: &mut Evaluation, i: usize, j: usize, d: Vec3, slope: f64) {
    for k in 0..3 {
        let force = slope * d[k];
        out.forces[i][k] += force;
        out.forces[j][k] -= force;
        for l in 0..3 {
            // This order makes the virial exactly symmetric.
            out.virial[k][l] -= slope * (d[k] * d[l]);
        }
    }
}
