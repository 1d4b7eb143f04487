//! Errors of GRACE model files.

use std::path::PathBuf;

use npz::{Error, NpzFile};

/// A GRACE model file that cannot be read or is not supported.
#[derive(Debug, thiserror::Error)]
pub enum GraceError {
    /// The file cannot be opened or read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The model file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// Not an npz archive, or a corrupt one.
    #[error(
        "{}: {}damaged, or not an npz archive ({reason}); export the model again or copy the file again",
        path.display(),
        key.as_ref().map(|key| format!("array '{key}': ")).unwrap_or_default()
    )]
    Damaged {
        /// The model file.
        path: PathBuf,
        /// The invalid array, if it is an array.
        key: Option<String>,
        /// What is wrong.
        reason: String,
    },
    /// An array is missing.
    #[error("{}: array '{key}' is missing: not a kokkos.npz export of a GRACE model, or truncated", path.display())]
    Missing {
        /// The model file.
        path: PathBuf,
        /// The array's name.
        key: String,
    },
    /// The type, shape or value of an array contradicts the rest of the model.
    #[error("{}: array '{key}' is {found}, expected {expected}", path.display())]
    Mismatch {
        /// The model file.
        path: PathBuf,
        /// The array's name.
        key: String,
        /// What the file holds.
        found: String,
        /// What the rest of the model needs.
        expected: String,
    },
    /// A valid model that is not supported.
    #[error("{}: {reason}", path.display())]
    Unsupported {
        /// The model file.
        path: PathBuf,
        /// The unsupported feature.
        reason: String,
    },
}

/// A projection that does not fit the basis of a model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the projection of the features has {found} {what}, the model has {expected}: it belongs to another model"
)]
pub struct UnfitProjection {
    /// What there is another number of.
    pub what: &'static str,
    /// The projection's number.
    pub found: usize,
    /// The model's number.
    pub expected: usize,
}

impl From<Error> for GraceError {
    fn from(error: Error) -> Self {
        match error {
            Error::Open { path, source } => Self::Read { path, source },
            Error::NotAnArchive { path, source } => {
                Self::Damaged { path, key: None, reason: source.to_string() }
            }
            Error::Missing { path, key } => Self::Missing { path, key },
            Error::Damaged { path, key, found, expected } => {
                Self::Damaged { path, key: Some(key), reason: format!("{found}, expected {expected}") }
            }
            Error::Type { path, key, found, expected } => {
                Self::Mismatch { path, key, found: format!("of type {found}"), expected }
            }
            Error::Shape { path, key, found, expected } => {
                Self::Mismatch { path, key, found: format!("of shape {found}"), expected }
            }
            Error::Value { path, key, found, expected } => Self::Mismatch { path, key, found, expected },
        }
    }
}

/// The error for an array that contradicts the rest of the model.
pub(super) fn mismatch(
    archive: &NpzFile,
    key: &str,
    found: impl ToString,
    expected: impl ToString,
) -> GraceError {
    archive.invalid(key, found, expected).into()
}

/// The error for an unsupported kind of model.
pub(super) fn unsupported(archive: &NpzFile, reason: impl Into<String>) -> GraceError {
    GraceError::Unsupported { path: archive.path().to_owned(), reason: reason.into() }
}
