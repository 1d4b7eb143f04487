//! A finding.

use std::fmt;

/// A violation found by a check.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// The finding, with an example.
    pub what: String,
    /// Its consequence, and what to do.
    pub then: &'static str,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.what, self.then)
    }
}
