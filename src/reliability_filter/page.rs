//! The page of a filter, and its other files.

use analysis::GradedRow;

use super::{FilterReport, Metrics, ThresholdResult, csv, draw, errors};
use crate::exit_status::CommandError;
use crate::output;
use crate::page::{self, FigureContent, FigureEntry, PageBlock, PageFile, PageTable, count, percent, real};

/// File name of the page.
pub const PAGE: &str = "filter.html";

/// All files, the page first. `grade` is the title of the grade's column.
pub fn files(report: &FilterReport, rows: &[GradedRow], grade: &str) -> Result<Vec<PageFile>, CommandError> {
    let parts = vec![
        FigureEntry { name: "errors".into(), title: "Errors and grades", drawn: errors::draw(rows, grade) },
        FigureEntry {
            name: "filter".into(),
            title: "What a threshold keeps",
            drawn: Ok(sweep(report, grade)),
        },
    ];
    let tables = [thresholds(report)];
    let figure = |name| PageBlock::figure(&parts, name);
    let blocks = [figure("errors"), figure("filter"), PageBlock::table(&tables, "thresholds")];
    let sections = vec![("Errors and thresholds", blocks.into_iter().flatten().collect())];
    let text = page::write(&format!("Reliability filter: {grade}"), &lead(report), sections);
    let json = serde_json::to_vec_pretty(report).map_err(CommandError::failed)?;
    let mut files = vec![
        PageFile { path: PAGE.to_owned(), bytes: text.into_bytes() },
        PageFile { path: "filter.json".into(), bytes: json },
    ];
    files.extend(page::files(parts, &tables)?);
    Ok(files)
}

fn lead(report: &FilterReport) -> String {
    let left_out = match report.left_out {
        0 => String::new(),
        n => format!(", {n} left out without a number"),
    };
    format!(
        "{}{left_out}, compared with {} of the same size. What exceeds them by several standard deviations is due to the grade.",
        output::count(report.rows as u64, "structure"),
        output::count(u64::from(report.draws), "random subset")
    )
}

fn sweep(report: &FilterReport, grade: &str) -> FigureContent {
    let classes = match report.has_classes() {
        true => "; c, precision, recall and F1 of the class within what is kept",
        false => "",
    };
    let caption = format!(
        "Structures with at most the threshold of {grade}: a, their share; b, mean absolute error, in the unit of the table{classes}. Bands, one \
         standard deviation about the mean of {} of the same size, drawn without replacement; thin lines, all structures.",
        output::count(u64::from(report.draws), "random subset")
    );
    FigureContent { figure: draw(report, grade), caption, numbers: csv(report) }
}

fn thresholds(report: &FilterReport) -> PageTable {
    let caption = "Structures up to each threshold: mean absolute error and, with classes, precision, recall and F1; random, mean and standard \
                   deviation of the random subsets of the same size. The last row has all structures.";
    let titles = [
        "threshold",
        "kept",
        "kept (%)",
        "MAE",
        "random MAE",
        "± MAE",
        "precision",
        "random precision",
        "± precision",
        "recall",
        "random recall",
        "± recall",
        "F1",
        "random F1",
        "± F1",
    ];
    let shown = if report.has_classes() { titles.len() } else { 6 };
    let mut table = PageTable::new("thresholds", caption, &titles[..shown]).whole();
    let mut push = |head: [Option<f64>; 2], kept: usize, of: [&Metrics; 3]| {
        let mut row = vec![real(head[0], 2), count(kept as u64), percent(head[1])];
        let [metrics, mean, deviation] = of.map(|of| of.columns().map(|(_, value)| value));
        for ((value, mean), deviation) in metrics.into_iter().zip(mean).zip(deviation) {
            row.extend([value, mean, deviation].map(|value| real(value, 4)));
        }
        row.truncate(shown);
        table.rows.push(row);
    };
    for ThresholdResult { threshold, kept, share, metrics, random_mean, random_deviation } in &report.steps {
        push([Some(*threshold), Some(*share)], *kept, [metrics, random_mean, random_deviation]);
    }
    let none = Metrics::default();
    push([None, Some(1.0)], report.rows, [&report.unfiltered, &none, &none]);
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_classes_only_if_the_table_has() {
        for class in [None, Some((true, false))] {
            let row = |k: i32| GradedRow { grade: 0.1 * f64::from(k), error: f64::from(k), class };
            let rows: Vec<_> = (1..=30).map(row).collect();
            let report = FilterReport::new(&rows, 2, &[0.5, 1.0], 5, 1);
            let files = files(&report, &rows, "gamma_max").unwrap();
            let paths: Vec<_> = files.iter().map(|file| file.path.as_str()).collect();
            assert_eq!(paths[..2], [PAGE, "filter.json"]);
            assert!(paths.contains(&"figures/errors.svg") && paths.contains(&"figures/filter.csv"));
            let text = |k: usize| String::from_utf8(files[k].bytes.clone()).unwrap();
            let page = text(0);
            assert!(
                page.contains("30 structures, 2 left out") && page.contains("5 random subsets"),
                "{page}"
            );
            assert_eq!(page.contains("precision, recall and F1 of the class"), class.is_some());
            let table = text(files.len() - 1);
            assert_eq!(table.lines().count(), 4, "{table}");
            assert_eq!(table.contains("precision"), class.is_some());
            // The number of structures up to 1, of 0.1 to 3; 0.1 · 10 is 1.
            assert!(table.lines().nth(2).unwrap().starts_with("1,10,"), "{table}");
        }
    }
}
