//! The expected end of a campaign.

use serde::Serialize;
use serde_json::Value;
use store::{CampaignStatus, WalkStatus, unix_milliseconds};

use crate::label_cost::{QueueCost, SECONDS_PER_HOUR};

/// An extrapolation from the current state: existing walks at their current speed, and queued labels on the cores in use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ExpectedEnd {
    /// Time until the walks have made all their steps, h. They end earlier if they reach a limit of collected structures.
    pub walks_hours: Option<f64>,
    /// Time until the queued labels are computed, h.
    pub labels_hours: Option<f64>,
    /// Time until `budget.wall_time` is used up, h.
    pub budget_hours: Option<f64>,
    /// Expected end, ms since 1970. `None` if it is unknown or the campaign is finished.
    pub time: Option<i64>,
}

impl ExpectedEnd {
    /// Extrapolates from the status of a campaign with this configuration.
    pub fn extrapolate(status: &CampaignStatus, configuration: &Value, queue: &QueueCost) -> Self {
        if status.finished {
            return Self::default();
        }
        let steps = |key: &str| configuration["walk"][key].as_u64().unwrap_or_default();
        let steps_per_walk = steps("equilibration_steps") + steps("biased_steps");
        let under_way = status.walks.iter().filter(|walk| walk.is_active());
        // A walk at constant pressure counts no steps before the end of its reference run.
        let reference = |walk: &WalkStatus| {
            let constant = walk.conditions.as_ref().is_some_and(|walk| walk.constant_pressure().is_some());
            let is_left = constant && walk.step == 0 && walk.reference_volume.is_none();
            let made = walk.reference_step.unwrap_or_default();
            if is_left { steps("reference_steps").saturating_sub(made) } else { 0 }
        };
        let left = |walk: &WalkStatus| reference(walk) + steps_per_walk.saturating_sub(walk.step);
        let left: u64 = under_way.map(left).sum();
        let speed = status.steps_per_second.filter(|speed| status.run_active && *speed > 0.0);
        let walks_hours = match left {
            // None has begun.
            _ if status.walks.is_empty() => None,
            0 => Some(0.0),
            left => speed.map(|speed| left as f64 / speed / SECONDS_PER_HOUR),
        };
        let labels_hours = if queue.unfinished == 0 { Some(0.0) } else { queue.hours_left };
        let budget = &status.budget;
        let budget_hours = budget.limits.wall_hours.map(|limit| (limit - budget.used.wall_hours).max(0.0));
        let hours = walks_hours.zip(labels_hours).map(|(walks, labels)| walks.max(labels));
        let hours = match (hours, budget_hours.filter(|_| status.run_active)) {
            (Some(hours), Some(budget)) => Some(hours.min(budget)),
            (hours, budget) => hours.or(budget),
        };
        let time = hours.map(|hours| unix_milliseconds() + (1000.0 * SECONDS_PER_HOUR * hours) as i64);
        Self { walks_hours, labels_hours, budget_hours, time }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use store::Budget;

    use super::*;

    fn campaign() -> (CampaignStatus, Value, QueueCost) {
        let walk = |state: &str, step| WalkStatus { state: state.into(), step, ..WalkStatus::default() };
        let status = CampaignStatus {
            walks: vec![walk("running", 4_000), walk("waiting", 0), walk("quota_reached", 7)],
            steps_per_second: Some(10.0),
            run_active: true,
            ..CampaignStatus::default()
        };
        (
            status,
            json!({ "walk": { "equilibration_steps": 1_000, "biased_steps": 19_000 } }),
            QueueCost::default(),
        )
    }

    #[test]
    fn a_campaign_without_walks_has_no_expected_end() {
        let (status, configuration, queue) = campaign();
        let empty = CampaignStatus { walks: Vec::new(), ..status };
        assert_eq!(ExpectedEnd::extrapolate(&empty, &configuration, &queue).time, None);
    }

    #[test]
    fn steps_of_a_reference_run_are_left_until_they_are_made() {
        let (mut status, mut configuration, queue) = campaign();
        configuration["walk"]["reference_steps"] = json!(5_000);
        let mut hours = |change: &dyn Fn(&mut WalkStatus)| {
            change(&mut status.walks[1]);
            ExpectedEnd::extrapolate(&status, &configuration, &queue).walks_hours.unwrap()
        };
        let constant = wire::ConstantPressure { pressure: 1.0, start_volume: 1.0, cell_bias: false };
        let cell = wire::CellConditions::ConstantPressure(constant);
        let conditions = Some(wire::WalkConditions { cell, ..Default::default() });
        let made = |steps: u64| 1.0 + (5_000 - steps) as f64 / 36_000.0;
        assert!((hours(&|walk| walk.conditions.clone_from(&conditions)) - made(0)).abs() < 1e-12);
        assert!((hours(&|walk| walk.reference_step = Some(3_200)) - made(3_200)).abs() < 1e-12);
        let known =
            |walk: &mut WalkStatus| (walk.reference_step, walk.reference_volume) = (None, Some(540.0));
        assert!((hours(&known) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn the_slowest_part_determines_the_end() {
        let (mut status, configuration, mut queue) = campaign();
        let end = ExpectedEnd::extrapolate(&status, &configuration, &queue);
        assert_eq!((end.walks_hours, end.labels_hours, end.budget_hours), (Some(1.0), Some(0.0), None));
        let hours = |end: &ExpectedEnd| (end.time.unwrap() - unix_milliseconds()) as f64 / 3.6e6;
        assert!((hours(&end) - 1.0).abs() < 0.01);
        (queue.unfinished, queue.hours_left) = (3, Some(2.5));
        assert!((hours(&ExpectedEnd::extrapolate(&status, &configuration, &queue)) - 2.5).abs() < 0.01);
        queue.hours_left = None;
        assert_eq!(ExpectedEnd::extrapolate(&status, &configuration, &queue).time, None, "no labellers");
        status.budget.limits = Budget { wall_hours: Some(0.5), ..Budget::default() };
        assert!((hours(&ExpectedEnd::extrapolate(&status, &configuration, &queue)) - 0.5).abs() < 0.01);
        status.run_active = false;
        assert_eq!(ExpectedEnd::extrapolate(&status, &configuration, &queue).time, None, "no orchestrator");
    }
}
