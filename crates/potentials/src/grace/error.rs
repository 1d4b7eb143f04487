//! Why a model file cannot be used.

use std::path::PathBuf;

/// A GRACE model file that cannot be read or is not supported.
#[derive(Debug, thiserror::Error)]
pub enum GraceError {
    /// The file cannot be opened or read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The model file.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// Not an npz archive, or a damaged one.
    #[error(
        "{}: {}damaged, or not an npz archive ({reason}); export the model again or copy the file again",
        path.display(),
        key.as_ref().map(|key| format!("array '{key}': ")).unwrap_or_default()
    )]
    Damaged {
        /// The model file.
        path: PathBuf,
        /// The array at fault, if it is one.
        key: Option<String>,
        /// What is wrong.
        reason: String,
    },
    /// An array is absent.
    #[error("{}: array '{key}' is missing: not a kokkos.npz export of a GRACE model, or cut short", path.display())]
    Missing {
        /// The model file.
        path: PathBuf,
        /// The array's name.
        key: String,
    },
    /// An array has another type, shape or value than the rest of the model needs.
    #[error("{}: array '{key}' is {found}, expected {expected}", path.display())]
    Mismatch {
        /// The model file.
        path: PathBuf,
        /// The array's name.
        key: String,
        /// What the file holds.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// A valid model that is not supported.
    #[error("{}: {reason}", path.display())]
    Unsupported {
        /// The model file.
        path: PathBuf,
        /// The feature that is not supported.
        reason: String,
    },
}
