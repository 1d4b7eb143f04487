//! What the walks of one version of the potential found.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use store::{FateCount, Store, StoreError, WalkStatus};

/// Walks with a version of the potential, and the candidates that they found.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct VersionFinds {
    /// Number of biased walks, by state.
    pub biased_walks: BTreeMap<String, u64>,
    /// Number of control walks, by state.
    pub control_walks: BTreeMap<String, u64>,
    /// Number of candidates of biased walks, by fate: `accepted`, or the reason of the decline.
    pub candidates: BTreeMap<String, u64>,
}

impl VersionFinds {
    /// Reads them for the version with this number; 0 is that of the configuration.
    pub async fn read(store: &Store, version: u32) -> Result<Self, StoreError> {
        let status = store.status().await?;
        Ok(Self::count(version, &status.walks, &store.fates_by_walk().await?))
    }

    /// Walks without conditions are those of campaigns of early versions, which had one potential.
    fn count(version: u32, walks: &[WalkStatus], fates: &[FateCount]) -> Self {
        let version_of =
            |walk: &WalkStatus| walk.conditions.as_ref().map_or(0, |conditions| conditions.version);
        let mut found = Self::default();
        let mut numbers = BTreeSet::new();
        for walk in walks.iter().filter(|walk| version_of(walk) == version) {
            let counts = match walk.origin.as_str() {
                "control" => &mut found.control_walks,
                _ => &mut found.biased_walks,
            };
            *counts.entry(walk.state.clone()).or_default() += 1;
            numbers.insert(u64::from(walk.walk));
        }
        for FateCount { fate, number, .. } in fates.iter().filter(|count| numbers.contains(&count.part)) {
            *found.candidates.entry(fate.clone()).or_default() += number;
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use wire::WalkConditions;

    use super::*;

    fn walk(walk: u32, version: u32, origin: &str, state: &str) -> WalkStatus {
        let conditions = Some(WalkConditions { version, ..WalkConditions::default() });
        WalkStatus { walk, conditions, origin: origin.into(), state: state.into(), ..WalkStatus::default() }
    }

    #[test]
    fn walks_and_candidates_belong_to_the_version_that_drove_them() {
        let walks = [
            WalkStatus { conditions: None, ..walk(0, 0, "biased", "superseded") },
            walk(1, 0, "control", "completed"),
            walk(2, 2, "biased", "completed"),
            walk(3, 2, "biased", "running"),
            walk(4, 2, "biased", "completed"),
        ];
        let fate = |part, fate: &str, number| FateCount { part, fate: fate.into(), number };
        let fates =
            [fate(0, "accepted", 7), fate(2, "accepted", 2), fate(2, "covered", 1), fate(4, "accepted", 3)];
        let counts = |pairs: &[(&str, u64)]| -> BTreeMap<String, u64> {
            pairs.iter().map(|(name, number)| ((*name).to_owned(), *number)).collect()
        };
        let found = VersionFinds::count(2, &walks, &fates);
        assert_eq!(found.biased_walks, counts(&[("completed", 2), ("running", 1)]));
        assert_eq!(found.candidates, counts(&[("accepted", 5), ("covered", 1)]));
        let first = VersionFinds::count(0, &walks, &fates);
        assert_eq!(
            (first.biased_walks, first.control_walks),
            (counts(&[("superseded", 1)]), counts(&[("completed", 1)]))
        );
        assert_eq!(first.candidates, counts(&[("accepted", 7)]));
        assert_eq!(VersionFinds::count(1, &walks, &fates), VersionFinds::default());
    }
}
