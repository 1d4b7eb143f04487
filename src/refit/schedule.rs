//! When a refit of the potential is due, and which version walks run with.

use calm::rules::Positive;
use monitor::improvement::{Improvement, trained_versions};
use orchestrator::selector::VERSION;
use store::{Store, StoreError, VersionRecord, VersionState};

use super::NO_LABELS;
use super::training_set::has_label_to_train_on;
use crate::config::{Config, RefitSection};

/// What the times of refits follow from.
#[derive(Clone, Debug, Default)]
pub struct RefitSchedule {
    /// Versions and refused attempts, by number.
    pub versions: Vec<VersionRecord>,
    /// Number of structures that were accepted from biased walks.
    pub accepted: u64,
    /// Number of the version that the decision log has taken up.
    pub taken_up: u32,
    /// See [`StopSection::min_improvement`](crate::config::StopSection::min_improvement).
    pub min_improvement: Option<f64>,
    /// See [`RefitSection::max_versions`]; 0 without a refit.
    pub max_versions: usize,
    /// The last attempts were refused because there was no label to train on, and there is one now: they do not count.
    pub labels_came_late: bool,
}

impl RefitSchedule {
    /// Reads it from the campaign's database.
    pub async fn read(store: &Store, config: &Config) -> Result<Self, StoreError> {
        let values = store.values().await?;
        let taken_up = values.iter().find(|(name, _)| name == VERSION);
        let versions = store.versions().await?;
        let labels_came_late = match &config.refit {
            Some(refit) if versions.last().is_some_and(had_no_labels) => {
                let settings = (refit.held_out, refit.control_frames);
                has_label_to_train_on(store, settings, config.campaign.rng_seed).await?
            }
            _ => false,
        };
        Ok(Self {
            versions,
            labels_came_late,
            accepted: store.accepted_structures().await?,
            taken_up: taken_up.and_then(|(_, number)| number.parse().ok()).unwrap_or(0),
            min_improvement: config.stop.min_improvement.map(Positive::get),
            max_versions: config.refit.as_ref().map_or(0, |refit| refit.max_versions.get() as usize),
        })
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
        self.versions.iter().filter(|version| version.state == VersionState::Registered)
    }

    /// Whether the newest version improved so little on its parent that no further one is trained.
    pub fn is_converged(&self) -> bool {
        let improvement = Improvement::of_newest(&self.versions);
        let below = |least: f64| improvement.is_some_and(|found| found.per_100_labels() < least);
        self.min_improvement.is_some_and(below)
    }

    /// Whether as many versions are trained as there may be. Rollbacks do not count.
    fn are_all_trained(&self) -> bool {
        trained_versions(&self.versions).count() >= self.max_versions
    }

    /// Whether the campaign ends with the newest version: no walk starts with it, unless some have before that was known.
    pub fn is_newest_without_walks(&self) -> bool {
        let is_last = |newest: &VersionRecord| {
            newest.method != VersionRecord::ROLLBACK && (self.is_converged() || self.are_all_trained())
        };
        self.newest().is_some_and(|newest| newest.number > self.taken_up && is_last(newest))
    }

    /// Versions and refused attempts whose structures and time the next refit counts from.
    fn attempts(&self) -> impl Iterator<Item = &VersionRecord> {
        let late = self.versions.iter().rev().take_while(|last| self.labels_came_late && had_no_labels(last));
        self.versions.iter().take(self.versions.len() - late.count())
    }

    /// Number of accepted structures at the last attempt.
    fn accepted_before(&self) -> u64 {
        self.attempts().map(|version| version.structures).max().unwrap_or(0)
    }

    /// Whether the campaign trains further versions.
    fn trains_more(&self) -> bool {
        !self.is_converged() && !self.are_all_trained()
    }

    /// Why no walk starts although limits of walks may have been raised: the campaign ended with a version that no walk has. `None` if
    /// it has not.
    pub fn why_no_walk_starts(&self) -> Option<String> {
        let newest = self.newest().filter(|_| self.is_newest_without_walks())?;
        let (key, change) = match self.is_converged() {
            true => ("stop.min_improvement", "lower"),
            false => ("refit.max_versions", "raise"),
        };
        Some(format!(
            "no walk starts: the campaign ended with version {}, the last one by {key}; {change} {key} to start all walks of the plan \
             with that version (raised limits of walks alone start none)",
            newest.number
        ))
    }

