//! The projection of a model's features: its own, or that of the artifact that grades them.

use std::fmt::Display;
use std::path::Path;

use calm::{Artifact, Projection, ProjectionMismatch};
use potentials::grace::{self, GraceModel, UnfitProjection};

use crate::campaign::check_sound;

/// The projection of a model, if it has one, in the form of artifacts.
pub fn of_model(model: &GraceModel) -> Option<Projection> {
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
    model.with_projection(grace::Projection {
        matrix: projection.matrix.clone(),
        dimension: projection.columns,
        normalize: projection.normalised,
        density_channels: projection.density_channels,
        density_scale: projection.density_scale,
        asinh: projection.asinh,
        layers,
    })
}

/// Checks that an artifact has the elements of a model, and its projection if it has one.
///
/// # Errors
/// The first difference.
pub fn check_belongs_to(artifact: &Artifact, model: &GraceModel) -> Result<(), ProjectionMismatch> {
    let symbols: Vec<_> = model.elements().iter().map(|element| element.symbol().to_owned()).collect();
    artifact.check_belongs_to(&symbols, of_model(model).as_ref().unwrap_or(&artifact.projection))
}

/// An artifact of the model, and the model, which gets the projection of the artifact if it has none.
///
/// # Errors
/// An artifact of another model, or one whose numbers cannot come from training data.
pub fn load_artifact(model: GraceModel, path: &Path) -> Result<(GraceModel, Artifact), String> {
    let wrong = |error: &dyn Display| format!("{}: {error}", path.display());
    let artifact = Artifact::load(path).map_err(|error| error.to_string())?;
    check_belongs_to(&artifact, &model).map_err(|error| wrong(&error))?;
    check_sound(&artifact, path)?;
    let model = match model.projection() {
        Some(_) => model,
        None => with_projection(model, &artifact.projection).map_err(|error| wrong(&error))?,
    };
    Ok((model, artifact))
}
