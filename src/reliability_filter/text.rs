//! The sweep as a table, in the terminal and as CSV.

use std::io::{self, Write};

use super::{FilterReport, Metrics, ThresholdResult};
use crate::csv::{Csv, number};
use crate::output::{TextTable, count, decimals};

pub fn write(report: &FilterReport, out: &mut dyn Write) -> io::Result<()> {
    let shown = if report.has_classes() { 4 } else { 1 };
    write!(out, "{}", count(report.rows, "structure"))?;
    if report.left_out > 0 {
        write!(out, ", {} left out without a number", report.left_out)?;
    }
    writeln!(
        out,
        "; random: mean ± standard deviation of {} of the same size",
        count(report.draws, "subset")
    )?;
    let names = ["MAE", "precision", "recall", "F1"];
    let mut titles = vec![">threshold".to_owned(), ">kept".into(), ">kept (%)".into()];
    titles.extend(names[..shown].iter().flat_map(|name| [format!(">{name}"), ">random".into()]));
    let mut table = TextTable::new(&titles.iter().map(String::as_str).collect::<Vec<_>>());
    for step in &report.steps {
        let mut row = vec![step.threshold.to_string(), step.kept.to_string(), percent(step.share)];
        let random = step.random_mean.columns().into_iter().zip(step.random_deviation.columns());
        for ((_, value), ((_, mean), (_, deviation))) in
            step.metrics.columns().into_iter().zip(random).take(shown)
        {
            let random = mean.map(|mean| format!("{mean:.4} ± {}", decimals(deviation, 4)));
            row.extend([decimals(value, 4), random.unwrap_or_else(|| "–".into())]);
        }
        table.push(row);
    }
    let mut all = vec!["all".to_owned(), report.rows.to_string(), percent(1.0)];
    let values = report.unfiltered.columns().into_iter().take(shown);
    all.extend(values.flat_map(|(_, value)| [decimals(value, 4), String::new()]));
    table.push(all);
    table.write(out)
}

fn percent(share: f64) -> String {
    format!("{:.1}", 100.0 * share)
}

/// One row for each threshold, then one for all rows of the table.
pub fn csv(report: &FilterReport) -> Csv {
    let mut titles: Vec<String> = ["threshold", "kept", "share"].map(Into::into).into();
    for (name, _) in Metrics::default().columns() {
        titles.extend([name.into(), format!("{name}_random_mean"), format!("{name}_random_deviation")]);
    }
    let mut csv = Csv::new(&titles.iter().map(String::as_str).collect::<Vec<_>>());
    let columns = |of: &Metrics| of.columns().map(|(_, value)| value);
    let mut push = |head: [String; 3], [metrics, mean, deviation]: [&Metrics; 3]| {
        let mut row = head.to_vec();
        for k in 0..4 {
            row.extend([metrics, mean, deviation].map(|of| number(columns(of)[k])));
        }
        csv.push(&row);
    };
    for ThresholdResult { threshold, kept, share, metrics, random_mean, random_deviation } in &report.steps {
        let head = [threshold.to_string(), kept.to_string(), number(*share)];
        push(head, [metrics, random_mean, random_deviation]);
    }
    let none = Metrics::default();
    push([String::new(), report.rows.to_string(), number(1.0)], [&report.unfiltered, &none, &none]);
    csv
}
