//! Baselines as scores to compare γ with.

use std::sync::Arc;

use atoms::Structure;
use calm::baselines::{Baseline, BaselineKind};

use super::own_features::OwnFeatures;
use super::{AtomScore, DetectionRule};
use crate::feature_variant::FeatureModel;
use crate::features::FeatureCalculator;

/// A baseline, with a calculator if it needs one.
pub struct BaselineScore {
    name: String,
    baseline: Arc<Baseline>,
    /// The features of the baseline, unless it scores the features that γ grades, and these alone.
    own: Option<OwnFeatures>,
}

impl BaselineScore {
    /// `own` has the features of the baseline; `None` if it scores the features that γ grades, and these alone.
    pub fn new(name: String, baseline: Arc<Baseline>, own: Option<FeatureModel>) -> Self {
        Self { name, baseline, own: own.map(OwnFeatures::new) }
    }
}

impl AtomScore for BaselineScore {
    fn name(&self) -> &str {
        &self.name
    }

    fn rule(&self) -> Option<DetectionRule> {
        rule(self.baseline.kind())
    }

    fn for_thread(&self) -> Box<dyn AtomScore> {
        Box::new(Self {
            name: self.name.clone(),
            baseline: Arc::clone(&self.baseline),
            own: self.own.as_ref().map(OwnFeatures::for_thread),
        })
    }

    fn score(
        &mut self,
        structure: &Structure,
        elements: &[usize],
        features: &[f64],
    ) -> Result<Vec<f64>, String> {
        match &mut self.own {
            None => self.baseline.score(elements, features).map_err(|error| error.to_string()),
            Some(own) => score_own_features(&self.baseline, own.compute(structure)?, elements),
        }
    }
}

/// Scores the features that `calculator` computed last, or their forces if that is what the baseline scores.
///
/// # Errors
/// Features that the baseline cannot score, or a model that does not answer.
pub fn score_own_features(
    baseline: &Baseline,
    calculator: &mut FeatureCalculator,
    elements: &[usize],
) -> Result<Vec<f64>, String> {
    if baseline.kind().has_force_form() {
        let rows = calculator.force_rows().map_err(|error| error.to_string())?;
        if let Some(found) = baseline.score_forces(&rows).map_err(|error| error.to_string())? {
            return Ok(found);
        }
    }
    baseline.score(elements, calculator.features()).map_err(|error| error.to_string())
}

/// D-optimality detects above 1, as in the paper. Other scores have no limit. Those that have a zero are
/// judged as the paper judges the spread of an ensemble; the likelihood has none.
fn rule(kind: BaselineKind) -> Option<DetectionRule> {
    match kind {
        BaselineKind::DOptimalityElement
        | BaselineKind::DOptimalityCentred
        | BaselineKind::DOptimalityComponent => Some(DetectionRule::Threshold(1.0)),
        BaselineKind::Llpr
        | BaselineKind::LlprSum
        | BaselineKind::LlprForces
        | BaselineKind::Euclidean
        | BaselineKind::KNearest => Some(DetectionRule::TENFOLD),
        BaselineKind::Likelihood => None,
    }
}
