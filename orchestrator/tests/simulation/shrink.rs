//! Shrinks the faults of a failure, and tells its story.

use super::fault::PlannedFault;
use super::planted::PlantedBug;
use super::simulate;

/// Longest story, in lines.
const MAX_LINES: usize = 120;

/// Drops faults one after the other while the simulation still breaks an invariant.
fn shrink(seed: u64, faults: &[PlannedFault], bug: Option<PlantedBug>) -> Vec<PlannedFault> {
    let mut left = faults.to_vec();
    let mut number = 0;
    while number < left.len() {
        let mut fewer = left.clone();
        fewer.remove(number);
        if simulate(seed, &fewer, bug).violation.is_some() {
            left = fewer;
        } else {
            number += 1;
        }
    }
    left
}

/// The story of a failure, with as few faults as suffice.
pub fn story_of_failure(seed: u64, faults: &[PlannedFault], bug: Option<PlantedBug>) -> String {
    let left = shrink(seed, faults, bug);
    let outcome = simulate(seed, &left, bug);
    let plural = if left.len() == 1 { "fault" } else { "faults" };
    let mut story = vec![format!(
        "seed {seed}, with {} of {} faults ({} {plural}): {}",
        left.len(),
        faults.len(),
        left.len(),
        outcome.violation.unwrap_or_default()
    )];
    story.extend(
        left.iter().map(|planned| format!("fault at {} s: {}", planned.at as f64 / 1000.0, planned.fault)),
    );
    let skipped = outcome.story.len().saturating_sub(MAX_LINES);
    if skipped > 0 {
        story.push(format!("(without the last {skipped} lines)"));
    }
    story.extend(outcome.story.into_iter().take(MAX_LINES));
    story.join("\n")
}
