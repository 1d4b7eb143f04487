//! Grades of a structure with known features: γ from the mixture, γ_nbr from the structure.

use atoms::{NeighbourList, ShortestDistances, Species, Structure, StructureError, cell};
use calm::neighbourhood::{Pair, PairError, neighbourhood_average};
use calm::{GradeError, Grades, Mixture};
use store::records::AtomGrades;

/// The parts of a model that grading needs: its elements, in index order, and its pair cutoffs.
#[derive(Clone, Debug)]
pub struct Grader {
    elements: Vec<Species>,
    pair_cutoffs: Vec<f64>,
    largest_cutoff: f64,
}

/// Why a structure cannot be graded.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GraderError {
    /// An element that the model does not support.
    #[error("atom {atom} is {species}, which the model does not support")]
    Species {
        /// Index of the atom.
        atom: usize,
        /// Its element.
        species: Species,
    },
    /// An invalid structure.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// Features that do not match the mixture.
    #[error(transparent)]
    Grade(#[from] GradeError),
    /// Pairs that do not match the features.
    #[error(transparent)]
    Pair(#[from] PairError),
}

impl Grader {
    /// `pair_cutoffs` is [elements × elements], Å.
    pub fn new(elements: Vec<Species>, pair_cutoffs: Vec<f64>) -> Self {
        let largest_cutoff = pair_cutoffs.iter().copied().fold(0.0, f64::max);
        Self { elements, pair_cutoffs, largest_cutoff }
    }

    /// Chemical symbols by element index.
    pub fn symbols(&self) -> Vec<String> {
        self.elements.iter().map(|species| species.symbol().to_owned()).collect()
    }

    /// Element index of each atom.
    pub fn element_indices(&self, structure: &Structure) -> Result<Vec<usize>, GraderError> {
        let index = |(atom, species): (usize, &Species)| {
            let known = self.elements.iter().position(|element| element == species);
            known.ok_or(GraderError::Species { atom, species: *species })
        };
        structure.species.iter().enumerate().map(index).collect()
    }

    /// The bonds of a structure within the pair cutoffs, for γ_nbr, and its shortest distances.
    pub fn bonds(&self, structure: &Structure) -> Result<StructureBonds, GraderError> {
        let elements = self.element_indices(structure)?;
        let mut list = NeighbourList::new(self.largest_cutoff, 0.0);
        list.update(structure)?;
        let mut bonds =
            StructureBonds { elements, pairs: Vec::new(), shortest: ShortestDistances::new(structure) };
        self.compute_pairs(structure, &list, &mut bonds);
        Ok(bonds)
    }

    /// Computes the weights of all pairs, in the order of the list, each bond together with its reverse.
    ///
    /// Visiting the atoms in order fills the pairs of each atom starting from its first neighbour. The images of a
    /// neighbour are in ascending order on both sides, so the first on one side is the reverse of the last on the
    /// other.
    fn compute_pairs(&self, structure: &Structure, list: &NeighbourList, bonds: &mut StructureBonds) {
        let StructureBonds { elements, pairs, shortest } = bonds;
        let cutoff = |i: usize, j: usize| self.pair_cutoffs[elements[i] * self.elements.len() + elements[j]];
        let mut next = Vec::with_capacity(list.len());
        let mut directed = 0;
        for i in 0..list.len() {
            next.push(directed);
            directed += list.neighbours_of(i).len();
        }
        pairs.resize(directed, Pair { i: 0, j: 0, weight: 0.0 });
        for i in 0..list.len() {
            let below = list.neighbours_of(i).partition_point(|neighbour| (neighbour.atom as usize) < i);
            for images in list.neighbours_of(i)[below..].chunk_by(|a, b| a.atom == b.atom) {
                let j = images[0].atom as usize;
                for (k, neighbour) in images.iter().enumerate() {
                    let displacement = neighbour.displacement(structure, i);
                    let squared = cell::dot(displacement, displacement);
                    shortest.add(i, j, squared);
                    let distance = squared.sqrt();
                    let pair = Pair::new(i, j, distance, cutoff(i, j));
                    let reverse = if cutoff(j, i) == cutoff(i, j) {
                        Pair { i: j, j: i, ..pair }
                    } else {
                        Pair::new(j, i, distance, cutoff(j, i))
                    };
                    // The pairs of an atom with its own images are each other's reverse, with the same weight.
                    for (place, pair) in [(next[j] + images.len() - 1 - k, reverse), (next[i] + k, pair)] {
                        // Rounding can leave a bond without its reverse only if atoms are extremely far away.
                        if let Some(slot) = pairs.get_mut(place) {
                            *slot = pair;
                        }
                    }
                }
                next[i] += images.len();
                if j != i {
                    next[j] += images.len();
                }
            }
        }
    }
}

/// The data of a structure that grading needs, independent of the mixture.
#[derive(Clone, Debug)]
pub struct StructureBonds {
    /// Element index of each atom.
    pub elements: Vec<usize>,
    /// Directed pairs within the largest cutoff, with weights; the weight is 0 beyond the cutoff of the pair.
    pub pairs: Vec<Pair>,
    /// Shortest distance of each pair of elements.
    pub shortest: ShortestDistances,
}

impl StructureBonds {
    /// γ and γ_nbr under `mixture`, for atoms with these features ([n × D]).
    pub fn grade(&self, mixture: &Mixture, features: &[f64]) -> Result<AtomGrades, GraderError> {
        let mut grades = Grades::default();
        grades.evaluate(mixture, &self.elements, features, None)?;
        let gamma_nbr = neighbourhood_average(&grades.gamma, self.pairs.iter().copied())?;
        Ok(AtomGrades { gamma: grades.gamma, gamma_nbr })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A skew cell much smaller than the cutoffs, two elements, cutoffs that differ with the direction of a bond.
    #[test]
    fn pairs_equal_those_computed_separately() {
        let elements: Vec<Species> = vec!["Al".parse().unwrap(), "Si".parse().unwrap()];
        let cutoffs = [6.0, 5.0, 4.5, 5.5];
        for periodic in [[true; 3], [true, false, true], [false; 3]] {
            let structure = Structure {
                species: [0, 1, 0, 1].map(|k| elements[k]).to_vec(),
                positions: vec![[0.1, 0.2, 0.3], [1.9, -7.2, 1.4], [0.4, 2.1, 9.7], [2.2, 1.8, 2.6]],
                cell: atoms::Cell([[3.1, 0.2, 0.0], [-0.9, 4.2, 0.3], [0.6, 0.1, 3.7]]),
                periodic,
            };
            let bonds = Grader::new(elements.clone(), cutoffs.to_vec()).bonds(&structure).unwrap();
            let mut list = NeighbourList::new(6.0, 0.0);
            list.update(&structure).unwrap();
            let mut expected = Vec::new();
            for i in 0..structure.len() {
                for neighbour in list.neighbours_of(i) {
                    let (j, r) = (neighbour.atom as usize, cell::norm(neighbour.displacement(&structure, i)));
                    expected.push(Pair::new(i, j, r, cutoffs[i % 2 * 2 + j % 2]));
                }
            }
            assert_eq!(bonds.pairs, expected);
            assert_eq!(bonds.shortest, ShortestDistances::from_neighbours(&structure, &list));
        }
    }
}
