//! Features of a score that γ does not grade.

use atoms::Structure;

use crate::feature_variant::FeatureModel;
use crate::features::FeatureCalculator;

/// A variant of the model's features with its calculator.
pub struct OwnFeatures {
    model: FeatureModel,
    calculator: FeatureCalculator,
}

impl OwnFeatures {
    pub fn new(model: FeatureModel) -> Self {
        Self { calculator: model.calculator(), model }
    }

    /// The same features for another thread, with work arrays of its own.
    pub fn for_thread(&self) -> Self {
        Self::new(self.model.clone())
    }

    /// The calculator, which has the features of `structure` then.
    ///
    /// # Errors
    /// Why the structure has no features.
    pub fn compute(&mut self, structure: &Structure) -> Result<&mut FeatureCalculator, String> {
        self.calculator.compute(structure).map_err(|error| error.to_string())?;
        Ok(&mut self.calculator)
    }
}
