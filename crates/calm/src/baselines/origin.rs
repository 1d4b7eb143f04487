//! The features that baselines belong to.

use super::error::OriginMismatch;

/// The features that baselines belong to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FeatureOrigin {
    /// Hash of the model's weights and projection.
    pub model: String,
    /// Variant of the features.
    pub variant: String,
    /// Chemical symbols, in the order of the element indices.
    pub symbols: Vec<String>,
    /// Feature dimension D.
    pub dimension: usize,
}

impl FeatureOrigin {
    /// Checks that both have the same features.
    ///
    /// # Errors
    /// The first difference; `self` is the origin of the baselines.
    pub fn check_same(&self, model: &Self) -> Result<(), OriginMismatch> {
        let differs = |what, baselines: &dyn ToString, model: &dyn ToString| {
            let (baselines, model) = (baselines.to_string(), model.to_string());
            if baselines == model { Ok(()) } else { Err(OriginMismatch { what, baselines, model }) }
        };
        differs("list of elements", &self.symbols.join(" "), &model.symbols.join(" "))?;
        differs("feature variant", &self.variant, &model.variant)?;
        differs("feature dimension", &self.dimension, &model.dimension)?;
        differs("hash of weights and projection", &self.model, &model.model)
    }
}
