//! γ under another mixture of the model as a score to compare γ with.

use std::sync::Arc;

use atoms::Structure;
use calm::{Grades, Mixture};

use super::own_features::OwnFeatures;
use super::{AtomScore, DetectionRule};
use crate::feature_variant::FeatureModel;

/// A mixture, with a calculator if it grades other features.
pub struct MixtureScore {
    name: String,
    mixture: Arc<Mixture>,
    /// The features of the mixture, unless they are those that γ grades.
    own: Option<OwnFeatures>,
    grades: Grades,
}

impl MixtureScore {
    /// `own` has the features of the mixture; `None` if they are those that γ grades.
    pub fn new(name: String, mixture: Arc<Mixture>, own: Option<FeatureModel>) -> Self {
        Self { name, mixture, own: own.map(OwnFeatures::new), grades: Grades::default() }
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
        Box::new(Self {
            name: self.name.clone(),
            mixture: Arc::clone(&self.mixture),
            own: self.own.as_ref().map(OwnFeatures::for_thread),
            grades: Grades::default(),
        })
    }

    fn score(
        &mut self,
        structure: &Structure,
        elements: &[usize],
        features: &[f64],
    ) -> Result<Vec<f64>, String> {
        let features = match &mut self.own {
            None => features,
            Some(own) => own.compute(structure)?.features(),
        };
        let graded = self.grades.evaluate(&self.mixture, elements, features, None);
        graded.map_err(|error| error.to_string())?;
        Ok(self.grades.gamma.clone())
    }
}
