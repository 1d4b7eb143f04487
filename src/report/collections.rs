//! Statistics of the collected structures and their atoms, sampled if there are too many.

use std::collections::{BTreeMap, HashMap, HashSet};

use analysis::SystematicSample;
use atoms::cell::{norm, sub};
use atoms::{NeighbourList, Species, Structure, shortest_distance};
use store::{CollectedStructure, JobState, SeedStructure, Store, StoreError, WalkVersions};
use wire::{ContentHash, Origin};

use super::features::FeaturesByElement;

/// Rows read at a time.
const PAGE_ROWS: u32 = 256;
/// Largest number of atoms kept of each origin, 64 bytes each.
const MAX_ATOMS: usize = 1 << 18;
/// Largest number of structures kept of each origin.
const MAX_STRUCTURES: usize = 1 << 17;
/// Largest number of structures of each origin whose features are read.
const MAX_WITH_FEATURES: usize = 256;
/// Largest cutoff of the neighbour search in seed structures, Å.
const MAX_NEIGHBOUR_CUTOFF: f64 = 16.0;
/// Cutoff of the nearest neighbour, in units of the seed structure's shortest distance.
const MAX_STRETCH: f64 = 2.0;

/// The collected structures of both origins, from walks with one version of the potential: features and grades of different
/// versions cannot be compared. Counts of labels are of all versions.
pub struct Collections {
    /// The version. `None` in a campaign whose walks all had version 0.
    pub version: Option<u32>,
    /// Structures from biased walks.
    pub biased: OriginCollection,
    /// Frames of control walks.
    pub control: OriginCollection,
    /// Structures of both origins. They say nothing about the difference, so everything but the counts excludes them.
    pub shared: u64,
    /// Features of atoms, by element.
    pub features: FeaturesByElement,
}

/// The collected structures of one origin.
pub struct OriginCollection {
    /// Sizes of structures.
    pub structures: SystematicSample<StructureSize>,
    /// Grades and errors of atoms.
    pub atoms: SystematicSample<CollectedAtom>,
    /// Number of atoms of each element.
    pub elements: BTreeMap<Species, u64>,
    /// Numbers of structures by seed structure and status of their labels.
    pub labels: BTreeMap<u32, LabelCounts>,
    /// Number of structures with labels among those from walks with the version.
    pub labelled_of_version: u64,
    /// Decisions about the structures whose features are read.
    sampled: SystematicSample<i64>,
}

/// Numbers of structures by status of their labels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LabelCounts {
    /// All structures.
    pub structures: u64,
    /// With a label.
    pub labelled: u64,
    /// Failed for good.
    pub failed: u64,
}

/// Size of a structure.
#[derive(Clone, Copy, Debug)]
pub struct StructureSize {
    /// V/V₀.
    pub relative_volume: f64,
    /// Volume per atom, Å³. `None` unless it is periodic in three directions.
    pub volume_per_atom: Option<f64>,
}

/// Grades and error of an atom.
#[derive(Clone, Copy, Debug)]
pub struct CollectedAtom {
    /// γ under the original mixture.
    pub gamma: f64,
    /// γ_nbr under the original mixture.
    pub gamma_nbr: f64,
    /// |F_model − F_label|, eV/Å, if there is a label.
    pub error: Option<f64>,
    /// Distance to the nearest neighbour in units of the seed structure's shortest distance. Only of labelled atoms.
    pub stretch: Option<f64>,
}

impl Collections {
    /// Reads the structures page by page, then the features one structure at a time. `version` is that of the potential.
    pub async fn read(
        store: &Store,
        protocol: Option<ContentHash>,
        seeds: &[SeedStructure],
        versions: &WalkVersions,
        version: u32,
    ) -> Result<Self, StoreError> {
        let shortest = seeds.iter().filter_map(|seed| Some((seed.index, nearest(&seed.structure)?)));
        let shortest: HashMap<_, _> = shortest.collect();
        let (mut biased, mut control) = (OriginCollection::new(), OriginCollection::new());
        let of_both = store.structures_of_both_origins().await?;
        let (mut after, mut shared) = (0, HashSet::new());
        loop {
            let page = store.collected(protocol, after, PAGE_ROWS).await?;
            let Some(last) = page.last() else { break };
            after = last.decision;
            for row in &page {
                let collection = if row.origin == Origin::Biased { &mut biased } else { &mut control };
                let id = row.block.view().id();
                let is_of_version = versions.version_of(id.walk.0) == version;
                collection.count(row, is_of_version);
                match (is_of_version, of_both.contains(&id.content)) {
                    (false, _) => {}
                    (true, true) => drop(shared.insert(id.content)),
                    (true, false) => collection.add(row, shortest.get(&row.seed_structure).copied()),
                }
            }
        }
        let elements = FeaturesByElement::most_frequent(&biased.elements, &control.elements);
        let mut features = FeaturesByElement::new(&elements);
        for (origin, collection) in [(Origin::Biased, &biased), (Origin::Control, &control)] {
            for decision in collection.sampled.items() {
                let found = store.candidates(decision - 1, true, 1).await?;
                let Some(found) = found.first().filter(|found| found.decision == *decision) else { continue };
                if let Some(numbers) = &found.features {
                    features.add(origin, &found.block.view().structure().species, numbers);
                }
            }
        }
        let version = (!versions.is_single()).then_some(version);
        Ok(Self { version, biased, control, shared: shared.len() as u64, features })
    }

