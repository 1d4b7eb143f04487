//! Why an archive, or one of its arrays, cannot be used.

use std::path::PathBuf;

/// An archive that cannot be opened, or an array that is not as it should be.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be opened or read.
    #[error("{}: {source}; expected a NumPy .npz archive", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// The file is no archive, or one that was cut short.
    #[error("{}: {source}; expected a NumPy .npz archive", path.display())]
    NotAnArchive {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: std::io::Error,
    },
    /// An array is absent.
    #[error("{}: no array '{key}'", path.display())]
    Missing {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
    },
    /// An array cannot be read: its checksum, its header or its length is wrong.
    #[error("{}: array '{key}': found {found}, expected {expected}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// What was found.
        found: String,
        /// What a sound file would hold.
        expected: String,
    },
    /// An array has another type.
    #[error("{}: array '{key}': found type {found}, expected {expected}", path.display())]
    Type {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// The type as NumPy writes it, such as `<f8`.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// An array has another shape.
    #[error("{}: array '{key}': found shape {found}, expected {expected}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// Its shape, such as `[2, 3]`.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// An array holds other values.
    #[error("{}: array '{key}': found {found}, expected {expected}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        key: String,
        /// The value at fault.
        found: String,
        /// What would be right.
        expected: String,
    },
}

/// The array that an error is about.
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