    /// Number of accepted structures at which biased walks end for the next version. Those that ended for the last one
    /// stay ended.
    pub fn refit_at(&self, refit: &RefitSection) -> Option<u64> {
        if self.is_newest_without_walks() {
            return Some(0);
        }
        let after = refit.after_structures.filter(|_| self.trains_more())?;
        Some(self.accepted_before() + u64::from(after.get()))
    }

    /// Whether a refit is due when all walks have ended: there is anything new.
    pub fn is_due_after_walks(&self) -> bool {
        self.trains_more() && self.has_news()
    }

    /// Whether structures were accepted since the last attempt.
    pub fn has_news(&self) -> bool {
        self.accepted > self.accepted_before()
    }

    /// Whether a refit is due beside the walks of a live campaign, which began at `begin`; both times in ms since 1970.
    pub fn is_due_beside_walks(&self, refit: &RefitSection, begin: i64, now: i64) -> bool {
        let last = self.attempts().map(|version| version.time).max().unwrap_or(begin);
        let by_time = refit.after_time.is_some_and(|time| now - last >= (1000.0 * time.seconds()) as i64);
        let by_structures = self.refit_at(refit).is_some_and(|number| self.accepted >= number);
        self.is_due_after_walks() && (by_time || by_structures)
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

    fn section(text: &str) -> RefitSection {
        toml::from_str(&format!("replay = [\"seed.extxyz\"]\n{text}")).unwrap()
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
        let mut schedule =
            RefitSchedule { accepted: 4, max_versions: 2, taken_up: 9, ..RefitSchedule::default() };
        assert_eq!((schedule.refit_at(&refit), schedule.in_force()), (Some(5), None));
        assert!(schedule.is_due_after_walks() && !schedule.is_due_beside_walks(&refit, 0, 9));
        schedule.versions.push(version(1, VersionState::Registered, 4));
        assert_eq!(schedule.refit_at(&refit), Some(9));
        assert!(!schedule.is_due_after_walks(), "nothing is new");
        // A refused attempt counts as one, but not as a version.
        schedule.accepted = 9;
        assert!(schedule.is_due_beside_walks(&refit, 0, 9));
        schedule.versions.push(version(2, VersionState::Refused, 9));
        assert_eq!((schedule.refit_at(&refit), schedule.in_force().unwrap().number), (Some(14), 1));
        assert!(!schedule.is_due_after_walks());
        schedule.accepted = 20;
        let rollback = VersionRecord {
            method: VersionRecord::ROLLBACK.into(),
            ..version(3, VersionState::Registered, 9)
        };
        schedule.versions.push(rollback);
        assert!(schedule.is_due_after_walks(), "a rollback is no training");
        schedule.versions.push(version(4, VersionState::Registered, 14));
        assert_eq!((schedule.refit_at(&refit), schedule.is_due_after_walks()), (None, false));
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
        let mut schedule = RefitSchedule {
            versions: vec![trained(1, 0.8), trained(2, 0.9)],
            accepted: 20,
            taken_up: 1,
            min_improvement: Some(0.15),
            max_versions: 9,
            labels_came_late: false,
        };
        let in_force = |schedule: &RefitSchedule| schedule.in_force().map_or(0, |version| version.number);
        assert!(!schedule.is_converged() && schedule.is_due_after_walks());
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (2, Some(7)));
        schedule.min_improvement = Some(0.25);
        assert!(schedule.is_converged() && schedule.is_newest_without_walks());
        assert!(!schedule.is_due_after_walks() && !schedule.is_due_beside_walks(&refit, 0, i64::MAX));
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (1, Some(0)));
        // Walks that have begun with it run to their end.
        schedule.taken_up = 2;
        assert!(!schedule.is_newest_without_walks() && !schedule.is_due_after_walks());
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (2, None));
        schedule.min_improvement = None;
        assert!(schedule.is_due_after_walks());
        // The first version is the last one.
        schedule.versions.pop();
        (schedule.taken_up, schedule.min_improvement) = (0, Some(0.5));
        assert_eq!((in_force(&schedule), schedule.refit_at(&refit)), (0, Some(0)));
    }

    /// The labels of the last walks are trained on, and no walk is run for nothing.
    #[test]
    fn the_campaign_ends_with_its_last_version() {
        let refit = section("after_structures = 5");
        let mut schedule = RefitSchedule {
            versions: vec![version(1, VersionState::Registered, 5)],
            accepted: 9,
            taken_up: 1,
            max_versions: 2,
            ..RefitSchedule::default()
        };
        assert!(schedule.is_due_after_walks() && !schedule.is_newest_without_walks());
        schedule.versions.push(version(2, VersionState::Registered, 9));
        assert!(!schedule.is_due_after_walks() && schedule.is_newest_without_walks());
        assert_eq!((schedule.in_force().unwrap().number, schedule.refit_at(&refit)), (1, Some(0)));
        let why = schedule.why_no_walk_starts().unwrap();
        assert!(why.contains("version 2") && why.contains("raise refit.max_versions"), "{why}");
        // With a larger limit it goes on with that version.
        schedule.max_versions = 3;
        assert!(!schedule.is_due_after_walks() && !schedule.is_newest_without_walks());
        assert_eq!((schedule.in_force().unwrap().number, schedule.refit_at(&refit)), (2, Some(14)));
        assert_eq!(schedule.why_no_walk_starts(), None);
        // Walks of a version that the user rolls back to are wanted.
        let method = VersionRecord::ROLLBACK.into();
        schedule.versions.push(VersionRecord { method, ..version(3, VersionState::Registered, 9) });
        schedule.max_versions = 2;
        assert!(!schedule.is_newest_without_walks());
        assert_eq!(schedule.in_force().unwrap().number, 3);
    }

    /// A structure whose label came too late for an attempt is trained on by the next one.
    #[test]
    fn attempts_without_labels_do_not_count_once_there_are_labels() {
        let refit = section("after_structures = 5\nafter_time = \"20s\"");
        let no_labels = |number| VersionRecord {
            reason: NO_LABELS.into(),
            ..version(number, VersionState::Refused, 4 + u64::from(number))
        };
        let mut schedule = RefitSchedule {
            versions: vec![version(1, VersionState::Refused, 1), no_labels(2), no_labels(3)],
            accepted: 7,
            max_versions: 2,
            ..RefitSchedule::default()
        };
        assert_eq!(schedule.refit_at(&refit), Some(12));
        assert!(!schedule.has_news() && !schedule.is_due_beside_walks(&refit, 0, i64::MAX));
        schedule.labels_came_late = true;
        assert_eq!(schedule.refit_at(&refit), Some(6));
        assert!(schedule.is_due_after_walks() && schedule.is_due_beside_walks(&refit, 0, 10_000));
        // With too few structures, by the time since the attempt before.
        schedule.accepted = 5;
        assert!(!schedule.is_due_beside_walks(&refit, 0, 29_999));
        assert!(schedule.is_due_beside_walks(&refit, 0, 30_000));
        // Only the last ones are left out: what came between is trained on already.
        schedule.versions.push(version(4, VersionState::Registered, 5));
        assert!(!schedule.has_news());
    }

    #[test]
    fn time_counts_from_the_last_attempt_or_the_begin_of_the_campaign() {
        let refit = section("after_time = \"20s\"");
        let mut schedule = RefitSchedule { accepted: 3, max_versions: 2, ..RefitSchedule::default() };
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 24_999));
        assert!(schedule.is_due_beside_walks(&refit, 5_000, 25_000));
        schedule.versions.push(version(1, VersionState::Refused, 2));
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 29_999));
        assert!(schedule.is_due_beside_walks(&refit, 5_000, 30_000));
        schedule.accepted = 2;
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 30_000), "nothing is new");
    }
}
