//! Collects scores and errors of one labelled structure after another.

use std::sync::Arc;

use analysis::{Bins, ERROR_THRESHOLDS, Exceedance, ForceErrors, LabelledEnergy, SystematicSample};
use atoms::cell::{norm, sub};
use atoms::extxyz::FrameLabels;
use atoms::{Species, Vec3, composition};

use super::deviations::Deviations;

/// Force errors above this count as large, eV/Å (paper, ROC-AUC).
pub const LARGE_ERROR: f64 = 1.0;

/// Atoms in the sample for ranks, quantiles and intervals: about 150 bytes each for two scores.
const SAMPLED_ATOMS: usize = 200_000;
/// Structures in the sample for energy offsets and the intervals of mean errors.
const SAMPLED_STRUCTURES: usize = 50_000;

/// A score of atoms; the larger it is, the larger errors are expected.
#[derive(Clone, Debug, PartialEq)]
pub struct ScoreColumn {
    /// Its name in tables, with `_{…}` for subscripts.
    pub name: String,
    /// Atoms with at most this score are taken to be reliable: 1 for γ. `None` for a score without a calibrated limit.
    pub limit: Option<f64>,
}

/// A structure with its scores, predictions and labels.
#[derive(Clone, Copy, Debug)]
pub struct LabelledStructure<'a> {
    /// Elements of the atoms, `[n]`.
    pub species: &'a [Species],
    /// Scores of the atoms, `[n]` for each column.
    pub scores: &'a [&'a [f64]],
    /// What the model predicts.
    pub predicted: &'a FrameLabels,
    /// The labels; what is missing here or in the prediction is not compared.
    pub labels: &'a FrameLabels,
}

/// Collects labelled structures. Counts, means and contamination are of all of them; ranks, quantiles, bands, intervals
/// and energy offsets are from systematic samples of at most 200,000 atoms and 50,000 structures.
pub struct LabelledErrors {
    pub(super) columns: Vec<ScoreColumn>,
    pub(super) structures: u64,
    pub(super) energy: Deviations,
    pub(super) forces: Deviations,
    pub(super) stress: Deviations,
    pub(super) atoms: SystematicSample<SampledAtom>,
    pub(super) sample: SystematicSample<SampledStructure>,
    /// Of all atoms: those kept are the ones within the limit of the column, or all atoms without a limit.
    pub(super) exceedance: Vec<Exceedance>,
    /// By bins of γ, for columns with a limit.
    pub(super) bins: Vec<Option<ForceErrors>>,
    pub(super) left_out: u64,
}

/// An atom of the sample.
#[derive(Clone, Debug)]
pub struct SampledAtom {
    /// Number of its structure.
    pub structure: u64,
    pub species: Species,
    /// Number of atoms of each element of its structure, by ascending atomic number.
    pub composition: Arc<[(u8, u32)]>,
    /// |F_model − F_label|, eV/Å.
    pub error: f64,
    /// F_model − F_label, eV/Å.
    pub difference: Vec3,
    /// One for each column.
    pub scores: Box<[f64]>,
}

/// A structure of the sample.
#[derive(Clone, Debug)]
pub struct SampledStructure {
    /// Number of atoms of each element, by ascending atomic number.
    pub composition: Arc<[(u8, u32)]>,
    /// Mean of each score over the atoms; not a number for a structure without atoms.
    pub scores: Box<[f64]>,
    pub energies: Option<LabelledEnergy>,
    /// Energy per atom, eV.
    pub energy: Deviations,
    /// Components, eV/Å.
    pub forces: Deviations,
    /// Components, eV/Å³.
    pub stress: Deviations,
}

impl ScoreColumn {
    /// An extrapolation grade, whose limit is 1.
    pub fn grade(name: &str) -> Self {
        Self { name: name.into(), limit: Some(1.0) }
    }
}

impl LabelledErrors {
    /// Nothing yet. Each structure brings a score for each of these columns.
    pub fn new(columns: Vec<ScoreColumn>) -> Self {
        Self::with_room(columns, SAMPLED_ATOMS, SAMPLED_STRUCTURES)
    }

