//! What was collected, as numbers of atoms and structures: all of it, or a sample if there is more than there is room for.

use std::collections::{BTreeMap, HashMap};

use analysis::Thinned;
use atoms::cell::{norm, sub};
use atoms::{NeighbourList, Species, Structure, shortest_distance};
use store::{CollectedStructure, JobState, SeedStructure, Store, StoreError};
use wire::{ContentHash, Origin};

use super::features::Features;

/// Rows read at a time.
const PAGE: u32 = 256;
/// Atoms that are kept of either origin, 64 bytes each.
const ATOMS: usize = 1 << 18;
/// Structures that are kept of either origin.
const STRUCTURES: usize = 1 << 17;
/// Structures of either origin whose features are read.
const WITH_FEATURES: usize = 256;
/// Seed structures are looked through for neighbours as far as this, Å.
const FARTHEST: f64 = 16.0;
/// An atom without a neighbour within so many of the seed structure's distances has none.
const ALONE: f64 = 2.0;

/// Either origin.
pub struct Sample {
    /// Structures that biased walks found.
    pub biased: Collection,
    /// Frames of control walks.
    pub control: Collection,
    /// Structures of both: they tell nothing of the difference, and are left out of all but counts.
    pub shared: u64,
    /// Features of atoms, by element.
    pub features: Features,
}

/// What was collected from walks of one kind.
pub struct Collection {
    /// Every structure.
    pub structures: Thinned<Shape>,
    /// Every atom.
    pub atoms: Thinned<Atom>,
    /// How many atoms of each element.
    pub elements: BTreeMap<Species, u64>,
    /// How many structures by seed structure and what became of their labels.
    pub labels: BTreeMap<u32, Counts>,
    /// Decisions about structures whose features are looked at.
    sampled: Thinned<i64>,
}

/// What became of the labels of some structures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Structures.
    pub structures: u64,
    /// With a label.
    pub labelled: u64,
    /// Given up.
    pub failed: u64,
}

/// Of a structure.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// V/V₀.
    pub relative_volume: f64,
    /// Volume by atoms, Å³; none if a direction does not repeat.
    pub volume_per_atom: Option<f64>,
}

/// Of an atom.
#[derive(Clone, Copy, Debug)]
pub struct Atom {
    /// γ under the original mixture.
    pub gamma: f64,
    /// γ_nbr under it.
    pub gamma_nbr: f64,
    /// |F_model − F_label|, eV/Å, if there is a label.
    pub error: Option<f64>,
    /// Distance to its nearest neighbour by the shortest of the seed structure; only of labelled atoms.
    pub stretch: Option<f64>,
}

impl Sample {
    /// Reads it, page by page; features afterwards, structure by structure.
    pub async fn of(
        store: &Store,
        protocol: Option<ContentHash>,
        seeds: &[SeedStructure],
    ) -> Result<Self, StoreError> {
        let shortest = seeds.iter().filter_map(|seed| Some((seed.index, nearest(&seed.structure)?)));
        let shortest: HashMap<_, _> = shortest.collect();
        let (mut biased, mut control) = (Collection::new(), Collection::new());
        let of_both = store.structures_of_both_origins().await?;
        let mut after = 0;
        loop {
            let page = store.collected(protocol, after, PAGE).await?;
            let Some(last) = page.last() else { break };
            after = last.decision;
            for row in &page {
                let collection = if row.origin == Origin::Biased { &mut biased } else { &mut control };
                collection.count(row);
                if !of_both.contains(&row.block.view().id().content) {
                    collection.push(row, shortest.get(&row.seed_structure).copied());
                }
            }
        }
        let elements = Features::most_frequent(&biased.elements, &control.elements);
        let mut features = Features::new(&elements);
        for (origin, collection) in [(Origin::Biased, &biased), (Origin::Control, &control)] {
            for decision in collection.sampled.kept() {
                let found = store.candidates(decision - 1, true, 1).await?;
                let Some(found) = found.first().filter(|found| found.decision == *decision) else { continue };
                if let Some(numbers) = &found.features {
                    features.push(origin, &found.block.view().structure().species, numbers);
                }
            }
        }
        Ok(Self { biased, control, shared: of_both.len() as u64, features })
    }

    /// Says in a caption what is left out; nothing if nothing is.
    pub fn left_out(&self) -> String {
        match self.shared {
            0 => String::new(),
            1 => " 1 structure that a biased walk and its control have both found is left out.".to_owned(),
            shared => {
                format!(
                    " {shared} structures that biased walks and their controls have both found are left out."
                )
            }
        }
    }

    /// The collections and their names, biased walks first.
    pub fn both(&self) -> [(Origin, &Collection); 2] {
        [(Origin::Biased, &self.biased), (Origin::Control, &self.control)]
    }
}

