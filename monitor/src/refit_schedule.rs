//! When a refit of the potential is due, which version walks run with, and what follows when they end.

use store::{Store, StoreError, VersionRecord, VersionState};

use crate::refit_progress::{RefitProgress, RefitRules};
use crate::versions::taken_up;

/// The settings that the times of refits follow from, besides the [`RefitRules`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RefitTiming {
    /// Refits run beside the walks (live mode), which make room for no version before it is there.
    pub beside_walks: bool,
    /// `refit.after_structures`.
    pub after_structures: Option<u32>,
    /// `refit.after_time`, ms.
    pub after_time: Option<i64>,
}

/// What the times of refits follow from.
#[derive(Clone, Debug, Default)]
pub struct RefitSchedule {
    /// The settings.
    pub timing: RefitTiming,
    /// The versions, and whether one is left to train.
    pub progress: RefitProgress,
    /// Number of the version that the decision log last switched to.
    pub taken_up: u32,
}

/// What the versions of the potential mean for walks that run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BesideWalks {
    /// They make room for those of a newer version, which do not wait for labels.
    Superseded,
    /// They end: the last version is there, with which no walk starts.
    WalksEnd,
    /// They go on, and a refit is due.
    RefitDue,
    /// They go on.
    GoOn,
}

/// What follows when all walks of a version have ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AfterWalks {
    /// Walks with a newer version. A refit that runs has become pointless: the user went back to a version.
    NewerVersion,
    /// A refit, or the rest of the one that runs.
    Refit,
    /// The campaign is over.
    End,
}

