//! Warnings about values that are possible but probably not intended.

use std::fmt;

/// A value that the user should check: `validate` and `run` print the warning and continue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Warning {
    /// `file:line`.
    pub at: String,
    /// Dotted key.
    pub key: String,
    /// The problem, and what to do.
    pub message: String,
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { at, key, message } = self;
        write!(f, "WARNING: {at}: {key}: {message}")
    }
}
