//! γ under another mixture of the model as a score to compare γ with.

use std::sync::Arc;

use atoms::Structure;
use calm::{Grades, Mixture};

use super::{AtomScore, DetectionRule};
use crate::feature_variant::FeatureModel;
use crate::features::FeatureCalculator;

/// A mixture, with a calculator if it grades other features.
pub struct MixtureScore {
    name: String,
    mixture: Arc<Mixture>,
    /// The features of the mixture with their calculator, unless they are those that γ grades.
    own: Option<(FeatureModel, FeatureCalculator)>,
    grades: Grades,
}

impl MixtureScore {
    /// `own` has the features of the mixture; `None` if they are those that γ grades.
    pub fn new(name: String, mixture: Arc<Mixture>, own: Option<FeatureModel>) -> Self {
        let own = own.map(|model| {
            let calculator = model.calculator();
            (model, calculator)
        });
        Self { name, mixture, own, grades: Grades::default() }
    }
}

impl AtomScore for MixtureScore {
    fn name(&self) -> &str {
        &self.name
    }

    fn rule(&self) -> Option<DetectionRule> {
        Some(DetectionRule::Threshold(1.0))
    }

    fn for_thread(&self) -> Box<dyn AtomScore> {
        let own = self.own.as_ref().map(|(model, _)| model.clone());
        Box::new(Self::new(self.name.clone(), Arc::clone(&self.mixture), own))
    }

    fn score(
        &mut self,
        structure: &Structure,
        elements: &[usize],
        features: &[f64],
    ) -> Result<Vec<f64>, String> {
        let features = match &mut self.own {
            None => features,
            Some((_, calculator)) => {
                calculator.compute(structure).map_err(|error| error.to_string())?;
                calculator.features()
            }
        };
        let graded = self.grades.evaluate(&self.mixture, elements, features, None);
        graded.map_err(|error| error.to_string())?;
        Ok(self.grades.gamma.clone())
    }
}
