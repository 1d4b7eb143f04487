//! Checks that an artifact belongs to a model, and that its numbers can come from training data.

use std::fmt::Display;
use std::path::Path;

use calm::{Artifact, ProjectionMismatch};

use crate::loaded_model::LoadedModel;

/// Checks that an artifact has the elements of a model, and its projection if it has one.
///
/// # Errors
/// The first difference.
pub fn check_belongs_to(artifact: &Artifact, model: &LoadedModel) -> Result<(), ProjectionMismatch> {
    let found = model.projection();
    artifact.check_belongs_to(&model.symbols(), found.as_ref().unwrap_or(&artifact.projection))?;
    let (features, expected) = (artifact.projection.feature_dimension, model.dimension());
    // Features that a program in Python gives have no projection to compare.
    if expected != 0 && features != expected {
        let what = "number of features";
        return Err(ProjectionMismatch { what, artifact: features.to_string(), model: expected.to_string() });
    }
    Ok(())
}

/// An artifact of the model, and the model, which gets the projection of the artifact if it has none.
///
/// # Errors
/// An artifact of another model, or one whose numbers cannot come from training data.
pub fn load_artifact(model: LoadedModel, path: &Path) -> Result<(LoadedModel, Artifact), String> {
    let wrong = |error: &dyn Display| format!("{}: {error}", path.display());
    let artifact = Artifact::load(path).map_err(|error| error.to_string())?;
    check_belongs_to(&artifact, &model).map_err(|error| wrong(&error))?;
    check_sound(&artifact, path)?;
    let model = match model.dimension() {
        0 => model.with_projection(&artifact.projection).map_err(|error| wrong(&error))?,
        _ => model,
    };
    Ok((model, artifact))
}

/// Refuses an artifact whose numbers cannot come from training data.
pub fn check_sound(artifact: &Artifact, path: &Path) -> Result<(), String> {
    let faults = artifact.unsound_components();
    let Some(first) = faults.first() else { return Ok(()) };
    let more = match faults.len() - 1 {
        0 => String::new(),
        more => format!(" (and {more} more: calmwalk calm info {})", path.display()),
    };
    Err(format!(
        "{}: {first}{more}; rebuild the artifact, or copy it again from where it was built",
        path.display()
    ))
}
