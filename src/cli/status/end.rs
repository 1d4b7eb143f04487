//! When a campaign is expected to end, in `calmwalk status`.

use serde::Serialize;
use serde_json::Value;
use store::{Status, unix_milliseconds};

use crate::bill::{Bill, SECONDS_PER_HOUR, digits};

/// As things are now: walks that there are, at their speed, and labels that wait, on the cores at work.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct End {
    /// Until the walks have made all their steps, h. They end sooner if they have collected all they may.
    pub walks_hours: Option<f64>,
    /// Until the labels that wait are made, h.
    pub labels_hours: Option<f64>,
    /// Until `budget.wall_hours` is used up, h.
    pub budget_hours: Option<f64>,
    /// When it is over, ms since 1970; none if that cannot be told, or it is over.
    pub time: Option<i64>,
}

impl End {
    /// Of a campaign with this configuration in force.
    pub fn of(status: &Status, configuration: &Value, bill: &Bill) -> Self {
        let is_led = status.led;
        if status.finished {
            return Self::default();
        }
        let steps = |key: &str| configuration["walk"][key].as_u64().unwrap_or_default();
        let of_a_walk = steps("equilibration") + steps("steps");
        let under_way = status.walks.iter().filter(|walk| walk.is_active());
        let left: u64 = under_way.map(|walk| of_a_walk.saturating_sub(walk.step)).sum();
        let pace = status.steps_per_second.filter(|pace| is_led && *pace > 0.0);
        let walks_hours = match left {
            0 => Some(0.0),
            left => pace.map(|pace| left as f64 / pace / SECONDS_PER_HOUR),
        };
        let labels_hours = if bill.unfinished == 0 { Some(0.0) } else { bill.hours_left };
        let budget = &status.budget;
        let budget_hours = budget.limits.wall_hours.map(|limit| (limit - budget.used.wall_hours).max(0.0));
        let hours = walks_hours.zip(labels_hours).map(|(walks, labels)| walks.max(labels));
        let hours = match (hours, budget_hours.filter(|_| is_led)) {
            (Some(hours), Some(budget)) => Some(hours.min(budget)),
            (hours, budget) => hours.or(budget),
        };
        let time = hours.map(|hours| unix_milliseconds() + (1000.0 * SECONDS_PER_HOUR * hours) as i64);
        Self { walks_hours, labels_hours, budget_hours, time }
    }

    /// In words; none where nothing can be told.
    pub fn shown(&self) -> Option<String> {
        let milliseconds = self.time? - unix_milliseconds();
        let hours = digits(milliseconds.max(0) as f64 / 1000.0 / SECONDS_PER_HOUR);
        let part = |what: &str, hours: Option<f64>| hours.map(|hours| format!("{what} {} h", digits(hours)));
        let parts = [
            part("walks", self.walks_hours),
            part("labels", self.labels_hours),
            part("budget", self.budget_hours),
        ];
        let parts: Vec<_> = parts.into_iter().flatten().collect();
        Some(format!("expected in {hours} h at the latest, as things are now ({})", parts.join(", ")))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use store::{Budget, WalkStatus};

    use super::*;

    fn campaign() -> (Status, Value, Bill) {
        let walk = |state: &str, step| WalkStatus { state: state.into(), step, ..WalkStatus::default() };
        let status = Status {
            walks: vec![walk("running", 4_000), walk("waiting", 0), walk("collected", 7)],
            steps_per_second: Some(10.0),
            led: true,
            ..Status::default()
        };
        (status, json!({ "walk": { "equilibration": 1_000, "steps": 19_000 } }), Bill::default())
    }

    #[test]
    fn the_end_is_that_of_the_slowest() {
        let (mut status, configuration, mut bill) = campaign();
        let end = End::of(&status, &configuration, &bill);
        assert_eq!((end.walks_hours, end.labels_hours, end.budget_hours), (Some(1.0), Some(0.0), None));
        let hours = |end: &End| (end.time.unwrap() - unix_milliseconds()) as f64 / 3.6e6;
        assert!((hours(&end) - 1.0).abs() < 0.01);
        (bill.unfinished, bill.hours_left) = (3, Some(2.5));
        assert!((hours(&End::of(&status, &configuration, &bill)) - 2.5).abs() < 0.01);
        bill.hours_left = None;
        assert_eq!(End::of(&status, &configuration, &bill).time, None, "nobody makes the labels");
        status.budget.limits = Budget { wall_hours: Some(0.5), ..Budget::default() };
        assert!((hours(&End::of(&status, &configuration, &bill)) - 0.5).abs() < 0.01);
        status.led = false;
        assert_eq!(End::of(&status, &configuration, &bill).time, None, "nobody runs it");
    }
}
