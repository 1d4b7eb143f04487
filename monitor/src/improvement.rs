//! How much a version of the potential improved on the version from which it was trained.

use serde::Serialize;
use serde_json::Value;
use store::{VersionRecord, VersionState};

/// The improvement of a version on its parent.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Improvement {
    /// Number of the version.
    pub version: u32,
    /// Labels that it was trained on and its parent was not.
    pub labels: u64,
    /// Mean absolute error of the forces of its parent, eV/Å, on labels that neither was trained on.
    pub parent_error: f64,
    /// The same of the version.
    pub error: f64,
}

impl Improvement {
    /// The improvement of the newest version. `None` if there is none, if it is an earlier one again, or if labels or errors to
    /// compare are missing.
    pub fn of_newest(versions: &[VersionRecord]) -> Option<Self> {
        let is_registered = |version: &&VersionRecord| version.state == VersionState::Registered;
        let newest = versions.iter().rfind(is_registered)?;
        if newest.method == VersionRecord::ROLLBACK {
            return None;
        }
        let parent = versions.iter().find(|version| version.number == newest.parent);
        // Version 0 was trained on no label of the campaign.
        let labels = newest.labels.checked_sub(parent.map_or(0, |parent| parent.labels))?;
        let [parent_error, error] = force_errors(&newest.figures)?;
        (labels > 0 && parent_error > 0.0).then_some(Self {
            version: newest.number,
            labels,
            parent_error,
            error,
        })
    }

    /// Relative fall of the error for each 100 labels; negative if it rose.
    pub fn per_100_labels(&self) -> f64 {
        100.0 * (1.0 - self.error / self.parent_error) / self.labels as f64
    }
}

/// The versions that were trained, without refused attempts and rollbacks, by number.
pub fn trained_versions(versions: &[VersionRecord]) -> impl Iterator<Item = &VersionRecord> {
    versions.iter().filter(|version| {
        version.state == VersionState::Registered && version.method != VersionRecord::ROLLBACK
    })
}

/// Mean absolute errors of the forces of a version's parent and its own, eV/Å: on the labels held out, or their means over the test
/// sets if there are no labels held out.
fn force_errors(figures: &Value) -> Option<[f64; 2]> {
    let sets = figures["sets"].as_array()?;
    let of_kind = |kind: &str| -> Vec<[f64; 2]> {
        let of_kind = sets.iter().filter(|set| set["kind"] == kind && set["structures"] != 0);
        let errors = of_kind.map(|set| ["parent", "version"].map(|whose| set[whose]["force_mae"].as_f64()));
        errors.filter_map(|[parent, version]| Some([parent?, version?])).collect()
    };
    let found = ["held_out", "test"].map(of_kind).into_iter().find(|errors| !errors.is_empty())?;
    let mean = |which: usize| found.iter().map(|errors| errors[which]).sum::<f64>() / found.len() as f64;
    Some([mean(0), mean(1)])
}

#[cfg(test)]
pub(crate) mod tests {
    use serde_json::json;

    use super::*;

    /// A registered version with this number of labels, trained from the one before, and its errors on a set of this kind.
    pub fn version(number: u32, labels: u64, kind: &str, errors: [f64; 2]) -> VersionRecord {
        let [parent, version] = errors.map(|error| json!({ "force_mae": error }));
        let set = json!({ "name": "a", "kind": kind, "structures": 5, "parent": parent, "version": version });
        VersionRecord {
            number,
            parent: number - 1,
            state: VersionState::Registered,
            reason: String::new(),
            method: "native".into(),
            structures: labels,
            last_decision: 1,
            labels,
            model_hash: String::new(),
            mixture_hash: String::new(),
            figures: json!({ "sets": [set] }),
            seconds: 1.0,
            core_hours: 0.0,
            time: 0,
        }
    }

    fn per_100_labels(versions: &[VersionRecord]) -> Option<f64> {
        Improvement::of_newest(versions).map(|found| found.per_100_labels())
    }

    #[test]
    fn labels_count_from_the_parent() {
        let first = version(1, 200, "held_out", [0.5, 0.25]);
        assert_eq!(per_100_labels(&[]), None);
        assert_eq!(per_100_labels(std::slice::from_ref(&first)), Some(0.25));
        let second = version(2, 250, "held_out", [0.25, 0.5]);
        assert_eq!(per_100_labels(&[first.clone(), second.clone()]), Some(-2.0));
        let refused =
            VersionRecord { state: VersionState::Refused, ..version(2, 900, "held_out", [1.0, 1.0]) };
        assert_eq!(per_100_labels(&[first.clone(), refused]), Some(0.25));
        let none_more = VersionRecord { labels: 200, ..second.clone() };
        assert_eq!(per_100_labels(&[first.clone(), none_more]), None);
        let rollback = VersionRecord { method: VersionRecord::ROLLBACK.into(), ..second };
        let versions = [first, rollback];
        assert_eq!((per_100_labels(&versions), trained_versions(&versions).count()), (None, 1));
    }

    #[test]
    fn test_sets_stand_in_for_labels_held_out() {
        let set = |kind: &str, structures: u64, parent: f64, version: Option<f64>| json!({ "kind": kind, "structures": structures, "parent": { "force_mae": parent }, "version": { "force_mae": version } });
        for (sets, expected) in [
            (vec![set("test", 5, 1.0, Some(0.5)), set("held_out", 5, 1.0, Some(0.75))], Some([1.0, 0.75])),
            (vec![set("test", 5, 1.0, Some(0.5)), set("held_out", 0, 0.0, Some(0.0))], Some([1.0, 0.5])),
            (
                vec![
                    set("test", 5, 1.0, Some(0.5)),
                    set("replay", 9, 9.0, Some(9.0)),
                    set("test", 5, 3.0, Some(0.5)),
                ],
                Some([2.0, 0.5]),
            ),
            (vec![set("held_out", 5, 1.0, None), set("since", 5, 1.0, Some(1.0))], None),
        ] {
            assert_eq!(force_errors(&json!({ "sets": sets })), expected);
        }
        assert_eq!(force_errors(&Value::Null), None);
    }
}
