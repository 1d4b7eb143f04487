//! The probability that the calculation of a label completes, learned from the finished labels of a campaign.
//!
//! The model knows labels of one protocol, of structures from walks with one version of the potential: grades of different
//! versions cannot be compared. As long as a version has too few of its own, it learns from those of all versions, without γ.

use std::collections::BTreeMap;

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
const PARTS: usize = 5;

/// Number of bins of the reliability diagram.
const RELIABILITY_BINS: usize = 10;

/// A structure whose label is finished.
#[derive(Clone, Debug, PartialEq)]
pub struct CompletionExample {
    /// What the probability depends on.
    pub predictors: CompletionPredictors,
    /// Whether it has a label; otherwise all attempts failed.
    pub completed: bool,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Number of the biased walk; for a control frame, of the one that its walk matches.
    pub walk: u32,
}

/// The finished structures that a version learns from.
#[derive(Clone, Debug, PartialEq)]
pub struct CompletionExamples {
    /// Newest first.
    pub examples: Vec<CompletionExample>,
    /// Whether they are of all versions, and their γ_max is 1, so that nothing is learned from it.
    pub of_all_versions: bool,
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
        let coefficients = is_enough(examples).then(|| regression(examples)).flatten();
        let share = (finished - failed) as f64 / finished as f64;
        let coefficients = coefficients.unwrap_or_else(|| CompletionCoefficients::constant(share));
        Some(Self { coefficients, finished, failed })
    }

    /// The probability that the label of a structure completes.
    pub fn probability(&self, predictors: &CompletionPredictors) -> f64 {
        self.coefficients.probability(predictors)
    }
}

/// Whether there are enough for a regression.
fn is_enough(examples: &[CompletionExample]) -> bool {
    let completed = examples.iter().filter(|example| example.completed).count();
    examples.len() >= MIN_FINISHED && completed.min(examples.len() - completed) >= MIN_OF_EACH
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
/// Frames of one walk resemble each other, and so do walks from one seed structure. The parts therefore consist of whole seed
/// structures, or, with fewer than five, of whole walks, each biased walk with its control. A single walk predicts nothing.
pub fn reliability(examples: &[CompletionExample]) -> ReliabilityDiagram {
    let mut diagram = ReliabilityDiagram::new(RELIABILITY_BINS);
    let parts = parts(examples);
    for part in 0..PARTS {
        let (own, others): (Vec<_>, Vec<_>) =
            examples.iter().cloned().zip(&parts).partition(|(_, of)| **of == part);
        let others: Vec<_> = others.into_iter().map(|(example, _)| example).collect();
        let Some(model) = CompletionModel::fit(&others) else { continue };
        for (example, _) in own {
            diagram.add(model.probability(&example.predictors), example.completed);
        }
    }
    diagram
}

/// The part of each structure.
fn parts(examples: &[CompletionExample]) -> Vec<usize> {
    let numbered = |of: fn(&CompletionExample) -> u32| {
        let mut numbers: BTreeMap<u32, usize> = examples.iter().map(|example| (of(example), 0)).collect();
        numbers.values_mut().enumerate().for_each(|(place, number)| *number = place);
        (numbers.len(), examples.iter().map(|example| numbers[&of(example)] % PARTS).collect::<Vec<_>>())
    };
    let (seed_structures, parts) = numbered(|example| example.seed_structure);
    if seed_structures >= PARTS { parts } else { numbered(|example| example.walk).1 }
}

/// The finished structures of the store under `protocol` from walks with `version` of the potential (`None`: any), newest first.
async fn examples_of(
    store: &Store,
    protocol: ContentHash,
    version: Option<u32>,
) -> Result<Vec<CompletionExample>, StoreError> {
    let matched = store.matched_walks().await?;
    let finished = store.finished_structures(protocol, version, MAX_FINISHED).await?;
    let example = |finished: &FinishedStructure| {
        let FinishedStructure { walk, seed_structure, gamma, relative_volume, structure, labelled, .. } =
            finished;
        // Without a neighbour list nothing is known.
        let predictors =
            CompletionPredictors::of_structure(structure, gamma.unwrap_or(f64::NAN), *relative_volume);
        Some(CompletionExample {
            predictors: predictors.ok()?,
            completed: *labelled,
            seed_structure: *seed_structure,
            walk: matched.get(walk).copied().unwrap_or(*walk),
        })
    };
    Ok(finished.iter().filter_map(example).collect())
}

/// What a version learns from: its own finished structures, or those of all versions without their grades, where only these are enough.
pub async fn examples(
    store: &Store,
    protocol: ContentHash,
    version: u32,
) -> Result<CompletionExamples, StoreError> {
    let own = examples_of(store, protocol, Some(version)).await?;
    match is_enough(&own) {
        true => Ok(CompletionExamples { examples: own, of_all_versions: false }),
        false => with_other_versions(store, protocol, own).await,
    }
}

/// These examples of one version; those of all versions without their grades, if only these are enough.
pub(crate) async fn with_other_versions(
    store: &Store,
    protocol: ContentHash,
    own: Vec<CompletionExample>,
) -> Result<CompletionExamples, StoreError> {
    if !is_enough(&own) && !store.walk_versions().await?.is_single() {
        let mut examples = examples_of(store, protocol, None).await?;
        if is_enough(&examples) {
            examples.iter_mut().for_each(|example| example.predictors.gamma_max = 1.0);
            return Ok(CompletionExamples { examples, of_all_versions: true });
        }
    }
    Ok(CompletionExamples { examples: own, of_all_versions: false })
}

/// The model of a campaign and its reliability, for views.
#[derive(Clone, Debug, Serialize)]
pub struct CompletionReport {
    /// Version of the potential whose walks found the structures.
    pub version: u32,
    /// Whether they are those of all versions, without γ, because too few labels of this one are finished.
    pub of_all_versions: bool,
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
        let CompletionExamples { examples, of_all_versions } = examples(store, protocol, version).await?;
        let Some(model) = CompletionModel::fit(&examples) else { return Ok(None) };
        let diagram = reliability(&examples);
        Ok(Some(Self {
            version,
            of_all_versions,
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
    let fixed = ["intercept", "ln γ₀_max", "V/V₀", "(V/V₀)²", "shortest bond"].map(str::to_owned);
    let elements = coefficients.elements.iter().skip(1);
    let names = fixed.into_iter().chain(elements.map(|number| atoms::element_symbol(*number).to_owned()));
    let values = [coefficients.intercept].into_iter().chain(coefficients.weights.iter().copied());
    match coefficients.is_constant() {
        true => Vec::new(),
        false => names.zip(values).collect(),
    }
}

#[cfg(test)]
mod tests;
