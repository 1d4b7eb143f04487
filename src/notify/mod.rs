//! What the owner of a campaign is told of, each thing once: the core, which knows neither clock nor store. `actors/notify` is its
//! shell.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use store::Status;

use crate::config::{NotifyEvent, NotifySection};
use crate::ends::Ends;
use crate::forgetting::Forgetting;
use crate::output::count;

const MINUTE: f64 = 60_000.0;
/// What was told last of forgetting, while the alarm holds.
const HOLDS: &str = "holds";

/// Under which name it is kept in the store what was told.
pub const NOTE: &str = "notified";

/// What was told last, by the name of the event: also by earlier runs.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(transparent)]
pub struct Told(BTreeMap<String, String>);

/// Something that has happened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Due {
    /// What.
    pub event: NotifyEvent,
    /// In words.
    pub message: String,
}

/// Looks at a campaign again and again.
#[derive(Debug)]
pub struct Watch {
    settings: NotifySection,
    told: Told,
    /// Candidates and labels so far, and since when there are no more, ms.
    still: Option<((u64, u64), i64)>,
}

impl Watch {
    /// Goes on where others left off.
    pub fn new(settings: NotifySection, told: Told) -> Self {
        Self { settings, told, still: None }
    }

    /// What was told, with what is due.
    pub fn told(&self) -> &Told {
        &self.told
    }

    /// What there is to tell of a campaign that stands so at the time `now`, ms since 1970.
    pub fn look(&mut self, status: &Status, now: i64) -> Vec<Due> {
        let candidates = status.candidates.seen + status.candidates.control;
        let labels = status.budget.used.labels + status.labels.failed;
        let mut due = Vec::new();
        let so_far = format!("{}, {}", count(candidates, "candidate"), count(labels, "label"));
        if let Some(key) = &status.budget.used_up {
            let limits = &status.budget.limits;
            let limit = (key, limits.labels, limits.core_hours, limits.wall_hours);
            due.extend(self.due(NotifyEvent::Budget, format!("{limit:?}"), format!("{key} is used up")));
        }
        due.extend(self.failed_labels(status.labels.failed));
        due.extend(self.failing_walks(&Ends::of(&status.walks)));
        if status.finished {
            due.extend(self.due(
                NotifyEvent::End,
                so_far.clone(),
                format!("the campaign is finished: {so_far}"),
            ));
        } else {
            due.extend(self.stall((candidates, labels), so_far, now));
        }
        due
    }

    /// What there is to tell of a mixture of which this share of the training atoms has γ > 1; `raised` is whether the selector
    /// found that to be an alarm.
    pub fn look_at_training(&mut self, forgetting: &Forgetting, share: f64, raised: bool) -> Option<Due> {
        let event = NotifyEvent::Forgetting;
        let (holds, was) = (forgetting.holds(share, raised)?, self.told.0.get(event.name()));
        match holds {
            true => self.due(event, HOLDS.to_owned(), forgetting.begun(share)),
            false if was.is_some_and(|was| was == HOLDS) => {
                self.due(event, "over".to_owned(), forgetting.over(share))
            }
            false => None,
        }
    }

    /// A run could not go on. That is news each time.
    pub fn failed(&mut self, why: &str) -> Option<Due> {
        let event = NotifyEvent::Failure;
        self.is_wanted(event).then(|| Due { event, message: format!("calmwalk run cannot go on: {why}") })
    }

    fn stall(&mut self, so_far: (u64, u64), shown: String, now: i64) -> Option<Due> {
        let (before, since) = *self.still.get_or_insert((so_far, now));
        if before != so_far {
            self.still = Some((so_far, now));
            return None;
        }
        let minutes = (now - since) as f64 / MINUTE;
        if minutes < self.settings.stall.seconds() / 60.0 {
            return None;
        }
        let digits = if minutes < 10.0 { 1 } else { 0 };
        let message = format!("no candidate and no label for {minutes:.digits$} min; so far {shown}");
        self.due(NotifyEvent::Stall, shown, message)
    }

