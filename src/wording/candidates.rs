//! Candidates, in words.

use store::Declined;

/// The number of declined candidates with their reasons, after a comma; empty without any. `all`: also what did not happen.
pub fn declined(declined: &Declined, all: bool) -> String {
    let reasons = [
        ("covered", declined.covered),
        ("duplicate", declined.duplicate),
        ("too close", declined.too_close),
        ("budget", declined.budget),
        ("backlog", declined.backlog),
        ("unlikely to complete", declined.unlikely_to_complete),
        ("grade too large", declined.grade_too_large),
    ];
    let sum: u64 = reasons.iter().map(|(_, number)| number).sum();
    let shown = reasons.iter().filter(|(_, number)| all || *number > 0);
    let shown: Vec<_> = shown.map(|(reason, number)| format!("{number} {reason}")).collect();
    if shown.is_empty() { String::new() } else { format!(", {sum} declined ({})", shown.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_reasons_that_occurred_are_named() {
        let none = Declined::default();
        let some = Declined { covered: 3, budget: 1, ..none };
        assert_eq!(
            (declined(&none, false), declined(&some, false)),
            (String::new(), ", 4 declined (3 covered, 1 budget)".into())
        );
        assert!(declined(&none, true).starts_with(", 0 declined (0 covered, 0 duplicate"));
    }
}
