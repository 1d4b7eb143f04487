//! Tests of an extrapolation grade. Most need no labels: bond scans, defects, solid solutions and colliding environments (paper,
//! 'Minimal validation tests for an extrapolation grade' and 'Structural and compositional extrapolation'). `labelled` compares grades
//! with labels.
//!
//! One file per test, each with its results as plain data; `figures`, `tables` and `text` make a page of them. Random numbers are a
//! function of the random seed, so the same input gives the same bytes for any number of threads.

mod baseline_score;
mod bond_scans;
mod collisions;
mod defects;
mod detection;
mod ensemble;
mod feature_plane;
mod figures;
mod grader;
pub mod labelled;
mod minimum;
mod mixture_score;
mod own_features;
mod progress;
mod random;
mod set_names;
mod solutions;
mod tables;
mod text;
mod training;

use std::sync::Arc;

use atoms::Species;
use calm::Mixture;
use md::Fire;
use serde::Serialize;

use self::labelled::LabelledSet;
use crate::exit_status::CommandError;
use crate::loaded_model::LoadedModel;

pub use self::baseline_score::{BaselineScore, score_own_features};
pub use self::bond_scans::BondScan;
pub use self::collisions::octagon::Collision;
pub use self::collisions::ranks::FeatureRank;
pub use self::collisions::search::MatchedPair;
pub use self::defects::Defect;
pub use self::detection::{Detection, DetectionRule};
pub use self::ensemble::EnergySpread;
pub use self::feature_plane::{FeaturePlane, FeaturePlanes};
pub use self::grader::{AtomScore, ValidationGrader};
pub use self::mixture_score::MixtureScore;
pub use self::progress::ValidationProgress;
pub use self::solutions::Solution;
pub use self::tables::{both, verdict};
pub use self::text::{PAGE, files};
pub use self::training::TrainingCompositions;

/// What is tested, and how closely.
#[derive(Clone, Debug, Serialize)]
pub struct ValidationSettings {
    /// The elements with prototypes and defects.
    #[serde(skip)]
    pub elements: Vec<Species>,
    /// Pairs of elements whose solid solutions are scanned.
    #[serde(skip)]
    pub pairs: Vec<[Species; 2]>,
    /// Distances of a bond scan.
    pub scan_steps: usize,
    /// How positions in defects are relaxed; `None` keeps the ideal ones.
    #[serde(skip)]
    pub relaxation: Option<Fire>,
    /// Random structures of each composition of a solid solution.
    pub solution_structures: usize,
    /// Evaluations of each minimisation that searches colliding environments; 0 searches none.
    pub collision_evaluations: usize,
    /// Random seed of the solid solutions and the searched environments.
    pub seed: u64,
}

/// All results.
#[derive(Clone, Debug, Serialize)]
pub struct Validation {
    /// Elements of the model.
    pub elements: Vec<String>,
    /// Cutoff of the model, Å.
    pub cutoff: f64,
    /// How closely it was tested.
    pub settings: ValidationSettings,
    /// The scores, γ first. Lists of scores below are in this order.
    pub scores: Vec<ScoreDescription>,
    /// Bond scans, of each element its ground state first.
    pub bond_scans: Vec<BondScan>,
    /// Vacancies, surfaces and grain boundaries.
    pub defects: Vec<Defect>,
    /// Solid solutions.
    pub solutions: Vec<Solution>,
    /// Colliding environments.
    pub collisions: Vec<Collision>,
    /// Pairs of environments found by minimisation.
    pub matched_pairs: Vec<MatchedPair>,
    /// Directions that features of an environment tell apart.
    pub feature_ranks: Vec<FeatureRank>,
    /// Components of the mixture and labelled atoms in the plane of the features; none without the statistics of an artifact.
    pub feature_planes: Vec<FeaturePlane>,
    /// What labelled structures say, one for each file of them.
    pub labelled: Vec<LabelledSet>,
    /// What the training data have, if they were given.
    pub training: Option<TrainingCompositions>,
}

/// A score and what its bond scans show.
#[derive(Clone, Debug, Serialize)]
pub struct ScoreDescription {
    /// Its name.
    pub name: String,
    /// When it detects a regime.
    pub rule: Option<DetectionRule>,
    /// Whether it detects the regimes in the scans of all ground states.
    pub detection: Detection,
}

/// The model, the mixture and further scores.
#[derive(Clone)]
pub struct Subject {
    pub model: LoadedModel,
    pub mixture: Arc<Mixture>,
    /// Scores to compare γ with.
    pub others: Arc<[Box<dyn AtomScore>]>,
}

/// What was found with labelled structures before the tests without labels.
pub struct LabelledResults {
    /// One for each file of labelled structures.
    pub sets: Vec<LabelledSet>,
    /// What the training data have, if they were given.
    pub training: Option<TrainingCompositions>,
    /// Components of the mixture, with labelled atoms if there are any.
    pub planes: FeaturePlanes,
}

/// Runs all tests without labels, and adds what labelled structures say. `None` if it was stopped.
pub fn run(
    subject: &Subject,
    settings: ValidationSettings,
    labelled: LabelledResults,
    progress: &ValidationProgress,
) -> Result<Option<Validation>, CommandError> {
    progress.begin(
        bond_scans::count(&settings)
            + defects::count(&settings)
            + solutions::count(&settings)
            + collisions::octagon::count(&settings)
            + collisions::search::count(&settings)
            + collisions::ranks::count(&settings),
    );
    let bond_scans = bond_scans::run(subject, &settings, progress);
    let [distances, of_others] = [true, false].map(|own| bond_scans::distances(&bond_scans, own));
    let defects = defects::run(subject, &settings, [&distances, &of_others], progress);
    let solutions = solutions::run(subject, &settings, &distances, progress)?;
    let collisions = collisions::octagon::run(subject, &settings, &distances, progress);
    let matched_pairs = collisions::search::run(subject, &settings, &distances, progress);
    let feature_ranks = collisions::ranks::run(subject, &settings, &distances, progress);
    if progress.is_stopped() {
        return Ok(None);
    }
    let described = |(k, (name, rule)): (usize, (String, Option<DetectionRule>))| ScoreDescription {
        name,
        rule,
        detection: bond_scans::combined_detection(&bond_scans, k),
    };
    Ok(Some(Validation {
        elements: subject.model.elements().iter().map(|species| species.to_string()).collect(),
        cutoff: subject.model.cutoff(),
        scores: subject.scores().into_iter().enumerate().map(described).collect(),
        settings,
        bond_scans,
        defects,
        solutions,
        collisions,
        matched_pairs,
        feature_ranks,
        feature_planes: labelled.planes.finish(),
        labelled: labelled.sets,
        training: labelled.training,
    }))
}

impl Subject {
    /// Names and rules of all scores, γ first.
    fn scores(&self) -> Vec<(String, Option<DetectionRule>)> {
        let gamma = ("γ".to_owned(), Some(DetectionRule::Threshold(1.0)));
        let others = self.others.iter().map(|score| (score.name().to_owned(), score.rule()));
        [gamma].into_iter().chain(others).collect()
    }
}
