//! What is said of labelled structures.

use analysis::{ElementOffset, ErrorBin, QuantileBin};
use atoms::element_symbol;
use serde::Serialize;

/// Errors of a model, and what scores of atoms say about them. JSON has these names; quantities that are not defined are
/// null.
#[derive(Clone, Debug, Serialize)]
pub struct LabelledReport {
    /// Structures with a label that the model predicts.
    pub structures: u64,
    /// Atoms with a force label and finite scores, which the statistics of the scores are of.
    pub atoms: u64,
    /// Atoms left out because of a score or force that is not finite.
    pub left_out: u64,
    /// Atoms in the sample that ranks, quantiles, bands and intervals are from, and their structures.
    pub sampled_atoms: usize,
    pub sampled_structures: usize,
    /// How intervals are made: with structures as units.
    pub bootstrap: BootstrapSettings,
    /// Energy, eV/atom.
    pub energy: MeanErrors,
    /// The same without the offset of each element.
    pub energy_without_offsets: MeanErrors,
    /// Offsets of label minus model that were removed, eV/atom.
    pub offsets: Vec<Offset>,
    /// Components of forces, eV/Å.
    pub forces: MeanErrors,
    /// Components of the stress, eV/Å³.
    pub stress: MeanErrors,
    /// Thresholds of the force error |F_model − F_label|, eV/Å, of all curves below.
    pub thresholds: Vec<f64>,
    /// Share of the atoms with a force error above each threshold.
    pub unfiltered: Vec<Option<f64>>,
    /// One for each score.
    pub scores: Vec<ScoreReport>,
    /// Force errors and scores of the sampled atoms by element.
    pub elements: Vec<ElementErrors>,
    /// Errors and scores by the share of an element; none if all structures have one composition.
    pub compositions: Vec<CompositionScan>,
}

#[derive(Clone, Copy, Debug, Serialize)]
pub struct BootstrapSettings {
    pub draws: u32,
    pub level: f64,
    pub seed: u64,
}

/// A value with its confidence interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct IntervalEstimate {
    pub value: Option<f64>,
    pub interval: Option<(f64, f64)>,
}

/// Mean absolute and root mean square error.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct MeanErrors {
    /// Number of differences.
    pub number: f64,
    pub mean_absolute: IntervalEstimate,
    pub root_mean_square: IntervalEstimate,
}

/// Offset of an element, eV/atom.
#[derive(Clone, Debug, Serialize)]
pub struct Offset {
    pub element: &'static str,
    pub offset: f64,
    /// Whether the compositions determine it by itself.
    pub is_separate: bool,
}

/// What is said of a score.
#[derive(Clone, Debug, Serialize)]
pub struct ScoreReport {
    pub name: String,
    /// Atoms with at most this score are taken to be reliable.
    pub limit: Option<f64>,
    /// Spearman's ρ of score and force error.
    pub spearman: IntervalEstimate,
    /// Spearman's ρ of the mean score of a sampled structure and the absolute error of its energy per atom, without the offsets of
    /// elements.
    pub energy_spearman: Option<f64>,
    /// Area under the ROC curve for force errors above each threshold.
    pub auc: Vec<IntervalEstimate>,
    /// Area under the ROC curve for the tenth of the atoms of an element with the largest force errors: mean over elements.
    pub worst_decile: IntervalEstimate,
    /// The same for each element.
    pub worst_decile_by_element: Vec<ElementAuc>,
    /// What the limit keeps.
    pub confident: Option<Confident>,
    /// Force errors by bins of the score, for scores with a limit.
    pub bins: Vec<Bin>,
    /// Quantiles of the force error in logarithmic bins of the score.
    pub bands: Vec<Band>,
    /// Sampled atoms by force error: within and beyond the limit.
    pub error_histograms: Option<ErrorHistograms>,
    /// The same of the absolute errors of the components of their forces, three for each atom.
    pub component_histograms: Option<ErrorHistograms>,
}

#[derive(Clone, Debug, Serialize)]
pub struct ElementAuc {
    pub element: &'static str,
    /// Sampled atoms.
    pub atoms: usize,
    /// The 90 % quantile of their force errors, eV/Å.
    pub threshold: f64,
    pub auc: IntervalEstimate,
}

/// The atoms with a score within its limit.
#[derive(Clone, Debug, Serialize)]
pub struct Confident {
    /// Their share of all atoms.
    pub retention: IntervalEstimate,
    /// Share of them with a force error above each threshold.
    pub contamination: Vec<IntervalEstimate>,
}

