//! Shrinks the faults of a failure, and tells its story.

use super::fault::PlannedFault;
use super::planted::PlantedBug;
use super::simulate;

/// Longest story, in lines: the beginning and the end of a longer one.
const MAX_LINES: usize = 160;

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
    let mut story = vec![format!(
        "seed {seed}, {} of its {} faults suffice: {}",
        left.len(),
        faults.len(),
        outcome.violation.unwrap_or_default()
    )];
    story.extend(
        left.iter().map(|planned| format!("fault at {} s: {}", planned.at as f64 / 1000.0, planned.fault)),
    );
    let told = outcome.story;
    let skipped = told.len().saturating_sub(MAX_LINES);
    let (begin, end) = told.split_at(told.len().min(MAX_LINES / 2));
    story.extend_from_slice(begin);
    if skipped > 0 {
        story.push(format!("… {skipped} lines …"));
    }
    story.extend_from_slice(&end[skipped..]);
    story.join("\n")
}
