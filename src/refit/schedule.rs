//! When a refit of the potential is due, and which version walks run with.

use calm::rules::Positive;
use monitor::refit_progress::{LabelSplit, RefitProgress, RefitRules};
use orchestrator::selector::VERSION;
use store::{Store, StoreError, VersionRecord, VersionState};

use crate::config::{Config, ControlFrames, RefitSection};

/// What the times of refits follow from.
#[derive(Clone, Debug, Default)]
pub struct RefitSchedule {
    /// The versions, and whether one is left to train.
    pub progress: RefitProgress,
    /// Number of the version that the decision log last switched to.
    pub taken_up: u32,
}

impl RefitSchedule {
    /// Reads it from the campaign's database.
    pub async fn read(store: &Store, config: &Config) -> Result<Self, StoreError> {
        let values = store.values().await?;
        let taken_up = values.iter().find(|(name, _)| name == VERSION);
        let taken_up = taken_up.and_then(|(_, number)| number.parse().ok()).unwrap_or(0);
        Ok(Self { progress: RefitProgress::read(store, rules(config)).await?, taken_up })
    }

    /// The newest registered version; `None` for that of the configuration.
    pub fn newest(&self) -> Option<&VersionRecord> {
        self.registered().next_back()
    }

    /// The version that walks run with: the newest one unless it is without walks. `None` for that of the configuration.
    pub fn in_force(&self) -> Option<&VersionRecord> {
        match self.is_newest_without_walks() {
            true => self.registered().find(|version| version.number == self.taken_up),
            false => self.newest(),
        }
    }

    fn registered(&self) -> impl DoubleEndedIterator<Item = &VersionRecord> {
        self.progress.versions.iter().filter(|version| version.state == VersionState::Registered)
    }

    /// Whether the campaign ends with the newest version: no walk starts with it, unless some have before that was known.
    pub fn is_newest_without_walks(&self) -> bool {
        let is_last =
            |newest: &VersionRecord| newest.method != VersionRecord::ROLLBACK && !self.progress.trains_more();
        self.newest().is_some_and(|newest| newest.number > self.taken_up && is_last(newest))
    }

    /// Why no walk starts although limits of walks may have been raised: the campaign ended with a version that no walk has. `None` if
    /// it has not.
    pub fn why_no_walk_starts(&self) -> Option<String> {
        let newest = self.newest().filter(|_| self.is_newest_without_walks())?;
        let (key, change) = match self.progress.small_improvement().is_some() {
            true => ("stop.min_improvement", "lower"),
            false => ("refit.max_versions", "raise"),
        };
        Some(format!(
            "no walk starts: the campaign ended with version {}, the last one by {key}; {change} {key} to start all planned walks \
             with that version (raising limits of walks alone starts none)",
            newest.number
        ))
    }

    /// Number of accepted structures at which biased walks end for the next version. Those that ended for the last one
    /// stay ended.
    pub fn refit_at(&self, refit: &RefitSection) -> Option<u64> {
        if self.is_newest_without_walks() {
            return Some(0);
        }
        let after = refit.after_structures.filter(|_| self.progress.trains_more())?;
        Some(self.progress.accepted_before() + u64::from(after.get()))
    }

    /// Whether a refit is due beside the walks of a live campaign, which began at `begin`; both times in ms since 1970.
    pub fn is_due_beside_walks(&self, refit: &RefitSection, begin: i64, now: i64) -> bool {
        let last = self.progress.attempts().map(|version| version.time).max().unwrap_or(begin);
        let by_time = refit.after_time.is_some_and(|time| now - last >= (1000.0 * time.seconds()) as i64);
        let by_structures = self.refit_at(refit).is_some_and(|number| self.progress.accepted >= number);
        self.progress.is_refit_left() && (by_time || by_structures)
    }
}

