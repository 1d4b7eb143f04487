//! Versions of the potential: a model, its mixture and thresholds together, which never change.

use serde::{Deserialize, Serialize};

/// Whether a version of the potential can drive walks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VersionState {
    /// It can.
    Registered,
    /// It was refused, and has no files.
    Refused,
}

impl VersionState {
    /// `"registered"`, `"refused"`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Registered => "registered",
            Self::Refused => "refused",
        }
    }

    /// The state with this name.
    pub fn named(name: &str) -> Option<Self> {
        [Self::Registered, Self::Refused].into_iter().find(|state| state.name() == name)
    }
}

/// A version of the potential, or an attempt at one that was refused.
#[derive(Clone, Debug, PartialEq)]
pub struct VersionRecord {
    /// Its number, from 1. Refused attempts have numbers too.
    pub number: u32,
    /// The version from which it was trained; 0 is that of the configuration.
    pub parent: u32,
    /// Whether it was registered.
    pub state: VersionState,
    /// Why it was refused; empty if it was not.
    pub reason: String,
    /// How it was made: `native`, `command`, `rollback`.
    pub method: String,
    /// Number of structures that the campaign had accepted from biased walks when its training set was fixed.
    pub structures: u64,
    /// The newest decision whose label may be in its training set.
    pub last_decision: i64,
    /// Number of labels in its training set.
    pub labels: u64,
    /// BLAKE3 hash of its model, 64 hexadecimal digits; empty if it was refused.
    pub model_hash: String,
    /// The same for its mixture.
    pub mixture_hash: String,
    /// Errors by data set, of this version and its parent, JSON.
    pub figures: serde_json::Value,
    /// Wall time of the refit, s.
    pub seconds: f64,
    /// Processor time of the refit, core hours.
    pub core_hours: f64,
    /// When it was registered or refused, ms since 1970.
    pub time: i64,
}

/// The files of a registered version.
#[derive(Clone, Debug, PartialEq)]
pub struct VersionFiles {
    /// The bytes of the model, `kokkos.npz`.
    pub model: Vec<u8>,
    /// The bytes of the mixture with its thresholds, `gmm_artifacts.npz`.
    pub mixture: Vec<u8>,
}

impl VersionRecord {
    /// [`Self::method`] of a version that is an earlier one again.
    pub const ROLLBACK: &str = "rollback";
}