    /// Every so many.
    fn failed_labels(&mut self, failed: u64) -> Option<Due> {
        let each = u64::from(self.settings.failed_labels.get());
        let reached = failed / each * each;
        let told = self.told.0.get(NotifyEvent::FailedLabels.name()).and_then(|told| told.parse().ok());
        if reached <= told.unwrap_or(0) {
            return None;
        }
        let message = match failed {
            1 => "the label of 1 structure has finally failed".to_owned(),
            failed => format!("the labels of {failed} structures have finally failed"),
        };
        self.due(NotifyEvent::FailedLabels, reached.to_string(), message)
    }

    /// Once a campaign.
    fn failing_walks(&mut self, ends: &Ends) -> Option<Due> {
        if !ends.are_alarming() {
            return None;
        }
        self.due(NotifyEvent::FailingWalks, "yes".into(), ends.warning())
    }

    fn is_wanted(&self, event: NotifyEvent) -> bool {
        self.settings.on.contains(&event)
    }

    /// An event that was not told yet: `identity` tells it from others of its kind.
    fn due(&mut self, event: NotifyEvent, identity: String, message: String) -> Option<Due> {
        if !self.is_wanted(event) || self.told.0.get(event.name()) == Some(&identity) {
            return None;
        }
        self.told.0.insert(event.name().to_owned(), identity);
        Some(Due { event, message })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTES: i64 = 60_000;

    fn watch() -> Watch {
        Watch::new(NotifySection::default(), Told::default())
    }

    fn events(due: &[Due]) -> Vec<NotifyEvent> {
        due.iter().map(|due| due.event).collect()
    }

    #[test]
    fn a_stall_is_told_once_and_again_after_the_next_candidate() {
        let (mut watch, mut status) = (watch(), Status::default());
        for (minute, seen, expected) in [
            (0, 5, 0),
            (119, 5, 0),
            (120, 5, 1),
            (300, 5, 0),
            (301, 6, 0),
            (420, 6, 0),
            (421, 6, 1),
            (999, 6, 0),
        ] {
            status.candidates.seen = seen;
            assert_eq!(watch.look(&status, minute * MINUTES).len(), expected, "{minute}");
        }
        // Also over a restart.
        let mut next = Watch::new(NotifySection::default(), watch.told().clone());
        for minute in [1000, 2000] {
            assert_eq!(next.look(&status, minute * MINUTES), []);
        }
    }

    #[test]
    fn failures_are_told_by_the_dozen() {
        let (mut watch, mut status) = (watch(), Status::default());
        for (failed, expected) in [(9, 0), (10, 1), (11, 0), (3, 0), (12, 0), (39, 1), (40, 1)] {
            status.labels.failed = failed;
            assert_eq!(watch.look(&status, 0).len(), expected, "{failed}");
        }
    }

    #[test]
    fn walks_that_end_early_one_after_the_other_are_told_once() {
        let (mut watch, mut status) = (watch(), Status::default());
        let walk = |state: &str| store::WalkStatus { state: state.into(), ..store::WalkStatus::default() };
        for (state, expected) in
            [("blew_up", 0), ("collected", 0), ("trapped", 0), ("blew_up", 1), ("blew_up", 0)]
        {
            status.walks.push(walk(state));
            let due = watch.look(&status, 0);
            assert_eq!(due.len(), expected, "{:?}", status.walks);
            assert!(due.iter().all(|due| due.event == NotifyEvent::FailingWalks), "{due:?}");
        }
    }

    #[test]
    fn an_end_by_a_budget_is_both_and_a_larger_budget_is_another() {
        use NotifyEvent::{Budget, End};
        let (mut watch, mut status) = (watch(), Status { finished: true, ..Status::default() });
        status.budget.used_up = Some("budget.labels".into());
        status.budget.limits.labels = Some(5);
        assert_eq!(events(&watch.look(&status, 0)), [Budget, End]);
        assert_eq!(watch.look(&status, 0), []);
        status.budget.limits.labels = Some(6);
        status.candidates.seen = 1;
        assert_eq!(events(&watch.look(&status, 0)), [Budget, End]);
        let only = NotifySection { on: vec![End], ..NotifySection::default() };
        let mut only = Watch::new(only, Told::default());
        assert_eq!((events(&only.look(&status, 0)), only.failed("x")), (vec![End], None));
    }
}
