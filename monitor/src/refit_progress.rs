//! Whether a version of the potential is left to train, and which labels versions are trained on.

use serde_json::Value;
use store::{ExportFilter, ExportRow, ExportSource, Store, StoreError, VersionRecord, VersionState};
use wire::Origin;

use crate::improvement::{Improvement, trained_versions};

/// Why a version without any label to train on is refused.
pub const NO_LABELS: &str = "there are no labels to train on";

/// Rows read at a time.
const PAGE_ROWS: u32 = 200;

/// What the labels of a campaign are for in a refit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LabelSplit {
    /// Share of the seed structures whose labels are never trained on (`refit.held_out`).
    pub held_out: f64,
    /// Versions are not trained on the labels of control frames (`refit.control_frames = "compare"`).
    pub compares_controls: bool,
    /// Random seed of the campaign.
    pub rng_seed: u64,
}

/// What a label is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LabelPurpose {
    /// To train on.
    Training,
    /// To judge with: no version is trained on it.
    HeldOut,
    /// For comparisons with control frames.
    Control,
}

/// The settings that the times of refits follow from.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RefitRules {
    /// `stop.min_improvement`.
    pub min_improvement: Option<f64>,
    /// `refit.max_versions`; 0 without a refit.
    pub max_versions: usize,
    /// What labels are for.
    pub split: LabelSplit,
}

/// How far a campaign is with its versions of the potential.
#[derive(Clone, Debug, Default)]
pub struct RefitProgress {
    /// The settings.
    pub rules: RefitRules,
    /// Versions and refused attempts, by number.
    pub versions: Vec<VersionRecord>,
    /// Number of structures that were accepted from biased walks.
    pub accepted: u64,
    /// The last attempts were refused because there was no label to train on, and there is one now: they do not count.
    pub labels_came_late: bool,
}

impl LabelSplit {
    /// What a label is for.
    pub fn purpose(&self, row: &ExportRow) -> LabelPurpose {
        match &row.source {
            ExportSource::Candidate { seed_structure_name, .. } if self.is_held_out(seed_structure_name) => {
                LabelPurpose::HeldOut
            }
            ExportSource::Candidate { origin: Origin::Control, .. } if self.compares_controls => {
                LabelPurpose::Control
            }
            _ => LabelPurpose::Training,
        }
    }

    /// Whether the labels of a seed structure are never trained on: a share of all seed structures, for the whole campaign.
    pub fn is_held_out(&self, seed_structure: &str) -> bool {
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"calmwalk held out 1");
        hasher.update(&self.rng_seed.to_le_bytes());
        hasher.update(seed_structure.as_bytes());
        let [a, b, c, d, e, f, g, h, ..] = *hasher.finalize().as_bytes();
        let number = u64::from_le_bytes([a, b, c, d, e, f, g, h]) >> 11;
        (number as f64) / ((1_u64 << 53) as f64) < self.held_out
    }

    /// Whether the campaign has any label that a refit trains on now. Reads labels until it finds one.
    async fn has_label_to_train_on(&self, store: &Store) -> Result<bool, StoreError> {
        let Some(protocol) = store.protocol_in_force().await? else { return Ok(false) };
        let filter = ExportFilter { protocol: protocol.hash, biased: true, control: true, imported: true };
        let mut last = None;
        loop {
            let page = store.labelled(&filter, last, PAGE_ROWS).await?;
            let Some(end) = page.last() else { return Ok(false) };
            last = Some(end.cursor);
            if page.iter().any(|row| self.purpose(row) == LabelPurpose::Training) {
                return Ok(true);
            }
        }
    }
}

impl RefitRules {
    /// Those of a configuration with all its defaults.
    pub fn from_json(configuration: &Value) -> Self {
        let refit = &configuration["refit"];
        let most = refit["max_versions"].as_u64().unwrap_or(0);
        Self {
            min_improvement: configuration["stop"]["min_improvement"].as_f64(),
            max_versions: usize::try_from(most).unwrap_or(usize::MAX),
            split: LabelSplit {
                held_out: refit["held_out"].as_f64().unwrap_or(0.0),
                compares_controls: refit["control_frames"] == "compare",
                rng_seed: configuration["campaign"]["rng_seed"].as_u64().unwrap_or(0),
            },
        }
    }
}

impl RefitProgress {
    /// Reads it from the campaign's database.
    pub async fn read(store: &Store, rules: RefitRules) -> Result<Self, StoreError> {
        let versions = store.versions().await?;
        let labels_came_late = rules.max_versions > 0
            && versions.last().is_some_and(had_no_labels)
            && rules.split.has_label_to_train_on(store).await?;
        Ok(Self { rules, versions, accepted: store.accepted_structures().await?, labels_came_late })
    }

