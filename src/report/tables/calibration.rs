//! Bounds of the force error by grade.

use monitor::calibration::{CalibrationBin, CalibrationMap, CalibrationSummary};

use super::{PageTable, count, percent, real, text};
use crate::output::range;
use crate::wording;

/// The bounds from labels as found, of all bins with data.
pub fn found(summary: &CalibrationSummary) -> PageTable {
    bounds("error-bounds", &summary.found)
}

fn bounds(name: &'static str, map: &CalibrationMap) -> PageTable {
    let caption = format!(
        "Bounds of the force error |F_{{model}} − F_{{label}}| by γ_{{nbr}} under the original mixture, a rolling conformal map: {:.0} % of the \
         errors of the next structure are expected to be below. Structures are the units, and their atoms in a bin share their weight. The \
         bound follows from the newest {} structures of a bin, and needs {}. Held: mean share of a structure’s atoms whose error was not above \
         the bound from before its label came, over the newest structures with a bound. Level in force: the level that has made bounds hold \
         as often as they should. In use: the bounds of the bin count for structures without a label; where labels by value are more recent, or \
         the only ones, theirs do. Of all bins together: {}.",
        100.0 * map.level,
        map.window_structures,
        map.least_structures,
        wording::calibration::coverage(map.coverage)
    );
    let titles = [
        "γ_{nbr}",
        "element",
        "structures",
        "bound (eV Å^{−1})",
        "mean error (eV Å^{−1})",
        "held (%)",
        "tested by",
        "level in force (%)",
        "in use",
    ];
    let mut table = PageTable::new(name, &caption, &titles);
    for bin in map.distinct_bins() {
        let CalibrationBin {
            element,
            above,
            up_to,
            structures,
            bound,
            mean,
            level_in_force,
            coverage,
            in_use,
        } = bin;
        table.rows.push(vec![
            text(range(*above, *up_to)),
            text(element.as_deref().unwrap_or("all")),
            count(*structures as u64),
            real(*bound, 3),
            real(*mean, 3),
            percent(coverage.map(|found| found.share)),
            count(coverage.map_or(0, |found| found.structures as u64)),
            percent(Some(*level_in_force)),
            text(if *in_use { "yes" } else { "no" }),
        ]);
    }
    table
}

/// The same from labels by value, which are fitted apart. Without rows if there are none.
pub fn by_value(summary: &CalibrationSummary) -> PageTable {
    let name = "error-bounds-by-value";
    let Some(map) = &summary.by_value else { return PageTable::new(name, "", &[]) };
    let mut table = bounds(name, map);
    table.caption =
        format!("From labels of structures that the queue chose by their value. {}", table.caption);
    table
}
