//! Decides which events to report to the owner of a campaign, each once. This core knows neither clock nor store;
//! `runtime/notify` runs it.

use std::collections::BTreeMap;

use monitor::versions::CampaignVersions;
use monitor::walk_ends::WalkEnds;
use serde::{Deserialize, Serialize};
use store::CampaignStatus;

use crate::config::{NotifyEvent, NotifySection};
use crate::forgetting::{ForgettingMeasurement, ForgettingRule};
use crate::output::count;
use crate::wording::{versions, walk_ends};

const MINUTE: f64 = 60_000.0;
/// Stored for the event `forgetting` while the alarm is raised.
const ALARM_RAISED: &str = "holds";

/// Metadata key under which the store keeps what was reported.
pub const METADATA_KEY: &str = "notified";

/// What was last reported of each event, by this run or earlier ones.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(transparent)]
pub struct SentNotifications(BTreeMap<String, String>);

/// An event to report.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Notification {
    /// Kind of the event.
    pub event: NotifyEvent,
    /// Text of the message.
    pub message: String,
}

/// Tracks the state of a campaign and finds new events.
#[derive(Debug)]
pub struct NotificationTracker {
    settings: NotifySection,
    sent: SentNotifications,
    /// Number of candidates and labels, and since when it has not changed, ms.
    idle_since: Option<((u64, u64), i64)>,
}

impl NotificationTracker {
    /// Continues from the events that earlier runs reported.
    pub fn new(settings: NotifySection, sent: SentNotifications) -> Self {
        Self { settings, sent, idle_since: None }
    }

    /// All reported events, including those returned last.
    pub fn sent(&self) -> &SentNotifications {
        &self.sent
    }