impl Collection {
    fn new() -> Self {
        Self {
            structures: Thinned::new(STRUCTURES),
            atoms: Thinned::new(ATOMS),
            elements: BTreeMap::new(),
            labels: BTreeMap::new(),
            sampled: Thinned::new(WITH_FEATURES),
        }
    }

    fn count(&mut self, row: &CollectedStructure) {
        let counts = self.labels.entry(row.seed_structure).or_default();
        counts.structures += 1;
        counts.labelled += u64::from(row.label_forces.is_some());
        counts.failed += u64::from(row.job == Some(JobState::Failed));
    }

    fn push(&mut self, row: &CollectedStructure, shortest: Option<f64>) {
        let view = row.block.view();
        let structure = view.structure();
        let periodic = structure.periodic == [true; 3];
        let volume = structure.cell.signed_volume().abs() / structure.len() as f64;
        self.structures.push(Shape {
            relative_volume: view.relative_volume(),
            volume_per_atom: periodic.then_some(volume),
        });
        for species in &structure.species {
            *self.elements.entry(*species).or_default() += 1;
        }
        self.sampled.push(row.decision);
        self.push_atoms(row, view.forces, &structure, shortest);
    }

    fn push_atoms(
        &mut self,
        row: &CollectedStructure,
        forces: &[[f64; 3]],
        structure: &Structure,
        shortest: Option<f64>,
    ) {
        let is_labelled = row.label_forces.is_some();
        let stretches = shortest.filter(|_| is_labelled).map(|shortest| stretches(structure, shortest));
        for (k, gamma) in row.original.gamma.iter().enumerate() {
            let label = row.label_forces.as_ref().and_then(|label| label.get(k));
            self.atoms.push(Atom {
                gamma: *gamma,
                gamma_nbr: row.original.gamma_nbr.get(k).copied().unwrap_or(f64::NAN),
                error: label.zip(forces.get(k)).map(|(label, model)| norm(sub(*model, *label))),
                stretch: stretches.as_ref().and_then(|stretches| stretches.get(k).copied().flatten()),
            });
        }
    }

    /// Numbers of labelled structures.
    pub fn labelled(&self) -> u64 {
        self.labels.values().map(|counts| counts.labelled).sum()
    }
}

/// The shortest distance in a structure, Å.
fn nearest(structure: &Structure) -> Option<f64> {
    let mut reach = 4.0;
    while reach <= FARTHEST {
        let mut neighbours = NeighbourList::new(reach, 0.0);
        neighbours.update(structure).ok()?;
        if let Some((_, _, distance)) = shortest_distance(structure, &neighbours) {
            return Some(distance);
        }
        reach *= 2.0;
    }
    None
}

/// Distance of each atom to its nearest neighbour by `shortest`.
fn stretches(structure: &Structure, shortest: f64) -> Vec<Option<f64>> {
    let reach = ALONE * shortest;
    let mut neighbours = NeighbourList::new(reach, 0.0);
    if neighbours.update(structure).is_err() {
        return Vec::new();
    }
    let mut bonds = Vec::new();
    let of = |atom| {
        neighbours.bonds_within(structure, atom, reach, &mut bonds);
        bonds.iter().map(|bond| bond.r / shortest).reduce(f64::min)
    };
    (0..structure.len()).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_relative_to_the_shortest_of_the_seed_structure() {
        let row = |x: [f64; 3]| Structure {
            species: vec!["Al".parse().unwrap(); 3],
            positions: x.iter().map(|x| [*x, 0.0, 0.0]).collect(),
            cell: atoms::Cell::orthorhombic(30.0, 30.0, 30.0),
            periodic: [true; 3],
        };
        // Distances of 3 and 5 Å, and none across the cell.
        let shortest = nearest(&row([0.0, 3.0, 8.0])).unwrap();
        assert!((shortest - 3.0).abs() < 1e-12);
        let found = stretches(&row([0.0, 4.5, 9.0]), shortest);
        for stretch in &found {
            assert!((stretch.unwrap() - 1.5).abs() < 1e-12, "{found:?}");
        }
        let apart = stretches(&row([0.0, 3.0, 12.0]), shortest);
        assert!(apart[2].is_none() && (apart[0].unwrap() - 1.0).abs() < 1e-12, "{apart:?}");
        // One atom alone sees its own image; the list of 16 Å reaches 10 Å.
        let one =
            Structure { species: vec!["Al".parse().unwrap()], positions: vec![[0.0; 3]], ..row([0.0; 3]) };
        let one = Structure { cell: atoms::Cell::orthorhombic(10.0, 12.0, 12.0), ..one };
        assert!((nearest(&one).unwrap() - 10.0).abs() < 1e-12);
    }
}
