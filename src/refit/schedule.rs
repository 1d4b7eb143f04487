//! When a refit of the potential is due.

use store::{Store, StoreError, VersionRecord, VersionState};

use crate::config::RefitSection;

/// What the times of refits follow from.
#[derive(Clone, Debug, Default)]
pub struct RefitSchedule {
    /// Versions and refused attempts, by number.
    pub versions: Vec<VersionRecord>,
    /// Number of structures that were accepted from biased walks.
    pub accepted: u64,
}

impl RefitSchedule {
    /// Reads it from the campaign's database.
    pub async fn read(store: &Store) -> Result<Self, StoreError> {
        Ok(Self { versions: store.versions().await?, accepted: store.accepted_structures().await? })
    }

    /// The newest registered version; `None` for that of the configuration.
    pub fn in_force(&self) -> Option<&VersionRecord> {
        self.versions.iter().rev().find(|version| version.state == VersionState::Registered)
    }

    /// Number of accepted structures at the last attempt.
    fn accepted_before(&self) -> u64 {
        self.versions.iter().map(|version| version.structures).max().unwrap_or(0)
    }

    /// Whether the campaign trains further versions. Rollbacks do not count.
    fn trains_more(&self, refit: &RefitSection) -> bool {
        let trained = self.versions.iter().filter(|version| {
            version.state == VersionState::Registered && version.method != VersionRecord::ROLLBACK
        });
        trained.count() < refit.max_versions.get() as usize
    }

    /// Number of accepted structures at which biased walks make room for the next version.
    pub fn refit_at(&self, refit: &RefitSection) -> Option<u64> {
        let after = refit.after_structures.filter(|_| self.trains_more(refit))?;
        Some(self.accepted_before() + u64::from(after.get()))
    }

    /// Whether a refit is due when all walks have ended: there is anything new.
    pub fn is_due_after_walks(&self, refit: &RefitSection) -> bool {
        self.trains_more(refit) && self.accepted > self.accepted_before()
    }

    /// Whether a refit is due beside the walks of a live campaign, which began at `begin`; both times in ms since 1970.
    pub fn is_due_beside_walks(&self, refit: &RefitSection, begin: i64, now: i64) -> bool {
        let last = self.versions.iter().map(|version| version.time).max().unwrap_or(begin);
        let by_time = refit.after_time.is_some_and(|time| now - last >= (1000.0 * time.seconds()) as i64);
        let by_structures = self.refit_at(refit).is_some_and(|number| self.accepted >= number);
        self.is_due_after_walks(refit) && (by_time || by_structures)
    }
}

#[cfg(test)]
mod tests {
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
        let mut schedule = RefitSchedule { accepted: 4, ..RefitSchedule::default() };
        assert_eq!((schedule.refit_at(&refit), schedule.in_force()), (Some(5), None));
        assert!(schedule.is_due_after_walks(&refit) && !schedule.is_due_beside_walks(&refit, 0, 9));
        schedule.versions.push(version(1, VersionState::Registered, 4));
        assert_eq!(schedule.refit_at(&refit), Some(9));
        assert!(!schedule.is_due_after_walks(&refit), "nothing is new");
        // A refused attempt counts as one, but not as a version.
        schedule.accepted = 9;
        assert!(schedule.is_due_beside_walks(&refit, 0, 9));
        schedule.versions.push(version(2, VersionState::Refused, 9));
        assert_eq!((schedule.refit_at(&refit), schedule.in_force().unwrap().number), (Some(14), 1));
        assert!(!schedule.is_due_after_walks(&refit));
        schedule.accepted = 20;
        let rollback = VersionRecord {
            method: VersionRecord::ROLLBACK.into(),
            ..version(3, VersionState::Registered, 9)
        };
        schedule.versions.push(rollback);
        assert!(schedule.is_due_after_walks(&refit), "a rollback is no training");
        schedule.versions.push(version(4, VersionState::Registered, 14));
        assert_eq!((schedule.refit_at(&refit), schedule.is_due_after_walks(&refit)), (None, false));
    }

    #[test]
    fn time_counts_from_the_last_attempt_or_the_begin_of_the_campaign() {
        let refit = section("after_time = \"20s\"");
        let mut schedule = RefitSchedule { accepted: 3, ..RefitSchedule::default() };
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 24_999));
        assert!(schedule.is_due_beside_walks(&refit, 5_000, 25_000));
        schedule.versions.push(version(1, VersionState::Refused, 2));
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 29_999));
        assert!(schedule.is_due_beside_walks(&refit, 5_000, 30_000));
        schedule.accepted = 2;
        assert!(!schedule.is_due_beside_walks(&refit, 5_000, 30_000), "nothing is new");
    }
}
