//! The probability that the calculation of a label completes, learned from the finished labels of a campaign.
//!
//! The model knows labels of one protocol, of structures from walks with one version of the potential: grades of different
//! versions cannot be compared.

use analysis::{ReliabilityDiagram, logistic_regression};
use serde::Serialize;
use store::{FinishedStructure, Store, StoreError};
use wire::{CompletionCoefficients, CompletionPredictors, ContentHash};

/// Number of finished structures that a model is fitted to: the newest.
pub const MAX_FINISHED: u32 = 1_000;

/// Finished structures that a regression needs, and labelled and failed ones of them. With fewer, the observed share is the
/// probability of every structure.
pub const MIN_FINISHED: usize = 20;
/// See [`MIN_FINISHED`].
pub const MIN_OF_EACH: usize = 3;

/// λ of [`logistic_regression`]: as if each coefficient were known to be 0 ± 1 for predictors with a standard deviation of 1.
const RIDGE_PENALTY: f64 = 1.0;

/// Parts into which finished structures are divided to judge the model: each is predicted by a model of the others.
const FOLDS: usize = 5;

/// Number of bins of the reliability diagram.
const RELIABILITY_BINS: usize = 10;

/// A structure whose label is finished.
#[derive(Clone, Debug, PartialEq)]
pub struct CompletionExample {
    /// What the probability depends on.
    pub predictors: CompletionPredictors,
    /// Whether it has a label; otherwise all attempts failed.
    pub completed: bool,
}

/// The model, and what it was learned from.
#[derive(Clone, Debug, PartialEq)]
pub struct CompletionModel {
    /// The probability.
    pub coefficients: CompletionCoefficients,
    /// Finished structures.
    pub finished: usize,
    /// Of them, those that failed.
    pub failed: usize,
}

impl CompletionModel {
    /// Learns from these structures; `None` without any.
    pub fn fit(examples: &[CompletionExample]) -> Option<Self> {
        let finished = examples.len();
        let failed = examples.iter().filter(|example| !example.completed).count();
        if finished == 0 {
            return None;
        }
        let is_enough = finished >= MIN_FINISHED && failed.min(finished - failed) >= MIN_OF_EACH;
        let coefficients = is_enough.then(|| regression(examples)).flatten();
        let share = (finished - failed) as f64 / finished as f64;
        let coefficients = coefficients.unwrap_or_else(|| CompletionCoefficients::constant(share));
        Some(Self { coefficients, finished, failed })
    }

    /// The probability that the label of a structure completes.
    pub fn probability(&self, predictors: &CompletionPredictors) -> f64 {
        self.coefficients.probability(predictors)
    }
}

fn regression(examples: &[CompletionExample]) -> Option<CompletionCoefficients> {
    let fractions = examples.iter().flat_map(|example| &example.predictors.fractions);
    let mut elements: Vec<u8> = fractions.map(|(element, _)| *element).collect();
    elements.sort_unstable();
    elements.dedup();
    let rows: Vec<_> = examples.iter().map(|example| example.predictors.row(&elements)).collect();
    let outcomes: Vec<_> = examples.iter().map(|example| example.completed).collect();
    let coefficients = logistic_regression(&rows, &outcomes, RIDGE_PENALTY)?;
    let (intercept, weights) = coefficients.split_first()?;
    Some(CompletionCoefficients { elements, intercept: *intercept, weights: weights.to_vec() })
}

/// How reliable the model is: predictions of finished structures by models that were learned from others.
///
/// The structures are divided in the order in which they were found, every fifth into the same part. Nothing is predicted
/// from parts in which nothing is finished.
pub fn reliability(examples: &[CompletionExample]) -> ReliabilityDiagram {
    let mut diagram = ReliabilityDiagram::new(RELIABILITY_BINS);
    for fold in 0..FOLDS {
        let is_left_out = |place: usize| place % FOLDS == fold;
        let others = examples.iter().enumerate().filter(|(place, _)| !is_left_out(*place));
        let others: Vec<_> = others.map(|(_, example)| example.clone()).collect();
        let Some(model) = CompletionModel::fit(&others) else { continue };
        for (_, example) in examples.iter().enumerate().filter(|(place, _)| is_left_out(*place)) {
            diagram.add(model.probability(&example.predictors), example.completed);
        }
    }
    diagram
}

/// What a finished structure teaches; `None` for one that has no neighbour list.
pub fn example_of(finished: &FinishedStructure) -> Option<CompletionExample> {
    let FinishedStructure { gamma, relative_volume, structure, labelled, .. } = finished;
    let predictors =
        CompletionPredictors::of_structure(structure, gamma.unwrap_or(f64::NAN), *relative_volume).ok()?;
    Some(CompletionExample { predictors, completed: *labelled })
}

/// The finished structures of the store under `protocol` from walks with `version` of the potential: the newest, newest first.
pub async fn examples(
    store: &Store,
    protocol: ContentHash,
    version: u32,
) -> Result<Vec<CompletionExample>, StoreError> {
    let finished = store.finished_structures(protocol, version, MAX_FINISHED).await?;
    Ok(finished.iter().filter_map(example_of).collect())
}

/// The model of a campaign and its reliability, for views.
#[derive(Clone, Debug, Serialize)]
pub struct CompletionReport {
    /// Version of the potential whose walks found the structures.
    pub version: u32,
    /// Finished structures that the model was learned from.
    pub finished: usize,
    /// Of them, those that failed.
    pub failed: usize,
    /// Whether a regression predicts the probability; otherwise it is the share of labelled structures.
    pub is_regression: bool,
    /// Coefficients per unit of each predictor, by name; empty without a regression.
    pub coefficients: Vec<(String, f64)>,
    /// Mean square of predicted probability minus outcome, each predicted from the other structures.
    pub brier_score: Option<f64>,
    /// The same if the share of labelled structures were predicted for each.
    pub brier_score_of_share: Option<f64>,
    /// The reliability diagram.
    pub reliability: Vec<CompletionReliability>,
}

