//! Budgets of a campaign and their use.

use serde::{Deserialize, Serialize};

/// Limits of a campaign; `None` for no limit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Budget {
    /// Number of labels.
    pub labels: Option<u64>,
    /// Core-hours of label attempts.
    pub core_hours: Option<f64>,
    /// Wall-clock hours of the campaign's runs.
    pub wall_hours: Option<f64>,
    /// The configuration key that limits the number of structures; the selector enforces that limit.
    pub structures_by: Option<String>,
}

/// What was used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct BudgetUse {
    /// Labels made, including late results that were stored as checks.
    pub labels: u64,
    /// Attempts in progress.
    pub attempts_in_progress: u64,
    /// Core-hours of label attempts, including those in progress.
    pub core_hours: f64,
    /// Wall-clock hours, summed over all runs.
    pub wall_hours: f64,
}

/// Limits and use, for display.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BudgetStatus {
    /// The limits.
    pub limits: Budget,
    /// Use of the limits.
    pub used: BudgetUse,
    /// The configuration key of the limit that ended the campaign.
    pub used_up: Option<String>,
}

impl Budget {
    /// Whether no limit applies to labels.
    pub fn is_none(&self) -> bool {
        self.labels.is_none() && self.core_hours.is_none() && self.wall_hours.is_none()
    }

    /// The configuration key of the time limit that was reached: walks stop where they are.
    pub fn time_used_up(&self, used: &BudgetUse) -> Option<&'static str> {
        let limits = [
            ("budget.wall_time", self.wall_hours, used.wall_hours),
            ("budget.core_hours", self.core_hours, used.core_hours),
        ];
        let reached = |(_, limit, used): &(&str, Option<f64>, f64)| limit.is_some_and(|limit| *used >= limit);
        limits.into_iter().find(reached).map(|(key, ..)| key)
    }

    /// Whether no further attempt may start. A running attempt may still deliver the last label.
    pub fn forbids_attempts(&self, used: &BudgetUse) -> bool {
        let labels = used.labels + used.attempts_in_progress;
        self.time_used_up(used).is_some() || self.labels.is_some_and(|limit| labels >= limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_is_reached_when_use_equals_it() {
        let used = BudgetUse { labels: 3, attempts_in_progress: 2, core_hours: 1.5, wall_hours: 0.25 };
        let none = Budget::default();
        assert!(none.is_none() && none.time_used_up(&used).is_none() && !none.forbids_attempts(&used));
        for (labels, allows) in [(6, true), (5, false), (4, false)] {
            let budget = Budget { labels: Some(labels), ..Budget::default() };
            assert_eq!((budget.forbids_attempts(&used), budget.time_used_up(&used)), (!allows, None));
        }
        for (core_hours, wall_hours, key) in [
            (1.5, 1.0, Some("budget.core_hours")),
            (1.6, 0.25, Some("budget.wall_time")),
            (1.0, 0.2, Some("budget.wall_time")),
            (1.6, 0.3, None),
        ] {
            let budget =
                Budget { core_hours: Some(core_hours), wall_hours: Some(wall_hours), ..Budget::default() };
            assert_eq!(budget.time_used_up(&used), key);
            assert_eq!(budget.forbids_attempts(&used), key.is_some());
        }
    }
}
