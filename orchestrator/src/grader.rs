//! Grades of a structure whose features are known: γ from the mixture, γ_nbr from the structure.

use atoms::{NeighbourList, Species, Structure, StructureError, cell};
use calm::neighbourhood::{Pair, PairError, neighbourhood_average};
use calm::{GradeError, Grades, Mixture};
use store::records::AtomGrades;

/// What of a model the grades need: its elements, in index order, and its pair cutoffs.
#[derive(Clone, Debug)]
pub struct Grader {
    elements: Vec<Species>,
    pair_cutoffs: Vec<f64>,
    largest_cutoff: f64,
}

/// Why a structure cannot be graded.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GraderError {
    /// An element that the model does not know.
    #[error("atom {atom} is {species}, which the model does not know")]
    Species {
        /// Index of the atom.
        atom: usize,
        /// Its element.
        species: Species,
    },
    /// A structure that is none.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// Features that do not fit the mixture.
    #[error(transparent)]
    Grade(#[from] GradeError),
    /// Pairs that do not fit the features.
    #[error(transparent)]
    Pair(#[from] PairError),
}

impl Grader {
    /// `pair_cutoffs` is [elements × elements], Å.
    pub fn new(elements: Vec<Species>, pair_cutoffs: Vec<f64>) -> Self {
        let largest_cutoff = pair_cutoffs.iter().copied().fold(0.0, f64::max);
        Self { elements, pair_cutoffs, largest_cutoff }
    }

    /// Element index of each atom.
    pub fn element_indices(&self, structure: &Structure) -> Result<Vec<usize>, GraderError> {
        let index = |(atom, species): (usize, &Species)| {
            let known = self.elements.iter().position(|element| element == species);
            known.ok_or(GraderError::Species { atom, species: *species })
        };
        structure.species.iter().enumerate().map(index).collect()
    }

    /// The bonds of a structure within the pair cutoffs, for γ_nbr, and its shortest distance, Å.
    pub fn bonds(&self, structure: &Structure) -> Result<Bonds, GraderError> {
        let elements = self.element_indices(structure)?;
        let mut list = NeighbourList::new(self.largest_cutoff, 0.0);
        list.update(structure)?;
        let mut bonds = Bonds { elements, pairs: Vec::new(), shortest: f64::INFINITY };
        for i in 0..structure.len() {
            for neighbour in list.of(i) {
                let j = neighbour.atom as usize;
                let distance = cell::norm(neighbour.displacement(structure, i));
                let cutoff = self.pair_cutoffs[bonds.elements[i] * self.elements.len() + bonds.elements[j]];
                bonds.shortest = bonds.shortest.min(distance);
                if distance < cutoff {
                    bonds.pairs.push(Pair::new(i, j, distance, cutoff));
                }
            }
        }
        Ok(bonds)
    }
}

/// What the grades of one structure need of it, whatever the mixture.
#[derive(Clone, Debug)]
pub struct Bonds {
    /// Element index of each atom.
    pub elements: Vec<usize>,
    /// Directed pairs within their cutoffs, weighted.
    pub pairs: Vec<Pair>,
    /// Shortest distance, Å; infinite without neighbours.
    pub shortest: f64,
}

impl Bonds {
    /// γ and γ_nbr under `mixture` of atoms with these features ([n × D]).
    pub fn grade(&self, mixture: &Mixture, features: &[f64]) -> Result<AtomGrades, GraderError> {
        let mut grades = Grades::default();
        grades.evaluate(mixture, &self.elements, features, None)?;
        let gamma_nbr = neighbourhood_average(&grades.gamma, self.pairs.iter().copied())?;
        Ok(AtomGrades { gamma: grades.gamma, gamma_nbr })
    }
}