    /// Whether a version is left to train when all walks have ended: there may be more versions, and there is anything new.
    pub fn is_refit_left(&self) -> bool {
        self.trains_more() && self.has_news()
    }

    /// Whether the campaign trains further versions.
    pub fn trains_more(&self) -> bool {
        self.small_improvement().is_none() && !self.are_all_trained()
    }

    /// The improvement of the newest version on its parent if it is so small that no further version is trained.
    pub fn small_improvement(&self) -> Option<Improvement> {
        let least = self.rules.min_improvement?;
        Improvement::of_newest(&self.versions).filter(|found| found.per_100_labels() < least)
    }

    /// Whether as many versions are trained as there may be. Rollbacks do not count.
    pub fn are_all_trained(&self) -> bool {
        trained_versions(&self.versions).count() >= self.rules.max_versions
    }

    /// Whether structures were accepted since the last attempt.
    pub fn has_news(&self) -> bool {
        self.accepted > self.accepted_before()
    }

    /// Number of accepted structures at the last attempt.
    pub fn accepted_before(&self) -> u64 {
        self.attempts().map(|version| version.structures).max().unwrap_or(0)
    }

    /// Versions and refused attempts whose structures and time the next refit counts from.
    pub fn attempts(&self) -> impl Iterator<Item = &VersionRecord> {
        let late = self.versions.iter().rev().take_while(|last| self.labels_came_late && had_no_labels(last));
        self.versions.iter().take(self.versions.len() - late.count())
    }
}

/// Whether an attempt was refused because there was no label to train on.
fn had_no_labels(attempt: &VersionRecord) -> bool {
    attempt.state == VersionState::Refused && attempt.reason == NO_LABELS
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::improvement::tests::version;

    #[test]
    fn about_the_share_of_the_seed_structures_is_held_out_for_good() {
        let names: Vec<String> = (0..2000).map(|number| format!("seed {number}")).collect();
        let is_held_out = |name: &str, rng_seed, held_out| {
            LabelSplit { held_out, rng_seed, compares_controls: false }.is_held_out(name)
        };
        let held_out = |seed, share| names.iter().filter(|name| is_held_out(name, seed, share)).count();
        // Five standard deviations of a binomial distribution.
        assert!((held_out(1, 0.1) as f64 - 200.0).abs() < 5.0 * 180_f64.sqrt(), "{}", held_out(1, 0.1));
        assert_eq!((held_out(1, 0.0), held_out(1, 1.0)), (0, 2000));
        // A larger share holds out the same and others; another random seed others.
        assert!(names.iter().all(|name| is_held_out(name, 1, 0.3) || !is_held_out(name, 1, 0.1)));
        assert!(names.iter().any(|name| is_held_out(name, 1, 0.1) && !is_held_out(name, 2, 0.1)));
    }

    #[test]
    fn rules_are_those_of_the_configuration() {
        assert_eq!(RefitRules::from_json(&json!({ "refit": null })), RefitRules::default());
        let refit = json!({ "max_versions": 3, "held_out": 0.1, "control_frames": "compare" });
        let configuration =
            json!({ "campaign": { "rng_seed": 7 }, "stop": { "min_improvement": 0.02 }, "refit": refit });
        let split = LabelSplit { held_out: 0.1, compares_controls: true, rng_seed: 7 };
        let expected = RefitRules { min_improvement: Some(0.02), max_versions: 3, split };
        assert_eq!(RefitRules::from_json(&configuration), expected);
    }

    /// A structure whose label came too late for an attempt is trained on by the next one.
    #[test]
    fn attempts_without_labels_do_not_count_once_there_are_labels() {
        let refused = |number: u32, reason: &str| VersionRecord {
            state: VersionState::Refused,
            reason: reason.into(),
            ..version(number, 4 + u64::from(number), "held_out", [1.0, 0.9])
        };
        let mut progress = RefitProgress {
            rules: RefitRules { max_versions: 2, ..RefitRules::default() },
            versions: vec![refused(1, "its errors rose"), refused(2, NO_LABELS), refused(3, NO_LABELS)],
            accepted: 7,
            labels_came_late: false,
        };
        assert_eq!((progress.accepted_before(), progress.is_refit_left()), (7, false));
        progress.labels_came_late = true;
        assert_eq!((progress.accepted_before(), progress.is_refit_left()), (5, true));
        // Only the last ones are left out: what came between is trained on already.
        progress.versions.push(version(4, 7, "held_out", [1.0, 0.5]));
        assert_eq!((progress.accepted_before(), progress.is_refit_left()), (7, false));
    }
}
