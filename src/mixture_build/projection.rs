//! The features of a mixture: the model with its projection.

use std::path::Path;

use calm::Projection;
use calm::build::random_projection;
use npz::NpzFile;

use crate::exit_status::CommandError;
use crate::feature_variant::{FeatureModel, FeatureVariant};
use crate::loaded_model::LoadedModel;

/// Projected features of a model without a projection, as in the paper.
pub const PROJECTED: usize = 128;

/// The model with the features of `variant`, the projection that an artifact of them stores, and the random seed of that if it is known. A model without a
/// projection gets a random one with `dimension` projected features.
pub fn projected(
    path: &Path,
    mut model: LoadedModel,
    variant: Option<FeatureVariant>,
    seed: u64,
    dimension: usize,
) -> Result<(FeatureModel, Projection, Option<i64>), CommandError> {
    let needs_projection = variant != Some(FeatureVariant::Hidden);
    let seed = if !needs_projection || model.has_final_features() {
        None
    } else if model.projection().is_some() {
        let file = NpzFile::open(path).map_err(CommandError::input)?;
        let key = "uq_rp_seed";
        let seed = file.contains(key).then(|| file.integers(key)).transpose().map_err(CommandError::input)?;
        seed.and_then(|seed| seed.data.first().copied())
    } else {
        let (rows, layers) = model.basis().ok_or_else(|| {
            CommandError::Input(format!(
                "{}: the model has no features, so nothing can be graded",
                path.display()
            ))
        })?;
        let drawn = random_projection(seed, rows, dimension, layers);
        model = model.with_projection(&drawn).map_err(CommandError::Failed)?;
        i64::try_from(seed).ok()
    };
    let found = FeatureModel::new(path, model, variant)?;
    let projection = found.stored_projection().ok_or_else(|| {
        CommandError::Failed(format!("{}: the model has no projection of its features", path.display()))
    })?;
    Ok((found, projection, seed))
}
