//! The schedule of the refits of a configuration.

use calm::rules::Positive;
use monitor::refit_progress::{LabelSplit, RefitRules};
use monitor::refit_schedule::{RefitSchedule, RefitTiming};
use orchestrator::selector::CampaignMode;
use store::{Store, StoreError};

use crate::config::{Config, ControlFrames, RefitSection};

/// Reads it from the campaign's database.
pub async fn read(store: &Store, config: &Config) -> Result<RefitSchedule, StoreError> {
    RefitSchedule::read(store, rules(config), timing(config)).await
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

fn timing(config: &Config) -> RefitTiming {
    let refit = config.refit.as_ref();
    RefitTiming {
        beside_walks: config.campaign.mode == CampaignMode::Live,
        after_structures: refit.and_then(|refit| refit.after_structures).map(|number| number.get()),
        after_time: refit.and_then(|refit| refit.after_time).map(|time| (1000.0 * time.seconds()) as i64),
    }
}

/// Why no walk starts although limits of walks may have been raised: the campaign ended with a version that no walk has. `None` if
/// it has not.
pub fn why_no_walk_starts(schedule: &RefitSchedule) -> Option<String> {
    let newest = schedule.newest().filter(|_| schedule.is_newest_without_walks())?;
    let (key, change) = match schedule.progress.small_improvement().is_some() {
        true => ("stop.min_improvement", "lower"),
        false => ("refit.max_versions", "raise"),
    };
    Some(format!(
        "no walk starts: the campaign ended with version {}, the last one by {key}; {change} {key} to start all planned walks \
         with that version (raising limits of walks alone starts none)",
        newest.number
    ))
}

#[cfg(test)]
mod tests {
    use monitor::refit_progress::RefitProgress;
    use serde_json::Value;
    use store::{VersionRecord, VersionState};

    use super::*;

    #[test]
    fn the_key_that_ended_the_campaign_is_named() {
        let last = VersionRecord {
            number: 2,
            parent: 1,
            state: VersionState::Registered,
            reason: String::new(),
            method: "native".into(),
            structures: 9,
            last_decision: 1,
            labels: 1,
            model_hash: String::new(),
            mixture_hash: String::new(),
            figures: Value::Null,
            seconds: 1.0,
            core_hours: 0.0,
            time: 0,
        };
        let rules = RefitRules { max_versions: 1, ..RefitRules::default() };
        let progress = RefitProgress { rules, versions: vec![last], accepted: 9, ..RefitProgress::default() };
        let mut schedule = RefitSchedule { progress, taken_up: 1, ..RefitSchedule::default() };
        let why = why_no_walk_starts(&schedule).unwrap();
        assert!(why.contains("version 2") && why.contains("raise refit.max_versions"), "{why}");
        schedule.progress.rules.max_versions = 3;
        assert_eq!(why_no_walk_starts(&schedule), None);
    }
}
