//! Scores beside γ and γ_nbr that `calmwalk calm score` writes and `calm validate` tests: those of baselines, the disagreement of an
//! ensemble, and γ averaged with other weights.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use analysis::{EnsembleError, force_deviation};
use atoms::{Evaluation, Structure};
use calm::baselines::{Baseline, BaselineError, BaselineFile};
use calm::neighbourhood::PairError;
use calm::{NeighbourWeights, neighbourhood_average};
use potentials::grace::PullBack;

use super::scorer::{ScoreError, Scorer};
use crate::calm_validation::labelled::ScoreColumn;
use crate::calm_validation::{AtomScore, BaselineScore, score_own_features};
use crate::cli::CommandError;
use crate::feature_variant::FeatureModel;
use crate::features::{FeatureCalculator, FeatureError};
use crate::loaded_model::LoadedModel;

/// Baselines and models with their work arrays.
pub struct OtherScores {
    files: Vec<Scores>,
    ensemble: Vec<FeatureCalculator>,
    /// Further averages of γ.
    averages: Vec<NeighbourWeights>,
}

/// The baselines of one file.
struct Scores {
    /// The features that they score.
    model: FeatureModel,
    /// Whether γ grades the same.
    is_graded: bool,
    /// `None` if they score the features that γ grades.
    calculator: Option<FeatureCalculator>,
    /// With the names of their columns.
    baselines: Vec<(String, Arc<Baseline>)>,
}