/// Force errors of the atoms in a bin of the score, eV/Å.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Bin {
    pub above: Option<f64>,
    pub up_to: Option<f64>,
    pub atoms: u64,
    /// Share of all atoms.
    pub share: f64,
    pub median: IntervalEstimate,
    pub p90: IntervalEstimate,
    pub p99: Option<f64>,
    /// Share of the atoms of the bin with a force error above 1 eV/Å.
    pub large: IntervalEstimate,
}

/// Quantiles of the force error of the sampled atoms between two scores, eV/Å.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Band {
    pub low: f64,
    pub high: f64,
    pub atoms: u64,
    /// 5, 10, 25, 50, 75, 90 and 95 %; null in an empty bin.
    pub quantiles: Option<[f64; 7]>,
}

#[derive(Clone, Debug, Serialize)]
pub struct ErrorHistograms {
    /// Edges of the bins, eV/Å.
    pub edges: Vec<f64>,
    /// Of atoms with a score up to the limit, and of those with a larger one.
    pub populations: [ErrorPopulation; 2],
}

/// Force errors of sampled atoms, or their components, eV/Å.
#[derive(Clone, Debug, Serialize)]
pub struct ErrorPopulation {
    /// Errors by bin.
    pub counts: Vec<u64>,
    pub mean: Option<f64>,
    pub median: Option<f64>,
}

/// The sampled atoms of an element.
#[derive(Clone, Debug, Serialize)]
pub struct ElementErrors {
    pub element: &'static str,
    pub atoms: usize,
    /// |F_model − F_label|, eV/Å.
    pub forces: ErrorSpread,
    /// One for each score.
    pub scores: Vec<ScoreMean>,
    /// Spearman's ρ of each score and force error.
    pub spearman: Vec<Option<f64>>,
}

/// Structures by the share of an element among their atoms.
#[derive(Clone, Debug, Serialize)]
pub struct CompositionScan {
    pub element: &'static str,
    /// By ascending share.
    pub groups: Vec<CompositionGroup>,
}

/// Sampled structures of about one share, and the sampled atoms of such structures.
#[derive(Clone, Debug, Serialize)]
pub struct CompositionGroup {
    /// The nearest multiple of 10 %.
    pub share: f64,
    pub structures: usize,
    /// |E_model − E_label| per atom without the offsets of elements, eV. Structures without an energy, or with a composition whose
    /// offset too few structures support, do not count.
    pub energy: Option<ErrorSpread>,
    pub atoms: usize,
    /// |F_model − F_label|, eV/Å.
    pub forces: Option<ErrorSpread>,
    /// One for each score; none without atoms.
    pub scores: Vec<ScoreMean>,
}

/// Distribution of an absolute error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ErrorSpread {
    pub number: usize,
    pub mean: f64,
    /// 10, 25, 50, 75 and 90 %.
    pub quantiles: [f64; 5],
}

/// A score of several atoms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ScoreMean {
    pub mean: f64,
    /// Share of the atoms beyond the limit of the score.
    pub beyond: Option<f64>,
}

/// Mean absolute errors on the training data, with which others are compared.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrainingErrors {
    /// Energy per atom without the offsets of elements, eV.
    pub energy: Option<f64>,
    /// |F_model − F_label|, eV/Å.
    pub force: Option<f64>,
}

impl LabelledReport {
    /// γ, the first of the scores.
    pub fn grade(&self) -> Option<&ScoreReport> {
        self.scores.first()
    }

    /// γ_nbr, the second of the scores: γ and γ_nbr come before all others.
    pub fn average(&self) -> Option<&ScoreReport> {
        self.scores.get(1)
    }

    /// The index of a threshold.
    pub fn threshold(&self, threshold: f64) -> Option<usize> {
        self.thresholds.iter().position(|found| *found == threshold)
    }
}

impl ErrorSpread {
    pub fn median(&self) -> f64 {
        self.quantiles[2]
    }
}

impl Bin {
    /// With the intervals of median, 90 % quantile and share of large errors.
    pub fn new(bin: &ErrorBin, [median, p90, large]: [Option<(f64, f64)>; 3]) -> Self {
        let estimate = |value, interval| IntervalEstimate { value, interval };
        Self {
            above: bin.above,
            up_to: bin.up_to,
            atoms: bin.atoms,
            share: bin.share,
            median: estimate(bin.median, median),
            p90: estimate(bin.p90, p90),
            p99: bin.p99,
            large: estimate(bin.large, large),
        }
    }
}

impl From<QuantileBin> for Band {
    fn from(bin: QuantileBin) -> Self {
        Self { low: bin.low, high: bin.high, atoms: bin.number, quantiles: bin.quantiles }
    }
}

impl From<ElementOffset> for Offset {
    fn from(of: ElementOffset) -> Self {
        Self { element: element_symbol(of.element), offset: of.offset, is_separate: of.is_separate }
    }
}