/// The predictions within a range.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CompletionReliability {
    /// Lower end of the range.
    pub from: f64,
    /// Upper end.
    pub to: f64,
    /// Structures predicted to be in it.
    pub structures: u64,
    /// Mean predicted probability.
    pub predicted: Option<f64>,
    /// Share of them that was labelled.
    pub observed: Option<f64>,
    /// 95 % interval of that share.
    pub low: Option<f64>,
    /// Its upper end.
    pub high: Option<f64>,
}

impl CompletionReport {
    /// Reads the store; `None` before the first finished label.
    pub async fn read(
        store: &Store,
        protocol: ContentHash,
        version: u32,
    ) -> Result<Option<Self>, StoreError> {
        let examples = examples(store, protocol, version).await?;
        let Some(model) = CompletionModel::fit(&examples) else { return Ok(None) };
        let diagram = reliability(&examples);
        Ok(Some(Self {
            version,
            finished: model.finished,
            failed: model.failed,
            is_regression: !model.coefficients.is_constant(),
            coefficients: named(&model.coefficients),
            brier_score: diagram.brier_score(),
            brier_score_of_share: diagram.brier_score_of_share(),
            reliability: rows(&diagram),
        }))
    }
}

fn rows(diagram: &ReliabilityDiagram) -> Vec<CompletionReliability> {
    let bins = diagram.bins().into_iter().filter(|bin| bin.number > 0);
    let row = |bin: analysis::ReliabilityBin| {
        let (low, high) = bin.interval.unzip();
        CompletionReliability {
            from: bin.from,
            to: bin.to,
            structures: bin.number,
            predicted: bin.predicted,
            observed: bin.observed,
            low,
            high,
        }
    };
    bins.map(row).collect()
}

/// The weights with the names of their predictors.
fn named(coefficients: &CompletionCoefficients) -> Vec<(String, f64)> {
    let fixed = ["intercept", "ln γ_max", "V/V₀", "(V/V₀)²", "shortest bond"].map(str::to_owned);
    let elements = coefficients.elements.iter().skip(1);
    let names = fixed.into_iter().chain(elements.map(|number| atoms::element_symbol(*number).to_owned()));
    let values = [coefficients.intercept].into_iter().chain(coefficients.weights.iter().copied());
    match coefficients.is_constant() {
        true => Vec::new(),
        false => names.zip(values).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn predictors(gamma_max: f64, relative_volume: f64) -> CompletionPredictors {
        CompletionPredictors { gamma_max, relative_volume, shortest_bond: 0.9, fractions: vec![(13, 1.0)] }
    }

    /// The random number of a place, between 0 and 1 (Steele, Lea and Flood's SplitMix64).
    fn uniform(place: usize) -> f64 {
        let mut z = (place as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Structures whose labels fail more often the larger their volume.
    fn expanded(number: usize) -> Vec<CompletionExample> {
        let example = |place: usize| {
            let volume = 0.8 + 0.8 * uniform(3 * place);
            let probability = 1.0 / (1.0 + (12.0 * (volume - 1.3)).exp());
            let completed = uniform(3 * place + 1) < probability;
            CompletionExample { predictors: predictors(1.0 + uniform(3 * place + 2), volume), completed }
        };
        (0..number).map(example).collect()
    }

    #[test]
    fn the_share_holds_until_there_is_enough_to_learn_from() {
        assert_eq!(CompletionModel::fit(&[]), None);
        let examples = expanded(400);
        let (labelled, failed): (Vec<_>, Vec<_>) =
            examples.into_iter().partition(|example| example.completed);
        let of = |labels: usize, failures: usize| {
            let all: Vec<_> = labelled[..labels].iter().chain(&failed[..failures]).cloned().collect();
            CompletionModel::fit(&all).unwrap()
        };
        for (labels, failures) in [(16, 3), (18, 2), (2, 30)] {
            let model = of(labels, failures);
            let share = labels as f64 / (labels + failures) as f64;
            assert!(model.coefficients.is_constant(), "{labels} {failures}");
            assert!((model.probability(&predictors(1.0, 1.6)) - share).abs() < 1e-12);
        }
        assert_eq!(of(5, 0).probability(&predictors(1.0, 1.0)), 1.0);
        assert!(!of(17, 3).coefficients.is_constant());
    }

    #[test]
    fn it_learns_what_makes_labels_fail_and_is_judged_on_others() {
        let examples = expanded(600);
        let model = CompletionModel::fit(&examples).unwrap();
        let at = |volume: f64| model.probability(&predictors(1.5, volume));
        assert!(at(1.0) > 0.9 && (at(1.3) - 0.5).abs() < 0.12 && at(1.55) < 0.15, "{model:?}");
        let diagram = reliability(&examples);
        assert_eq!(diagram.number(), 600);
        assert!(diagram.brier_score().unwrap() < 0.6 * diagram.brier_score_of_share().unwrap());
        for bin in diagram.bins().iter().filter(|bin| bin.number >= 40) {
            assert!((bin.predicted.unwrap() - bin.observed.unwrap()).abs() < 0.1, "{bin:?}");
        }
        assert_eq!(named(&model.coefficients).len(), 5, "one element has no coefficient");
    }
}
