//! Energy errors, in words.

use monitor::energy_errors::EnergySummary;

use crate::output::decimals;

/// One line in meV/atom, without the offsets. `None` without errors.
pub fn errors(summary: &EnergySummary) -> Option<String> {
    let EnergySummary { structures, left_out, mean, median, p90, largest, .. } = summary;
    let milli = |x: &Option<f64>| decimals(x.map(|x| 1000.0 * x), 1);
    (*mean)?;
    let mut line = format!(
        "mean {}, median {}, 90 % below {}, largest {} meV/atom, over {structures} structures",
        milli(mean),
        milli(median),
        milli(p90),
        milli(largest),
    );
    if *left_out > 0 {
        line += &format!(" ({left_out} more have compositions with too few labels)");
    }
    Some(line)
}