/// Why a structure cannot be scored.
#[derive(Debug, thiserror::Error)]
pub enum OtherScoreError {
    /// It cannot be graded.
    #[error(transparent)]
    Score(#[from] ScoreError),
    #[error(transparent)]
    Features(#[from] FeatureError),
    #[error(transparent)]
    Baseline(#[from] BaselineError),
    #[error("{0}")]
    OwnFeatures(String),
    #[error(transparent)]
    Pair(#[from] PairError),
    #[error(transparent)]
    Ensemble(#[from] EnsembleError),
}

impl OtherScoreError {
    /// Whether other structures may be scored.
    pub fn is_of_structure(&self) -> bool {
        match self {
            Self::Score(error) => error.is_of_structure(),
            Self::Features(error) => error.is_of_structure(),
            _ => false,
        }
    }
}

impl OtherScores {
    /// No other score.
    pub fn none() -> Self {
        Self { files: Vec::new(), ensemble: Vec::new(), averages: Vec::new() }
    }

    /// Reads files of baselines, which must belong to the model, and further models. `graded` has the features that γ grades.
    pub fn load(
        model: &Path,
        graded: &FeatureModel,
        baselines: &[PathBuf],
        ensemble: &[PathBuf],
    ) -> Result<Self, CommandError> {
        let mut files: Vec<Scores> = Vec::new();
        for path in baselines {
            let found = scores(model, graded, path)?;
            let names = || files.iter().flat_map(|file| &file.baselines).map(|(name, _)| name);
            if let Some((name, _)) =
                found.baselines.iter().find(|(name, _)| names().any(|known| known == name))
            {
                return Err(CommandError::Input(format!(
                    "{}: another file of baselines has a score '{name}', too; expected one of each",
                    path.display()
                )));
            }
            files.push(found);
        }
        let load =
            |path: &PathBuf| LoadedModel::load(path).map(|model| FeatureCalculator::new(model.shared()));
        let ensemble = ensemble.iter().map(load).collect::<Result<_, _>>()?;
        Ok(Self { files, ensemble, averages: Vec::new() })
    }

    /// The same with γ averaged with each of these weights.
    pub fn with_averages(mut self, averages: &[NeighbourWeights]) -> Self {
        self.averages = averages.to_vec();
        self
    }

    /// The columns of [`Self::columns`], in the same order. D-optimality has the limit 1, as γ has.
    pub fn score_columns(&self) -> Vec<ScoreColumn> {
        let baselines = self.files.iter().flat_map(|file| &file.baselines);
        let limited =
            baselines.map(|(name, baseline)| (name.as_str(), matches!(**baseline, Baseline::DOptimality(_))));
        let deviation = (!self.ensemble.is_empty()).then_some(("force_deviation", false));
        let columns: Vec<_> = limited.chain(deviation).collect();
        let averages = columns.iter().map(|(name, limited)| (format!("{name}_nbr"), *limited));
        let own = columns.iter().map(|(name, limited)| ((*name).to_owned(), *limited));
        let others = own.chain(averages).map(|(name, limited)| ScoreColumn {
            name: name.replace('_', "-"),
            limit: limited.then_some(1.0),
        });
        let averages = self.averages.iter();
        others.chain(averages.map(|weights| ScoreColumn::grade(&format!("γ_{{nbr}} {weights}")))).collect()
    }

    /// The baselines as scores that `calm validate` compares γ with, named as in [`Self::score_columns`].
    pub fn baselines(&self) -> Vec<Box<dyn AtomScore>> {
        let of_file = |file: &Scores| -> Vec<Box<dyn AtomScore>> {
            let of = |(name, baseline): &(String, Arc<Baseline>)| {
                let needs_own = !file.is_graded || baseline.kind().has_force_form();
                let own = needs_own.then(|| file.model.clone());
                let score = BaselineScore::new(name.replace('_', "-"), Arc::clone(baseline), own);
                Box::new(score) as Box<dyn AtomScore>
            };
            file.baselines.iter().map(of).collect()
        };
        self.files.iter().flat_map(of_file).collect()
    }

    /// Names and values of the columns for a structure that was just scored: of each score, also its average over the
    /// neighbourhood, with the suffix `_nbr`.
    pub fn columns(
        &mut self,
        structure: &Structure,
        scorer: &Scorer,
    ) -> Result<Vec<(String, Vec<f64>)>, OtherScoreError> {
        let mut columns = Vec::new();
        for file in &mut self.files {
            if let Some(calculator) = &mut file.calculator {
                calculator.compute(structure)?;
            }
            for (name, baseline) in &file.baselines {
                let found = match &mut file.calculator {
                    Some(calculator) => score_own_features(baseline, calculator, &scorer.elements)
                        .map_err(OtherScoreError::OwnFeatures)?,
                    None => baseline.score(&scorer.elements, scorer.features())?,
                };
                columns.push((name.clone(), found));
            }
        }
        if !self.ensemble.is_empty() {
            columns.push(("force_deviation".to_owned(), self.force_deviation(structure, scorer)?));
        }
        let averages: Vec<_> = columns
            .iter()
            .map(|(name, found)| {
                let pairs = scorer.pairs.iter().copied();
                Ok((format!("{name}_nbr"), neighbourhood_average(found, pairs)?))
            })
            .collect::<Result<_, PairError>>()?;
        columns.extend(averages);
        for weights in &self.averages {
            columns.push((average_name(*weights), scorer.gamma_average(structure, *weights)?));
        }
        Ok(columns)
    }

    fn force_deviation(
        &mut self,
        structure: &Structure,
        scorer: &Scorer,
    ) -> Result<Vec<f64>, OtherScoreError> {
        let mut forces = vec![scorer.evaluation.forces.clone()];
        for model in &mut self.ensemble {
            model.compute(structure)?;
            let mut evaluation = Evaluation::default();
            model.backward(None, &mut evaluation, &mut PullBack::default()).map_err(FeatureError::from)?;
            forces.push(evaluation.forces);
        }
        Ok(force_deviation(&forces)?)
    }
}

/// `gamma_nbr_uniform_3.2` for `uniform:3.2`.
fn average_name(weights: NeighbourWeights) -> String {
    format!("gamma_nbr_{}", weights.to_string().replace(':', "_"))
}

fn scores(model: &Path, graded: &FeatureModel, path: &Path) -> Result<Scores, CommandError> {
    let file = BaselineFile::load(path).map_err(CommandError::input)?;
    let own = FeatureModel::for_baselines(model, &file.origin, path)?;
    let is_graded = own.projection() == graded.projection();
    let has_forces = file.baselines.iter().any(|baseline| baseline.kind().has_force_form());
    let prefix = match file.origin.variant.as_str() {
        _ if is_graded => String::new(),
        "normalised" | "linear" | "hidden" => format!("{}_", file.origin.variant),
        _ => "other_".to_owned(),
    };
    let named = |baseline: Baseline| {
        (format!("{prefix}{}", baseline.kind().name().replace('-', "_")), Arc::new(baseline))
    };
    let calculator = (!is_graded || has_forces).then(|| own.calculator());
    let baselines = file.baselines.into_iter().map(named).collect();
    Ok(Scores { model: own, is_graded, calculator, baselines })
}
