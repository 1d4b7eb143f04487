//! Errors of archives and arrays.

use std::path::PathBuf;

/// An archive that cannot be opened, or an unexpected array.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be opened or read.
    #[error("{}: {source}; expected a NumPy .npz archive", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The file is not an archive, or is truncated.
    #[error("{}: {source}; expected a NumPy .npz archive", path.display())]
    NotAnArchive {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: std::io::Error,
    },
    /// An array is missing.
    #[error("{}: no array '{key}'", path.display())]
    Missing {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
    },
    /// An array is corrupt: wrong checksum, header or length.
    #[error("{}: array '{key}': found {found}, expected {expected}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// What was found.
        found: String,
        /// What a valid file has.
        expected: String,
    },
    /// An array has an unexpected type.
    #[error("{}: array '{key}': found type {found}, expected {expected}", path.display())]
    Type {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// The type as NumPy writes it, such as `<f8`.
        found: String,
        /// The expected type.
        expected: String,
    },
    /// An array has an unexpected shape.
    #[error("{}: array '{key}': found shape {found}, expected {expected}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// Its shape, such as `[2, 3]`.
        found: String,
        /// The expected shape.
        expected: String,
    },
    /// An array has an invalid value.
    #[error("{}: array '{key}': found {found}, expected {expected}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// The invalid value.
        found: String,
        /// The valid values.
        expected: String,
    },
}

/// Path and name of the array that an error is about.
#[derive(Debug, Clone)]
pub(crate) struct ArrayName {
    pub path: PathBuf,
    pub key: String,
}

impl ArrayName {
    pub fn missing(&self) -> Error {
        let Self { path, key } = self.clone();
        Error::Missing { path, key }
    }

    pub fn damaged(&self, found: impl ToString, expected: impl ToString) -> Error {
        let Self { path, key } = self.clone();
        Error::Damaged { path, key, found: found.to_string(), expected: expected.to_string() }
    }

    pub fn wrong_type(&self, found: impl ToString, expected: &str) -> Error {
        let Self { path, key } = self.clone();
        Error::Type { path, key, found: found.to_string(), expected: expected.to_owned() }
    }

    pub fn wrong_shape(&self, found: impl ToString, expected: impl ToString) -> Error {
        let Self { path, key } = self.clone();
        Error::Shape { path, key, found: found.to_string(), expected: expected.to_string() }
    }

    pub fn wrong_value(&self, found: impl ToString, expected: impl ToString) -> Error {
        let Self { path, key } = self.clone();
        Error::Value { path, key, found: found.to_string(), expected: expected.to_string() }
    }
}
