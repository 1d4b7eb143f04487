//! What a configuration asks for that is possible but hardly meant.

use std::fmt;

/// Something that the user should look at again: `validate` and `run` print it and go on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Warning {
    /// `file:line`.
    pub at: String,
    /// Dotted key.
    pub key: String,
    /// What is unusual about it, and what to do.
    pub message: String,
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { at, key, message } = self;
        write!(f, "WARNING: {at}: {key}: {message}")
    }
}
