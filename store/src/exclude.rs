//! Labels excluded from the data set by hand.

use serde::Serialize;

/// How a label was excluded.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Exclusion {
    /// When, ms since 1970.
    pub time: i64,
    /// Why.
    pub reason: String,
}

/// The effect of excluding or including one structure.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ExclusionChange {
    /// Name of the candidate, or `import-N`.
    pub id: String,
    /// Protocols of its labels.
    pub protocols: Vec<String>,
    /// Whether anything changed.
    pub changed: bool,
    /// Why its labels are excluded; `None` if they are not.
    pub excluded: Option<String>,
}

/// An excluded label.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ExcludedLabel {
    /// Name of the first candidate with that structure, or `import-N`.
    pub id: String,
    /// Name of the protocol.
    pub protocol: String,
    /// When and why.
    #[serde(flatten)]
    pub exclusion: Exclusion,
}
