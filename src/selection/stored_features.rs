//! Whether the features that a campaign has stored are those of a selection.

use std::path::Path;

use calm::Projection;
use potentials::grace::GraceModel;
use serde_json::Value;

use crate::exit_status::CommandError;
use crate::feature_variant::FeatureModel;
use crate::file_hash;
use crate::replay::{ARTIFACT, MODEL};

/// The features of a selection and the files that they follow from.
#[derive(Clone, Debug)]
pub struct FeatureIdentity {
    /// BLAKE3 hash of the model.
    model_hash: String,
    /// BLAKE3 hash of the artifact, if one is given.
    artifact_hash: Option<String>,
    /// The projection in the model's file, which campaigns with the model use.
    own: Option<Projection>,
    /// The projection of the selection.
    projection: Projection,
}

impl FeatureIdentity {
    /// `projection` is that of the selection with this model and artifact.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn new(model: &Path, artifact: Option<&Path>, projection: Projection) -> Result<Self, CommandError> {
        let hash = |path: &Path| file_hash::hash(path).map_err(CommandError::input);
        let own = match GraceModel::has_projection(model).map_err(CommandError::input)? {
            true => FeatureModel::load(model, None)?.projection(),
            false => None,
        };
        let artifact_hash = artifact.map(hash).transpose()?;
        Ok(Self { model_hash: hash(model)?, artifact_hash, own, projection })
    }

    /// Whether a campaign stores these features. `resolved` is its configuration with the hashes of its files, `files` has their paths.
    ///
    /// # Errors
    /// The projection is in the campaign's artifact, which is not that of the selection and cannot be read.
    pub fn is_stored_by(&self, resolved: &Value, files: &Value) -> Result<bool, CommandError> {
        if resolved["files"][MODEL] != self.model_hash {
            return Ok(false);
        }
        if let Some(own) = &self.own {
            return Ok(own.check_same(&self.projection).is_ok());
        }
        let expected = resolved["files"][ARTIFACT].as_str();
        if expected.is_some() && expected == self.artifact_hash.as_deref() {
            return Ok(true);
        }
        let path = files[ARTIFACT].as_str().map(Path::new);
        let path = path.ok_or_else(|| CommandError::Input(format!("the store has no path of {ARTIFACT}")))?;
        file_hash::verify_hash(path, expected.unwrap_or_default())?;
        let found = Projection::load(path).map_err(CommandError::input)?;
        Ok(found.check_same(&self.projection).is_ok())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use serde_json::json;

    use super::*;

    fn projection(matrix: [f32; 2]) -> Projection {
        Projection {
            matrix: matrix.to_vec(),
            rows: 2,
            columns: 1,
            feature_dimension: 1,
            asinh: false,
            normalised: false,
            density_channels: false,
            density_scale: 1.0,
        }
    }

    /// What [`Projection::load`] reads of an artifact.
    fn write_artifact(path: &Path, matrix: [f32; 2]) {
        let mut file = npz::Writer::new(Cursor::new(Vec::new()));
        file.scalar("__schema_version__", 6_i64).unwrap();
        file.scalar("uq_rp_dim", 1_i64).unwrap();
        file.array("elements", &[1], [0_i64]).unwrap();
        file.array("centroids_0", &[1, 1], [0.0_f64]).unwrap();
        file.array("uq_rp_matrix", &[2, 1], matrix).unwrap();
        std::fs::write(path, file.finish().unwrap().into_inner()).unwrap();
    }

    fn selection(own: Option<[f32; 2]>) -> FeatureIdentity {
        FeatureIdentity {
            model_hash: "model".to_owned(),
            artifact_hash: Some("artifact".to_owned()),
            own: own.map(projection),
            projection: projection([1.0, 2.0]),
        }
    }

    fn hashes(model: &str, artifact: &str) -> Value {
        json!({ "files": { "potential.model": model, "calm.artifact": artifact } })
    }

    #[test]
    fn a_model_with_a_projection_needs_no_artifact() {
        let stored = |own, model| selection(Some(own)).is_stored_by(&hashes(model, "another"), &json!({}));
        assert!(stored([1.0, 2.0], "model").unwrap());
        assert!(!stored([1.0, 2.0], "another").unwrap());
        // The selection uses another variant than the file has.
        assert!(!stored([1.0, 3.0], "model").unwrap());
    }

    #[test]
    fn a_model_without_a_projection_has_that_of_the_artifact() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("artifact.npz");
        let selection = selection(None);
        assert!(selection.is_stored_by(&hashes("model", "artifact"), &json!({})).unwrap());
        for (matrix, same) in [([1.0, 2.0], true), ([1.0, 3.0], false)] {
            write_artifact(&path, matrix);
            let files = json!({ "calm.artifact": path });
            let hashes = hashes("model", &file_hash::hash(&path).unwrap());
            assert_eq!(selection.is_stored_by(&hashes, &files).unwrap(), same);
        }
    }

    #[test]
    fn an_artifact_that_is_gone_is_an_error() {
        let error = |files| selection(None).is_stored_by(&hashes("model", "another"), &files).unwrap_err();
        assert_eq!(error(json!(null)).to_string(), "the store has no path of calm.artifact");
        assert!(error(json!({ "calm.artifact": "/no/file.npz" })).to_string().contains("/no/file.npz"));
    }
}
