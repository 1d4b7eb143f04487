//! What the training data have of the compositions that the solid solutions scan (paper, figure of the chemical extrapolation).

use std::collections::BTreeMap;

use atoms::{Bond, NeighbourList, Species, Structure};
use serde::Serialize;

use super::labelled::TrainingErrors;
use super::solutions::lattice;

/// Training structures of the pairs of elements.
#[derive(Clone, Debug, Serialize)]
pub struct TrainingCompositions {
    /// Structures read.
    pub structures: u64,
    /// One for each pair of elements.
    pub pairs: Vec<TrainingPair>,
    /// The model's errors on them; `None` without labels.
    pub errors: Option<TrainingErrors>,
}

/// Training structures of two elements alone.
#[derive(Clone, Debug, Serialize)]
pub struct TrainingPair {
    #[serde(skip)]
    species: [Species; 2],
    /// The elements.
    pub elements: [String; 2],
    /// Structures of these elements alone.
    pub structures: u64,
    /// The smallest and the largest share of the second element in such a structure.
    pub range: Option<[f64; 2]>,
    /// Their atoms by the composition of their first shell.
    pub shells: Vec<TrainingShell>,
    /// By whether the atom is of the second element, and by its nearest neighbours of that element.
    #[serde(skip)]
    counts: BTreeMap<(bool, usize), u64>,
}

/// Atoms of training structures with the same first shell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrainingShell {
    /// The element of the atoms.
    pub element: String,
    /// Share of the second element among their nearest neighbours.
    pub fraction: f64,
    /// Number of atoms.
    pub atoms: u64,
}

impl TrainingCompositions {
    /// Nothing yet.
    pub fn new(pairs: &[[Species; 2]]) -> Self {
        let pair = |species: &[Species; 2]| TrainingPair {
            species: *species,
            elements: species.map(|species| species.to_string()),
            structures: 0,
            range: None,
            shells: Vec::new(),
            counts: BTreeMap::new(),
        };
        Self { structures: 0, pairs: pairs.iter().map(pair).collect(), errors: None }
    }

    /// Adds a structure, with the neighbours of its atoms within the cutoff of the model.
    pub fn add(&mut self, structure: &Structure, neighbours: &NeighbourList) {
        self.structures += 1;
        self.pairs.iter_mut().for_each(|pair| pair.add(structure, neighbours));
    }

    /// With the errors, if the structures have labels.
    pub fn finish(mut self, errors: Option<TrainingErrors>) -> Self {
        self.errors = errors;
        for pair in &mut self.pairs {
            let (_, _, shell) = lattice(pair.species);
            let group = |((is_second, neighbours), atoms): (&(bool, usize), &u64)| TrainingShell {
                element: pair.elements[usize::from(*is_second)].clone(),
                fraction: *neighbours as f64 / shell as f64,
                atoms: *atoms,
            };
            pair.shells = pair.counts.iter().map(group).collect();
        }
        self
    }
}

impl TrainingPair {
    /// The first shell of an atom is its nearest neighbours, as many as the lattice of the solid solutions has. Atoms with fewer
    /// neighbours have none.
    fn add(&mut self, structure: &Structure, neighbours: &NeighbourList) {
        let [_, second] = self.species;
        if structure.is_empty() || structure.species.iter().any(|species| !self.species.contains(species)) {
            return;
        }
        self.structures += 1;
        let is_second = |atom: usize| structure.species[atom] == second;
        let number = (0..structure.len()).filter(|atom| is_second(*atom)).count();
        let share = number as f64 / structure.len() as f64;
        let [low, high] = self.range.unwrap_or([share; 2]);
        self.range = Some([low.min(share), high.max(share)]);
        let (_, _, shell) = lattice(self.species);
        let mut bonds: Vec<Bond> = Vec::new();
        for atom in 0..structure.len() {
            neighbours.bonds_within(structure, atom, f64::INFINITY, &mut bonds);
            if bonds.len() < shell {
                continue;
            }
            bonds.sort_by(|a, b| a.r.total_cmp(&b.r));
            let of_second = bonds[..shell].iter().filter(|bond| is_second(bond.atom as usize)).count();
            *self.counts.entry((is_second(atom), of_second)).or_default() += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use atoms::prototypes::Prototype;

    use super::*;

    /// CsCl: all eight nearest neighbours of an atom are of the other element.
    #[test]
    fn structures_and_first_shells_of_a_pair_are_counted() {
        let [mo, w, si] = ["Mo", "W", "Si"].map(|symbol| symbol.parse::<Species>().unwrap());
        let mut training = TrainingCompositions::new(&[[mo, w]]);
        let mut list = NeighbourList::new(5.0, 0.0);
        let pure = Prototype::Bcc.structure(mo, 2.7);
        let mut ordered = pure.clone();
        ordered.species[1] = w;
        let mut other = pure.clone();
        other.species[1] = si;
        // The cubic cell of bcc.
        assert_eq!(pure.len(), 2);
        for structure in [&pure, &ordered, &other] {
            list.update(structure).unwrap();
            training.add(structure, &list);
        }
        let found = training.finish(None);
        assert_eq!((found.structures, found.errors), (3, None));
        let [pair] = &found.pairs[..] else { panic!("{found:?}") };
        assert_eq!((pair.structures, pair.range), (2, Some([0.0, 0.5])));
        let of = |element: &str, fraction, atoms| TrainingShell { element: element.into(), fraction, atoms };
        assert_eq!(pair.shells, [of("Mo", 0.0, 2), of("Mo", 1.0, 1), of("W", 0.0, 1)]);
    }
}
