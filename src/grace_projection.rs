//! The projection of a GRACE model's basis, in the form of artifacts.

use calm::Projection;
use potentials::grace::{self, GraceModel, UnfitProjection};

/// The projection of a model, if it has one, in the form of artifacts.
pub fn model_projection(model: &GraceModel) -> Option<Projection> {
    let found = model.projection()?;
    Some(Projection {
        matrix: found.matrix.clone(),
        rows: found.matrix.len() / found.dimension,
        columns: found.dimension,
        feature_dimension: found.feature_dimension(),
        asinh: found.asinh,
        normalised: found.normalize,
        density_channels: found.density_channels,
        density_scale: found.density_scale,
    })
}

/// The model with this projection, in place of its own if it has one.
///
/// # Errors
/// A projection of another basis.
pub fn with_projection(model: GraceModel, projection: &Projection) -> Result<GraceModel, UnfitProjection> {
    let layers = model.description().architecture.layers();
    model.with_projection(grace::GraceProjection {
        matrix: projection.matrix.clone(),
        dimension: projection.columns,
        normalize: projection.normalised,
        density_channels: projection.density_channels,
        density_scale: projection.density_scale,
        asinh: projection.asinh,
        layers,
    })
}