/// The rules of a configuration.
pub(super) fn rules(config: &Config) -> RefitRules {
    let split = |refit: &RefitSection| LabelSplit {
        held_out: refit.held_out,
        compares_controls: refit.control_frames == ControlFrames::Compare,
        rng_seed: config.campaign.rng_seed,
    };
    RefitRules {
        min_improvement: config.stop.min_improvement.map(Positive::get),
        max_versions: config.refit.as_ref().map_or(0, |refit| refit.max_versions.get() as usize),
        split: config.refit.as_ref().map(split).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use monitor::refit_progress::NO_LABELS;
    use serde_json::json;

    use super::*;

    fn section(text: &str) -> RefitSection {
        toml::from_str(&format!("replay = [\"seed.extxyz\"]\n{text}")).unwrap()
    }

    /// Without versions.
    fn schedule(accepted: u64, max_versions: usize) -> RefitSchedule {
        let rules = RefitRules { max_versions, ..RefitRules::default() };
        RefitSchedule { progress: RefitProgress { rules, accepted, ..RefitProgress::default() }, taken_up: 0 }
    }

    fn version(number: u32, state: VersionState, structures: u64) -> VersionRecord {
        VersionRecord {
            number,
            parent: 0,
            state,
            reason: String::new(),
            method: "native".into(),
            structures,
            last_decision: 1,
            labels: 1,
            model_hash: String::new(),
            mixture_hash: String::new(),
            figures: serde_json::Value::Null,
            seconds: 1.0,
            core_hours: 0.0,
            time: 10_000 * i64::from(number),
        }
    }

    #[test]
    fn refits_count_structures_from_the_last_attempt() {
        let refit = section("after_structures = 5\nmax_versions = 2");
        let mut schedule = schedule(4, 2);
        schedule.taken_up = 9;
        assert_eq!((schedule.refit_at(&refit), schedule.in_force()), (Some(5), None));
        assert!(schedule.progress.is_refit_left() && !schedule.is_due_beside_walks(&refit, 0, 9));
        schedule.progress.versions.push(version(1, VersionState::Registered, 4));
        assert_eq!(schedule.refit_at(&refit), Some(9));
        assert!(!schedule.progress.is_refit_left(), "nothing is new");
        // A refused attempt counts as one, but not as a version.
        schedule.progress.accepted = 9;
        assert!(schedule.is_due_beside_walks(&refit, 0, 9));
        schedule.progress.versions.push(version(2, VersionState::Refused, 9));
        assert_eq!((schedule.refit_at(&refit), schedule.in_force().unwrap().number), (Some(14), 1));
        assert!(!schedule.progress.is_refit_left());
        schedule.progress.accepted = 20;
        let rollback = VersionRecord {
            method: VersionRecord::ROLLBACK.into(),
            ..version(3, VersionState::Registered, 9)
        };
        schedule.progress.versions.push(rollback);
        assert!(schedule.progress.is_refit_left(), "a rollback is no training");
        schedule.progress.versions.push(version(4, VersionState::Registered, 14));
        assert_eq!((schedule.refit_at(&refit), schedule.progress.is_refit_left()), (None, false));
    }

    #[test]
    fn the_campaign_ends_with_a_version_that_improves_too_little() {
        let refit = section("after_structures = 5\nmax_versions = 9");
        let trained = |number: u32, error: f64| {
            let [parent, own] = [1.0, error].map(|error| json!({ "force_mae": error }));
            let set = json!({ "kind": "held_out", "structures": 5, "parent": parent, "version": own });
            VersionRecord {
                parent: number - 1,
                labels: 50 * u64::from(number),
                figures: json!({ "sets": [set] }),
                ..version(number, VersionState::Registered, u64::from(number))
            }
        };
        // The first has 40 % less for each 100 labels, the second 20 %.
        let mut schedule = schedule(20, 9);
        schedule.progress.versions = vec![trained(1, 0.8), trained(2, 0.9)];
        schedule.taken_up = 1;
        schedule.progress.rules.min_improvement = Some(0.15);
        let in_force = |schedule: &RefitSchedule| schedule.in_force().map_or(0, |version| version.number);
        assert!(schedule.progress.small_improvement().is_none() && schedule.progress.is_refit_left());
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (2, Some(7)));
        schedule.progress.rules.min_improvement = Some(0.25);
        assert!(schedule.progress.small_improvement().is_some() && schedule.is_newest_without_walks());
        assert!(!schedule.progress.is_refit_left() && !schedule.is_due_beside_walks(&refit, 0, i64::MAX));
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (1, Some(0)));
        // Walks that have begun with it run to their end.
        schedule.taken_up = 2;
        assert!(!schedule.is_newest_without_walks() && !schedule.progress.is_refit_left());
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (2, None));
        schedule.progress.rules.min_improvement = None;
        assert!(schedule.progress.is_refit_left());
        // The first version is the last one.
        schedule.progress.versions.pop();
        (schedule.taken_up, schedule.progress.rules.min_improvement) = (0, Some(0.5));
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (0, Some(0)));
    }

    /// The labels of the last walks are trained on, and no walk is run for nothing.
    #[test]
    fn the_campaign_ends_with_its_last_version() {
        let refit = section("after_structures = 5");
        let mut schedule = schedule(9, 2);
        schedule.progress.versions = vec![version(1, VersionState::Registered, 5)];
        schedule.taken_up = 1;
        assert!(schedule.progress.is_refit_left() && !schedule.is_newest_without_walks());
        schedule.progress.versions.push(version(2, VersionState::Registered, 9));
        assert!(!schedule.progress.is_refit_left() && schedule.is_newest_without_walks());
        assert_eq!((schedule.in_force().unwrap().number, schedule.refit_at(&refit)), (1, Some(0)));
        let why = schedule.why_no_walk_starts().unwrap();
        assert!(why.contains("version 2") && why.contains("raise refit.max_versions"), "{why}");
        // With a larger limit it continues with that version.
        schedule.progress.rules.max_versions = 3;
        assert!(!schedule.progress.is_refit_left() && !schedule.is_newest_without_walks());
        assert_eq!((schedule.in_force().unwrap().number, schedule.refit_at(&refit)), (2, Some(14)));
        assert_eq!(schedule.why_no_walk_starts(), None);
        // Walks of a version that the user rolls back to are wanted.
        let method = VersionRecord::ROLLBACK.into();
        schedule.progress.versions.push(VersionRecord { method, ..version(3, VersionState::Registered, 9) });
        schedule.progress.rules.max_versions = 2;
        assert!(!schedule.is_newest_without_walks());
        assert_eq!(schedule.in_force().unwrap().number, 3);
    }

    #[test]
    fn a_refit_by_time_needs_other_labels_or_structures() {
        let refit = section("after_structures = 5\nafter_time = \"20s\"");
        let mut schedule = schedule(4, 2);
        schedule.progress.versions = vec![version(1, VersionState::Refused, 4)];
        assert!(!schedule.is_due_beside_walks(&refit, 0, i64::MAX));
        schedule.progress.has_new_labels = true;
        assert!(
            schedule.is_due_beside_walks(&refit, 0, 30_000)
                && !schedule.is_due_beside_walks(&refit, 0, 29_999)
        );
        assert!(schedule.progress.is_refit_left());
    }

    /// A structure whose label came too late for an attempt is trained on by the next one.
    #[test]
    fn attempts_without_labels_do_not_count_once_there_are_labels() {
        let refit = section("after_structures = 5\nafter_time = \"20s\"");
        let no_labels = |number| VersionRecord {
            reason: NO_LABELS.into(),
            ..version(number, VersionState::Refused, 4 + u64::from(number))
        };
        let mut schedule = schedule(7, 2);
        schedule.progress.versions = vec![version(1, VersionState::Refused, 1), no_labels(2), no_labels(3)];
        assert_eq!(schedule.refit_at(&refit), Some(12));
        assert!(!schedule.progress.has_news() && !schedule.is_due_beside_walks(&refit, 0, i64::MAX));
        schedule.progress.labels_came_late = true;
        assert_eq!(schedule.refit_at(&refit), Some(6));
        assert!(schedule.progress.is_refit_left() && schedule.is_due_beside_walks(&refit, 0, 10_000));
        // With too few structures, by the time since the attempt before.
        schedule.progress.accepted = 5;
        assert!(!schedule.is_due_beside_walks(&refit, 0, 29_999));
        assert!(schedule.is_due_beside_walks(&refit, 0, 30_000));
    }

    #[test]
    fn time_counts_from_the_last_attempt_or_the_begin_of_the_campaign() {
        let refit = section("after_time = \"20s\"");
        let mut schedule = schedule(3, 2);
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 24_999));
        assert!(schedule.is_due_beside_walks(&refit, 5_000, 25_000));
        schedule.progress.versions.push(version(1, VersionState::Refused, 2));
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 29_999));
        assert!(schedule.is_due_beside_walks(&refit, 5_000, 30_000));
        schedule.progress.accepted = 2;
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 30_000), "nothing is new");
    }
}
