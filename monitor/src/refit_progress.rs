//! Whether a version of the potential is left to train, and which labels versions are trained on.

use serde_json::Value;
use store::{
    ExportCursor, ExportRow, ExportSource, LabelMark, Store, StoreError, VersionRecord, VersionState,
};
use wire::{ContentHash, Origin};

use crate::improvement::{Improvement, trained_versions};

/// Why a version without any label to train on is refused.
pub const NO_LABELS: &str = "there are no labels to train on";

/// Key of a version's figures with the [`LabelSet`] that it was trained on.
pub const LABEL_SET: &str = "label_set";

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

/// A hash of the labels that a refit trains on: which structures, with which energies, by which protocol. The order in which labels
/// arrived does not count.
#[derive(Clone)]
pub struct LabelSet(blake3::Hasher);

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
    /// The labels to train on are others than those of the last attempt: some came, were excluded or were made again.
    pub has_new_labels: bool,
}

impl LabelSet {
    /// Without labels yet.
    pub fn new(protocol: ContentHash) -> Self {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&protocol.0);
        Self(hasher)
    }

    /// Adds the label of a structure with this energy, in the order of [`Store::labelled`].
    pub fn add(&mut self, cursor: ExportCursor, energy: f64) {
        let (kind, number) = match cursor {
            ExportCursor::Candidate(decision) => (0, decision),
            ExportCursor::Import(number) => (1, number),
        };
        self.0.update(&[kind]);
        self.0.update(&number.to_le_bytes());
        self.0.update(&energy.to_le_bytes());
    }

    /// The hash, as the figures of a version have it.
    pub fn hash(&self) -> String {
        self.0.finalize().to_string()
    }
}

impl LabelSplit {
    /// What a label is for.
    pub fn purpose(&self, row: &ExportRow) -> LabelPurpose {
        match &row.source {
            ExportSource::Candidate { seed_structure_name, origin, .. } => {
                self.purpose_of(seed_structure_name, *origin)
            }
            ExportSource::Import { .. } => LabelPurpose::Training,
        }
    }

    fn purpose_of(&self, seed_structure: &str, origin: Origin) -> LabelPurpose {
        if self.is_held_out(seed_structure) {
            LabelPurpose::HeldOut
        } else if self.compares_controls && origin == Origin::Control {
            LabelPurpose::Control
        } else {
            LabelPurpose::Training
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

    /// The hash of the labels that a refit trains on now, and their number; `None` without a protocol.
    pub async fn label_set(&self, store: &Store) -> Result<Option<(String, usize)>, StoreError> {
        let Some(protocol) = store.protocol_in_force().await? else { return Ok(None) };
        let is_for_training = |mark: &LabelMark| {
            let purpose =
                mark.walk.as_ref().map(|(seed_structure, origin)| self.purpose_of(seed_structure, *origin));
            purpose.is_none_or(|purpose| purpose == LabelPurpose::Training)
        };
        let (mut set, mut labels) = (LabelSet::new(protocol.hash), 0);
        for mark in store.label_marks(protocol.hash).await?.iter().filter(|mark| is_for_training(mark)) {
            set.add(mark.cursor, mark.energy);
            labels += 1;
        }
        Ok(Some((set.hash(), labels)))
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
        let accepted = store.accepted_structures().await?;
        let mut progress = Self { rules, versions, accepted, ..Self::default() };
        let had_none = progress.versions.last().is_some_and(had_no_labels);
        // Where structures are new, it does not matter whether labels are.
        let may_matter = !progress.versions.is_empty() && (had_none || !progress.has_new_structures());
        if rules.max_versions > 0
            && may_matter
            && let Some((hash, labels)) = rules.split.label_set(store).await?
        {
            progress.labels_came_late = had_none && labels > 0;
            progress.has_new_labels = progress.labels_before().is_some_and(|before| before != hash);
        }
        Ok(progress)
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

    /// Whether the next refit has anything that the last attempt had not: accepted structures, or other labels.
    pub fn has_news(&self) -> bool {
        self.has_new_structures() || self.has_new_labels
    }

    fn has_new_structures(&self) -> bool {
        self.accepted > self.accepted_before()
    }

    /// The [`LabelSet`] of the last attempt; `None` if there was none, or an earlier program made it.
    fn labels_before(&self) -> Option<&str> {
        let trained = self.versions.iter().rev().find(|version| version.method != VersionRecord::ROLLBACK)?;
        trained.figures[LABEL_SET].as_str()
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

    /// A label that came, was excluded or was made again since the last attempt makes a refit left.
    #[test]
    fn other_labels_are_news() {
        let hash = |labels: &[(ExportCursor, f64)], protocol| {
            let mut set = LabelSet::new(ContentHash([protocol; 32]));
            labels.iter().for_each(|(cursor, energy)| set.add(*cursor, *energy));
            set.hash()
        };
        let (first, second) = ((ExportCursor::Candidate(1), -3.0), (ExportCursor::Candidate(2), -2.0));
        let before = hash(&[first, second], 0);
        assert_eq!(before, hash(&[first, second], 0));
        let others = [
            hash(&[first], 0),
            hash(&[first, (ExportCursor::Candidate(2), -2.5)], 0),
            hash(&[first, (ExportCursor::Import(2), -2.0)], 0),
            hash(&[first, second], 1),
        ];
        assert!(others.iter().all(|other| *other != before));

        let attempt =
            VersionRecord { figures: json!({ LABEL_SET: before }), ..version(1, 4, "held_out", [1.0, 0.9]) };
        let mut progress = RefitProgress {
            rules: RefitRules { max_versions: 2, ..RefitRules::default() },
            versions: vec![attempt.clone()],
            accepted: 4,
            ..RefitProgress::default()
        };
        assert_eq!((progress.labels_before(), progress.is_refit_left()), (Some(before.as_str()), false));
        progress.has_new_labels = true;
        assert!(progress.is_refit_left());
        // A version that is an earlier one again was trained on nothing.
        let rollback =
            VersionRecord { method: VersionRecord::ROLLBACK.into(), figures: Value::Null, ..attempt };
        progress.versions.push(rollback);
        assert_eq!(progress.labels_before(), Some(before.as_str()));
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
            ..RefitProgress::default()
        };
        assert_eq!((progress.accepted_before(), progress.is_refit_left()), (7, false));
        progress.labels_came_late = true;
        assert_eq!((progress.accepted_before(), progress.is_refit_left()), (5, true));
        // Only the last ones are left out: what came between is trained on already.
        progress.versions.push(version(4, 7, "held_out", [1.0, 0.5]));
        assert_eq!((progress.accepted_before(), progress.is_refit_left()), (7, false));
    }
}
