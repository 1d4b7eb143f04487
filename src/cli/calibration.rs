//! Prints bounds of the force error by grade.

use std::io::{self, Write};

use monitor::calibration::{CalibrationBin, CalibrationMap, CalibrationSummary};

use crate::output::{TextTable, decimals, range};
use crate::wording;

/// The sentence, and a table of the bins.
pub fn write(out: &mut dyn Write, summary: &CalibrationSummary) -> io::Result<()> {
    writeln!(out, "\nbounds of the force error by γ_nbr: {}", wording::calibration::sentence(summary))?;
    let of_two = summary.by_value.is_some();
    write_map(out, &summary.found, of_two)?;
    let Some(by_value) = &summary.by_value else { return Ok(()) };
    let coverage = wording::calibration::coverage(by_value.coverage);
    writeln!(
        out,
        "\nfrom labels of structures that the queue chose by value, which are fitted apart; {coverage}"
    )?;
    write_map(out, by_value, of_two)
}

/// A table of the bins. `of_two`: there is another table, and bins say which of the two is in use.
fn write_map(out: &mut dyn Write, map: &CalibrationMap, of_two: bool) -> io::Result<()> {
    if map.bins.is_empty() {
        return Ok(());
    }
    let below = format!(">{:.0} % below (eV/Å)", 100.0 * map.level);
    let mut titles = vec![
        "γ_nbr",
        "element",
        ">structures",
        &below,
        ">mean (eV/Å)",
        ">held (%)",
        ">tested by",
        ">level in force (%)",
    ];
    titles.extend(of_two.then_some("in use"));
    let mut table = TextTable::new(&titles);
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
        let mut row = vec![
            range(*above, *up_to),
            element.clone().unwrap_or_else(|| "all".to_owned()),
            structures.to_string(),
            decimals(*bound, 3),
            decimals(*mean, 3),
            decimals(coverage.map(|found| 100.0 * found.share), 1),
            coverage.map_or(0, |found| found.structures).to_string(),
            format!("{:.1}", 100.0 * level_in_force),
        ];
        row.extend(of_two.then(|| if *in_use { "yes" } else { "no" }.to_owned()));
        table.push(row);
    }
    table.write(out)
}
