//! Versions of the potential: a model, its mixture and thresholds together, which never change.

use std::ops::Range;

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

    /// The number after all these versions and refused attempts, which are in order.
    pub fn next_number(versions: &[Self]) -> u32 {
        versions.last().map_or(1, |last| last.number.saturating_add(1))
    }
}

impl VersionFiles {
    /// The BLAKE3 hashes of model and mixture, as a [`VersionRecord`] has them.
    pub fn hashes(&self) -> [String; 2] {
        [&self.model, &self.mixture].map(|bytes| blake3::hash(bytes).to_string())
    }
}

/// Which version of the potential drives each walk. Walks of a version have higher numbers than those of the versions before:
/// when the campaign switches to a version, its walks are created and no others any more.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WalkVersions {
    /// First walk and number of each version, by walk. Walks before the first of them have version 0.
    starts: Vec<(u32, u32)>,
}

impl WalkVersions {
    /// From the walks in order, each with its version.
    pub fn from_walks(walks: impl IntoIterator<Item = (u32, u32)>) -> Self {
        let mut starts: Vec<(u32, u32)> = Vec::new();
        for (walk, version) in walks {
            if starts.last().map_or(0, |(_, last)| *last) != version {
                starts.push((walk, version));
            }
        }
        Self { starts }
    }

    /// Whether version 0 drives all walks.
    pub fn is_single(&self) -> bool {
        self.starts.is_empty()
    }

    /// The version of the newest walks.
    pub fn newest(&self) -> u32 {
        self.starts.last().map_or(0, |(_, version)| *version)
    }

    /// The version of a walk.
    pub fn version_of(&self, walk: u32) -> u32 {
        let begun = self.starts.partition_point(|(first, _)| *first <= walk);
        self.starts[..begun].last().map_or(0, |(_, version)| *version)
    }

    /// The version of the walk of a candidate, from its name ([`wire::CandidateId`]); 0 for another text.
    pub fn of_candidate(&self, name: &str) -> u32 {
        let walk = name.split('-').nth(1).and_then(|place| place.split_once('.'));
        walk.and_then(|(walk, _)| walk.parse().ok()).map_or(0, |walk| self.version_of(walk))
    }

    /// The versions of walks, in order.
    pub fn numbers(&self) -> impl Iterator<Item = u32> {
        let first = self.starts.first().is_none_or(|(walk, _)| *walk > 0).then_some(0);
        first.into_iter().chain(self.starts.iter().map(|(_, version)| *version))
    }

    /// The walks of a version; empty if it has none.
    pub fn walks_of(&self, version: u32) -> Range<i64> {
        let end = |place: usize| self.starts.get(place).map_or(i64::MAX, |(walk, _)| i64::from(*walk));
        match self.starts.iter().position(|(_, of)| *of == version) {
            Some(place) => end(place)..end(place + 1),
            None if version == 0 => 0..end(0),
            None => 0..0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walks_have_the_versions_they_were_created_with() {
        let versions = WalkVersions::from_walks([(0, 0), (1, 0), (2, 1), (3, 1), (4, 3)]);
        assert_eq!((0..6).map(|walk| versions.version_of(walk)).collect::<Vec<_>>(), [0, 0, 1, 1, 3, 3]);
        assert_eq!((versions.walks_of(0), versions.walks_of(1)), (0..2, 2..4));
        assert_eq!((versions.walks_of(3), versions.walks_of(2)), (4..i64::MAX, 0..0));
        assert_eq!((versions.newest(), versions.numbers().collect::<Vec<_>>()), (3, vec![0, 1, 3]));
        assert_eq!(versions.of_candidate("9f8e7d6c-3.0.1240-0123456789abcdef"), 1);
        assert_eq!(versions.of_candidate("import-4"), 0);
        let single = WalkVersions::from_walks([(0, 0), (1, 0)]);
        assert!(single.is_single() && single.walks_of(0) == (0..i64::MAX));
        let begun_with_another = WalkVersions::from_walks([(0, 2)]);
        assert_eq!(begun_with_another.numbers().collect::<Vec<_>>(), [2]);
    }
}