    pub(super) fn with_room(columns: Vec<ScoreColumn>, atoms: usize, structures: usize) -> Self {
        let bins = |column: &ScoreColumn| {
            column.limit.map(|_| ForceErrors::new(Bins::for_grades(), LARGE_ERROR, atoms))
        };
        Self {
            structures: 0,
            energy: Deviations::default(),
            forces: Deviations::default(),
            stress: Deviations::default(),
            atoms: SystematicSample::new(atoms),
            sample: SystematicSample::new(structures),
            exceedance: vec![Exceedance::new(&ERROR_THRESHOLDS); columns.len()],
            bins: columns.iter().map(bins).collect(),
            left_out: 0,
            columns,
        }
    }

    /// Number of structures with any label that the model also predicts.
    pub fn structures(&self) -> u64 {
        self.structures
    }

    /// Adds a structure. Without labels, nothing changes. Atoms with a score that is not finite are only counted, so that all
    /// columns have the same atoms.
    ///
    /// # Panics
    /// If the lengths of arrays differ, or if there is not one array of scores for each column.
    pub fn add(&mut self, graded: &LabelledStructure) {
        let atoms = graded.species.len();
        let is_complete = graded.scores.iter().all(|scores| scores.len() == atoms);
        assert!(graded.scores.len() == self.columns.len() && is_complete, "a score of each atom and column");
        let structure = SampledStructure::from_labelled(graded);
        let SampledStructure { energy, forces, stress, .. } = &structure;
        if energy.number + forces.number + stress.number == 0.0 {
            return;
        }
        self.energy.merge(energy, 1);
        self.forces.merge(forces, 1);
        self.stress.merge(stress, 1);
        if let (Some(predicted), Some(labels)) = (&graded.predicted.forces, &graded.labels.forces) {
            for (atom, (a, b)) in predicted.iter().zip(labels).enumerate() {
                self.add_atom(graded, &structure.composition, atom, sub(*a, *b));
            }
        }
        self.sample.add(structure);
        self.structures += 1;
    }

    fn add_atom(
        &mut self,
        graded: &LabelledStructure,
        composition: &Arc<[(u8, u32)]>,
        atom: usize,
        difference: Vec3,
    ) {
        let error = norm(difference);
        let scores = || graded.scores.iter().map(|scores| scores[atom]);
        if !(error.is_finite() && scores().all(f64::is_finite)) {
            self.left_out += 1;
            return;
        }
        for (k, score) in scores().enumerate() {
            let is_kept = self.columns[k].limit.is_none_or(|limit| score <= limit);
            self.exceedance[k].add(error, is_kept, 1);
            if let Some(bins) = &mut self.bins[k] {
                bins.add(score, error);
            }
        }
        let structure = self.structures;
        let species = graded.species[atom];
        self.atoms.add_with(|| SampledAtom {
            structure,
            species,
            composition: Arc::clone(composition),
            error,
            difference,
            scores: scores().collect(),
        });
    }
}

impl SampledStructure {
    fn from_labelled(graded: &LabelledStructure) -> Self {
        let mean = |scores: &&[f64]| scores.iter().sum::<f64>() / scores.len() as f64;
        let mut found = Self {
            composition: composition(graded.species).into(),
            scores: graded.scores.iter().map(mean).collect(),
            energies: None,
            energy: Deviations::default(),
            forces: Deviations::default(),
            stress: Deviations::default(),
        };
        let (predicted, labels) = (graded.predicted, graded.labels);
        if let (Some(model), Some(label)) = (predicted.energy, labels.energy) {
            found.energy.add((model - label) / graded.species.len() as f64);
            found.energies = Some(LabelledEnergy { composition: found.composition.to_vec(), model, label });
        }
        if let (Some(model), Some(label)) = (&predicted.forces, &labels.forces) {
            assert!(model.len() == label.len() && model.len() == graded.species.len(), "forces of each atom");
            let pairs = model.as_flattened().iter().zip(label.as_flattened());
            pairs.for_each(|(a, b)| found.forces.add(a - b));
        }
        if let (Some(model), Some(label)) = (&predicted.stress, &labels.stress) {
            // The six components of a symmetric matrix.
            for (i, k) in [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)] {
                found.stress.add(model[i][k] - label[i][k]);
            }
        }
        found
    }
}