    /// Sentence of a caption about the version of the potential. Empty in a campaign whose walks all had version 0.
    pub fn of_version(&self) -> String {
        let sentence = |version| format!(" Only from walks with version {version} of the potential.");
        self.version.map_or(String::new(), sentence)
    }

    /// Sentence of a caption about excluded structures. Empty if there are none.
    pub fn left_out(&self) -> String {
        match self.shared {
            0 => String::new(),
            1 => " 1 structure found by both a biased walk and its control is excluded.".to_owned(),
            shared => {
                format!(" {shared} structures found by both biased walks and their controls are excluded.")
            }
        }
    }

    /// Both collections, biased walks first.
    pub fn both(&self) -> [(Origin, &OriginCollection); 2] {
        [(Origin::Biased, &self.biased), (Origin::Control, &self.control)]
    }
}

impl OriginCollection {
    fn new() -> Self {
        Self {
            structures: SystematicSample::new(MAX_STRUCTURES),
            atoms: SystematicSample::new(MAX_ATOMS),
            elements: BTreeMap::new(),
            labels: BTreeMap::new(),
            labelled_of_version: 0,
            sampled: SystematicSample::new(MAX_WITH_FEATURES),
        }
    }

    fn count(&mut self, row: &CollectedStructure, is_of_version: bool) {
        self.labelled_of_version += u64::from(is_of_version && row.label_forces.is_some());
        let counts = self.labels.entry(row.seed_structure).or_default();
        counts.structures += 1;
        counts.labelled += u64::from(row.label_forces.is_some());
        counts.failed += u64::from(row.job == Some(JobState::Failed));
    }

    fn add(&mut self, row: &CollectedStructure, shortest: Option<f64>) {
        let view = row.block.view();
        let structure = view.structure();
        let periodic = structure.periodic == [true; 3];
        let volume = structure.cell.signed_volume().abs() / structure.len() as f64;
        self.structures.add(StructureSize {
            relative_volume: view.relative_volume(),
            volume_per_atom: periodic.then_some(volume),
        });
        for species in &structure.species {
            *self.elements.entry(*species).or_default() += 1;
        }
        self.sampled.add(row.decision);
        self.add_atoms(row, view.forces, &structure, shortest);
    }

    fn add_atoms(
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
            self.atoms.add(CollectedAtom {
                gamma: *gamma,
                gamma_nbr: row.original.gamma_nbr.get(k).copied().unwrap_or(f64::NAN),
                error: label.zip(forces.get(k)).map(|(label, model)| norm(sub(*model, *label))),
                stretch: stretches.as_ref().and_then(|stretches| stretches.get(k).copied().flatten()),
            });
        }
    }

    /// Number of labelled structures of all versions.
    pub fn labelled(&self) -> u64 {
        self.labels.values().map(|counts| counts.labelled).sum()
    }
}

/// The shortest distance in a structure, Å.
fn nearest(structure: &Structure) -> Option<f64> {
    let mut reach = 4.0;
    while reach <= MAX_NEIGHBOUR_CUTOFF {
        let mut neighbours = NeighbourList::new(reach, 0.0);
        neighbours.update(structure).ok()?;
        if let Some((_, _, distance)) = shortest_distance(structure, &neighbours) {
            return Some(distance);
        }
        reach *= 2.0;
    }
    None
}

/// Distance of each atom to its nearest neighbour, in units of `shortest`.
fn stretches(structure: &Structure, shortest: f64) -> Vec<Option<f64>> {
    let reach = MAX_STRETCH * shortest;
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