    /// Returns the events of a campaign with this status at the time `now`, ms since 1970.
    pub fn check(&mut self, status: &CampaignStatus, now: i64) -> Vec<Notification> {
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
        due.extend(self.failing_walks(&WalkEnds::from_walks(&status.walks)));
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

    /// Returns an event if the forgetting alarm is raised or cleared.
    pub fn check_training(
        &mut self,
        forgetting: &ForgettingRule,
        measured: &ForgettingMeasurement,
    ) -> Option<Notification> {
        let event = NotifyEvent::Forgetting;
        let (holds, was) = (forgetting.evaluate(measured.level)?, self.sent.0.get(event.name()));
        match holds {
            true => self.due(event, ALARM_RAISED.to_owned(), forgetting.raised_message(measured)),
            false if was.is_some_and(|was| was == ALARM_RAISED) => {
                self.due(event, "over".to_owned(), forgetting.cleared_message(measured))
            }
            false => None,
        }
    }

    /// Returns an event for each version of the potential that was registered or refused since the last one.
    pub fn check_versions(&mut self, found: &CampaignVersions) -> Vec<Notification> {
        let mut due = Vec::new();
        for version in found.all.iter().filter(|version| version.number > 0) {
            let (event, message) = match version.is_registered() {
                true => (NotifyEvent::Version, versions::registered(version)),
                false => (NotifyEvent::RefusedVersion, versions::refused(version)),
            };
            let last = self.sent.0.get(event.name()).and_then(|number| number.parse().ok());
            if version.number > last.unwrap_or(0) {
                due.extend(self.due(event, version.number.to_string(), message));
            }
        }
        due
    }

    /// Reports that a run cannot continue, every time.
    pub fn failed(&mut self, why: &str) -> Option<Notification> {
        let event = NotifyEvent::Failure;
        self.is_wanted(event)
            .then(|| Notification { event, message: format!("calmwalk run cannot continue: {why}") })
    }

    fn stall(&mut self, so_far: (u64, u64), shown: String, now: i64) -> Option<Notification> {
        let (before, since) = *self.idle_since.get_or_insert((so_far, now));
        if before != so_far {
            self.idle_since = Some((so_far, now));
            return None;
        }
        let minutes = (now - since) as f64 / MINUTE;
        if minutes < self.settings.stall_timeout.seconds() / 60.0 {
            return None;
        }
        let digits = if minutes < 10.0 { 1 } else { 0 };
        let message = format!("no candidate and no label for {minutes:.digits$} min; so far {shown}");
        self.due(NotifyEvent::Stall, shown, message)
    }

    /// Reports every `notify.failed_labels` failures.
    fn failed_labels(&mut self, failed: u64) -> Option<Notification> {
        let each = u64::from(self.settings.failed_labels.get());
        let reached = failed / each * each;
        let sent = self.sent.0.get(NotifyEvent::FailedLabels.name()).and_then(|sent| sent.parse().ok());
        if reached <= sent.unwrap_or(0) {
            return None;
        }
        let message = match failed {
            1 => "the label of 1 structure has failed for good".to_owned(),
            failed => format!("the labels of {failed} structures have failed for good"),
        };
        self.due(NotifyEvent::FailedLabels, reached.to_string(), message)
    }

    /// Reports once per campaign.
    fn failing_walks(&mut self, ends: &WalkEnds) -> Option<Notification> {
        if !ends.is_alarming() {
            return None;
        }
        self.due(NotifyEvent::FailingWalks, "yes".into(), walk_ends::warning(ends))
    }

    fn is_wanted(&self, event: NotifyEvent) -> bool {
        self.settings.on.contains(&event)
    }

    /// Returns an event unless it was reported already. `identity` distinguishes events of one kind.
    fn due(&mut self, event: NotifyEvent, identity: String, message: String) -> Option<Notification> {
        if !self.is_wanted(event) || self.sent.0.get(event.name()) == Some(&identity) {
            return None;
        }
        self.sent.0.insert(event.name().to_owned(), identity);
        Some(Notification { event, message })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTES: i64 = 60_000;

    fn watch() -> NotificationTracker {
        NotificationTracker::new(NotifySection::default(), SentNotifications::default())
    }

    fn events(due: &[Notification]) -> Vec<NotifyEvent> {
        due.iter().map(|due| due.event).collect()
    }

    #[test]
    fn a_stall_is_reported_once_and_again_after_the_next_candidate() {
        let (mut watch, mut status) = (watch(), CampaignStatus::default());
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
            assert_eq!(watch.check(&status, minute * MINUTES).len(), expected, "{minute}");
        }
        // A restart does not repeat it.
        let mut next = NotificationTracker::new(NotifySection::default(), watch.sent().clone());
        for minute in [1000, 2000] {
            assert_eq!(next.check(&status, minute * MINUTES), []);
        }
    }

    #[test]
    fn failures_are_reported_in_batches() {
        let (mut watch, mut status) = (watch(), CampaignStatus::default());
        for (failed, expected) in [(9, 0), (10, 1), (11, 0), (3, 0), (12, 0), (39, 1), (40, 1)] {
            status.labels.failed = failed;
            assert_eq!(watch.check(&status, 0).len(), expected, "{failed}");
        }
    }

    #[test]
    fn repeated_early_ends_are_reported_once() {
        let (mut watch, mut status) = (watch(), CampaignStatus::default());
        let walk = |state: &str| store::WalkStatus { state: state.into(), ..store::WalkStatus::default() };
        for (state, expected) in
            [("diverged", 0), ("quota_reached", 0), ("trapped", 0), ("diverged", 1), ("diverged", 0)]
        {
            status.walks.push(walk(state));
            let due = watch.check(&status, 0);
            assert_eq!(due.len(), expected, "{:?}", status.walks);
            assert!(due.iter().all(|due| due.event == NotifyEvent::FailingWalks), "{due:?}");
        }
    }

    #[test]
    fn every_version_is_reported_once() {
        use NotifyEvent::{RefusedVersion, Version};
        let (mut watch, mut found) = (watch(), versions::tests::example());
        let all = found.all.split_off(2);
        assert_eq!(
            events(&watch.check_versions(&found)),
            [Version],
            "version 0 is that of the configuration"
        );
        found.all.extend(all);
        let due = watch.check_versions(&found);
        assert_eq!(events(&due), [RefusedVersion, Version]);
        assert!(due[1].message.contains("version 3 of the potential is registered: trained on 120 labels"));
        let mut next = NotificationTracker::new(NotifySection::default(), watch.sent().clone());
        assert_eq!((watch.check_versions(&found), next.check_versions(&found)), (Vec::new(), Vec::new()));
    }

    #[test]
    fn a_budget_and_its_end_are_reported_and_a_larger_budget_again() {
        use NotifyEvent::{Budget, End};
        let (mut watch, mut status) =
            (watch(), CampaignStatus { finished: true, ..CampaignStatus::default() });
        status.budget.used_up = Some("budget.labels".into());
        status.budget.limits.labels = Some(5);
        assert_eq!(events(&watch.check(&status, 0)), [Budget, End]);
        assert_eq!(watch.check(&status, 0), []);
        status.budget.limits.labels = Some(6);
        status.candidates.seen = 1;
        assert_eq!(events(&watch.check(&status, 0)), [Budget, End]);
        let only = NotifySection { on: vec![End], ..NotifySection::default() };
        let mut only = NotificationTracker::new(only, SentNotifications::default());
        assert_eq!((events(&only.check(&status, 0)), only.failed("x")), (vec![End], None));
    }
}