impl RefitSchedule {
    /// Reads it from the campaign's database.
    pub async fn read(store: &Store, rules: RefitRules, timing: RefitTiming) -> Result<Self, StoreError> {
        let taken_up = taken_up(&store.values().await?);
        Ok(Self { timing, progress: RefitProgress::read(store, rules).await?, taken_up })
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

    /// Number of the version that walks run with; 0 is that of the configuration.
    pub fn number_in_force(&self) -> u32 {
        self.in_force().map_or(0, |version| version.number)
    }

    /// Number of accepted structures at which biased walks end for the next version. Those that ended for the last one
    /// stay ended.
    pub fn refit_at(&self) -> Option<u64> {
        if self.is_newest_without_walks() {
            return Some(0);
        }
        let after = self.timing.after_structures.filter(|_| self.progress.trains_more())?;
        Some(self.progress.accepted_before() + u64::from(after))
    }

    /// The same for walks that start now. Walks continue beside a refit, until the last version is there.
    pub fn walks_end_at(&self) -> Option<u32> {
        if self.timing.beside_walks && !self.is_newest_without_walks() {
            return None;
        }
        self.refit_at().map(|number| number.min(u32::MAX.into()) as u32)
    }

    /// Whether a refit is due beside the walks of a live campaign, which began at `begin`; both times in ms since 1970.
    pub fn is_due_beside_walks(&self, begin: i64, now: i64) -> bool {
        let last = self.progress.attempts().map(|version| version.time).max().unwrap_or(begin);
        let by_time = self.timing.after_time.is_some_and(|time| now - last >= time);
        let by_structures = self.refit_at().is_some_and(|number| self.progress.accepted >= number);
        self.progress.is_refit_left() && (by_time || by_structures)
    }

    /// What the versions mean for walks that run with this one, beside which refits run. The campaign began at `begin`; both times in
    /// ms since 1970.
    pub fn beside_walks(&self, version: u32, begin: i64, now: i64) -> BesideWalks {
        if self.number_in_force() > version {
            BesideWalks::Superseded
        } else if self.newest().is_some_and(|newest| newest.number > version) {
            BesideWalks::WalksEnd
        } else if self.is_due_beside_walks(begin, now) {
            BesideWalks::RefitDue
        } else {
            BesideWalks::GoOn
        }
    }

    /// What follows when all walks of this version have ended, and a refit is running or not.
    pub fn after_walks(&self, version: u32, is_refit_running: bool) -> AfterWalks {
        if self.number_in_force() > version {
            AfterWalks::NewerVersion
        } else if is_refit_running || self.progress.is_refit_left() {
            AfterWalks::Refit
        } else {
            AfterWalks::End
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::refit_progress::NO_LABELS;

    /// Without versions; times in s.
    fn schedule(timing: (Option<u32>, Option<i64>), accepted: u64, max_versions: usize) -> RefitSchedule {
        let (after_structures, after_time) = timing;
        let timing = RefitTiming {
            beside_walks: true,
            after_structures,
            after_time: after_time.map(|time| 1000 * time),
        };
        let rules = RefitRules { max_versions, ..RefitRules::default() };
        let progress = RefitProgress { rules, accepted, ..RefitProgress::default() };
        RefitSchedule { timing, progress, taken_up: 0 }
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
        let mut schedule = schedule((Some(5), None), 4, 2);
        schedule.taken_up = 9;
        assert_eq!((schedule.refit_at(), schedule.in_force()), (Some(5), None));
        assert!(schedule.progress.is_refit_left() && !schedule.is_due_beside_walks(0, 9));
        schedule.progress.versions.push(version(1, VersionState::Registered, 4));
        assert_eq!(schedule.refit_at(), Some(9));
        assert!(!schedule.progress.is_refit_left(), "nothing is new");
        // A refused attempt counts as one, but not as a version.
        schedule.progress.accepted = 9;
        assert!(schedule.is_due_beside_walks(0, 9));
        schedule.progress.versions.push(version(2, VersionState::Refused, 9));
        assert_eq!((schedule.refit_at(), schedule.in_force().unwrap().number), (Some(14), 1));
        assert!(!schedule.progress.is_refit_left());
        schedule.progress.accepted = 20;
        let rollback = VersionRecord {
            method: VersionRecord::ROLLBACK.into(),
            ..version(3, VersionState::Registered, 9)
        };
        schedule.progress.versions.push(rollback);
        assert!(schedule.progress.is_refit_left(), "a rollback is no training");
        schedule.progress.versions.push(version(4, VersionState::Registered, 14));
        assert_eq!((schedule.refit_at(), schedule.progress.is_refit_left()), (None, false));
    }

    #[test]
    fn the_campaign_ends_with_a_version_that_improves_too_little() {
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
        let mut schedule = schedule((Some(5), None), 20, 9);
        schedule.progress.versions = vec![trained(1, 0.8), trained(2, 0.9)];
        schedule.taken_up = 1;
        schedule.progress.rules.min_improvement = Some(0.15);
        let in_force = |schedule: &RefitSchedule| schedule.in_force().map_or(0, |version| version.number);
        assert!(schedule.progress.small_improvement().is_none() && schedule.progress.is_refit_left());
        assert_eq!((in_force(&schedule), schedule.refit_at()), (2, Some(7)));
        schedule.progress.rules.min_improvement = Some(0.25);
        assert!(schedule.progress.small_improvement().is_some() && schedule.is_newest_without_walks());
        assert!(!schedule.progress.is_refit_left() && !schedule.is_due_beside_walks(0, i64::MAX));
        assert_eq!((in_force(&schedule), schedule.refit_at()), (1, Some(0)));
        // Walks that have begun with it run to their end.
        schedule.taken_up = 2;
        assert!(!schedule.is_newest_without_walks() && !schedule.progress.is_refit_left());
        assert_eq!((in_force(&schedule), schedule.refit_at()), (2, None));
        schedule.progress.rules.min_improvement = None;
        assert!(schedule.progress.is_refit_left());
        // The first version is the last one.
        schedule.progress.versions.pop();
        (schedule.taken_up, schedule.progress.rules.min_improvement) = (0, Some(0.5));
        assert_eq!((in_force(&schedule), schedule.refit_at()), (0, Some(0)));
    }

    /// The labels of the last walks are trained on, and no walk is run for nothing.
    #[test]
    fn the_campaign_ends_with_its_last_version() {
        let mut schedule = schedule((Some(5), None), 9, 2);
        schedule.progress.versions = vec![version(1, VersionState::Registered, 5)];
        schedule.taken_up = 1;
        assert!(schedule.progress.is_refit_left() && !schedule.is_newest_without_walks());
        schedule.progress.versions.push(version(2, VersionState::Registered, 9));
        assert!(!schedule.progress.is_refit_left() && schedule.is_newest_without_walks());
        assert_eq!((schedule.in_force().unwrap().number, schedule.refit_at()), (1, Some(0)));
        // With a larger limit it continues with that version.
        schedule.progress.rules.max_versions = 3;
        assert!(!schedule.progress.is_refit_left() && !schedule.is_newest_without_walks());
        assert_eq!((schedule.in_force().unwrap().number, schedule.refit_at()), (2, Some(14)));
        // Walks of a version that the user rolls back to are wanted.
        let method = VersionRecord::ROLLBACK.into();
        schedule.progress.versions.push(VersionRecord { method, ..version(3, VersionState::Registered, 9) });
        schedule.progress.rules.max_versions = 2;
        assert!(!schedule.is_newest_without_walks());
        assert_eq!(schedule.in_force().unwrap().number, 3);
    }

    #[test]
    fn a_refit_by_time_needs_other_labels_or_structures() {
        let mut schedule = schedule((Some(5), Some(20)), 4, 2);
        schedule.progress.versions = vec![version(1, VersionState::Refused, 4)];
        assert!(!schedule.is_due_beside_walks(0, i64::MAX));
        schedule.progress.has_new_labels = true;
        assert!(schedule.is_due_beside_walks(0, 30_000) && !schedule.is_due_beside_walks(0, 29_999));
        assert!(schedule.progress.is_refit_left());
    }

    /// A structure whose label came too late for an attempt is trained on by the next one.
    #[test]
    fn attempts_without_labels_do_not_count_once_there_are_labels() {
        let no_labels = |number| VersionRecord {
            reason: NO_LABELS.into(),
            ..version(number, VersionState::Refused, 4 + u64::from(number))
        };
        let mut schedule = schedule((Some(5), Some(20)), 7, 2);
        schedule.progress.versions = vec![version(1, VersionState::Refused, 1), no_labels(2), no_labels(3)];
        assert_eq!(schedule.refit_at(), Some(12));
        assert!(!schedule.progress.has_news() && !schedule.is_due_beside_walks(0, i64::MAX));
        schedule.progress.labels_came_late = true;
        assert_eq!(schedule.refit_at(), Some(6));
        assert!(schedule.progress.is_refit_left() && schedule.is_due_beside_walks(0, 10_000));
        // With too few structures, by the time since the attempt before.
        schedule.progress.accepted = 5;
        assert!(!schedule.is_due_beside_walks(0, 29_999));
        assert!(schedule.is_due_beside_walks(0, 30_000));
    }

    #[test]
    fn time_counts_from_the_last_attempt_or_the_begin_of_the_campaign() {
        let mut schedule = schedule((None, Some(20)), 3, 2);
        assert!(!schedule.is_due_beside_walks(5_000, 24_999));
        assert!(schedule.is_due_beside_walks(5_000, 25_000));
        schedule.progress.versions.push(version(1, VersionState::Refused, 2));
        assert!(!schedule.is_due_beside_walks(5_000, 29_999));
        assert!(schedule.is_due_beside_walks(5_000, 30_000));
        schedule.progress.accepted = 2;
        assert!(!schedule.is_due_beside_walks(5_000, 30_000), "nothing is new");
    }

    /// What a version means for the walks before it, while they run and when they have ended.
    #[test]
    fn walks_make_room_for_newer_versions_and_refits_follow_them() {
        let mut schedule = schedule((Some(5), None), 4, 2);
        assert_eq!(schedule.beside_walks(0, 0, 0), BesideWalks::GoOn);
        assert_eq!((schedule.walks_end_at(), schedule.after_walks(0, false)), (None, AfterWalks::Refit));
        schedule.progress.accepted = 5;
        assert_eq!(schedule.beside_walks(0, 0, 0), BesideWalks::RefitDue);
        schedule.timing.beside_walks = false;
        assert_eq!(schedule.walks_end_at(), Some(5));
        schedule.timing.beside_walks = true;
        schedule.progress.versions = vec![version(1, VersionState::Registered, 5)];
        assert_eq!(schedule.beside_walks(0, 0, 0), BesideWalks::Superseded);
        assert_eq!(schedule.after_walks(0, true), AfterWalks::NewerVersion);
        // Nothing is new since, but a refit may run that began before.
        assert_eq!(schedule.beside_walks(1, 0, 0), BesideWalks::GoOn);
        assert_eq!(
            [true, false].map(|runs| schedule.after_walks(1, runs)),
            [AfterWalks::Refit, AfterWalks::End]
        );
        // No walk starts with the last version.
        schedule.taken_up = 1;
        schedule.progress.accepted = 9;
        schedule.progress.versions.push(version(2, VersionState::Registered, 9));
        assert_eq!(schedule.beside_walks(1, 0, 0), BesideWalks::WalksEnd);
        assert_eq!((schedule.walks_end_at(), schedule.after_walks(1, false)), (Some(0), AfterWalks::End));
    }
}
