//! Describes how much of a budget is used.

use store::{Budget, BudgetStatus};

use super::cost::two_digits;

/// Usage of each limit. `None` without limits.
pub fn describe(budget: &BudgetStatus) -> Option<String> {
    let BudgetStatus { limits, used, used_up } = budget;
    let Budget { labels, core_hours, wall_hours, .. } = limits;
    let parts = [
        labels.map(|limit| format!("labels {} of {limit}", used.labels)),
        core_hours.map(|limit| format!("core-hours {} of {limit}", two_digits(used.core_hours))),
        wall_hours.map(|limit| format!("running time {} of {limit} h", two_digits(used.wall_hours))),
        used_up.as_ref().map(|key| format!("walks were ended by {key}")),
    ];
    let parts: Vec<_> = parts.into_iter().flatten().collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

#[cfg(test)]
mod tests {
    use store::BudgetUse;

    use super::*;

    #[test]
    fn usage_is_shown_with_limits() {
        let limits = Budget { labels: Some(10), wall_hours: Some(2.0), ..Budget::default() };
        let used = BudgetUse { labels: 7, attempts_in_progress: 1, core_hours: 9.0, wall_hours: 0.25 };
        let mut budget = BudgetStatus { limits, used, used_up: None };
        assert_eq!(describe(&budget).unwrap(), "labels 7 of 10; running time 0.25 of 2 h");
        budget.used_up = Some("collect.max_structures".into());
        assert!(describe(&budget).unwrap().ends_with("; walks were ended by collect.max_structures"));
        assert_eq!(describe(&BudgetStatus::default()), None);
    }
}
