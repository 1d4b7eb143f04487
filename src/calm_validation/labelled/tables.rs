//! Tables of the report, for the terminal and for pages.

use atoms::units::GPA_PER_EV_A3;
use std::io::{self, Write};

use analysis::SHOWN_ERROR_THRESHOLDS;

use super::collect::LARGE_ERROR;
use super::composition_tables::{compositions, elements};
use super::report::{Bin, IntervalEstimate, LabelledReport, MeanErrors, ScoreReport};
use super::score_name::name;
use crate::output::{self, range};
use crate::page::{PageTable, TableCell, count, percent, real, text};

/// The force error of the paper's table of contamination, eV/Å.
pub(super) const CONTAMINATION: f64 = 0.5;

/// All tables that have rows.
pub fn all(report: &LabelledReport) -> Vec<PageTable> {
    let mut tables = vec![errors(report)];
    if report.atoms > 0 {
        tables.extend([ranks(report), confident(report), auc_thresholds(report), worst_deciles(report)]);
        tables.extend([quantiles(report), elements(report), compositions(report)]);
    }
    tables.retain(|table| !table.rows.is_empty());
    tables
}

/// Prints the tables.
pub fn write(report: &LabelledReport, out: &mut dyn Write) -> io::Result<()> {
    let structures = output::count(report.structures, "labelled structure");
    writeln!(out, "{structures} with forces of {}", output::count(report.atoms, "atom"))?;
    if report.left_out > 0 {
        writeln!(
            out,
            "left out: {} with a grade that is not finite",
            output::count(report.left_out, "atom")
        )?;
    }
    if (report.sampled_atoms as u64) < report.atoms {
        let (sampled, structures) = (report.sampled_atoms, report.sampled_structures);
        writeln!(out, "ranks, quantiles and intervals are from {sampled} atoms of {structures} structures")?;
    }
    all(report).iter().try_for_each(|table| write_table(table, out))
}

/// Prints a table, if it has rows, with its caption.
pub fn write_table(table: &PageTable, out: &mut dyn Write) -> io::Result<()> {
    let Some(first) = table.rows.first() else { return Ok(()) };
    let align = |(title, cell): (&&str, &TableCell)| {
        format!("{}{}", if cell.is_number { ">" } else { "" }, ::figures::plain(title))
    };
    let titles: Vec<_> = table.titles.iter().zip(first).map(align).collect();
    let mut aligned = output::TextTable::new(&titles.iter().map(String::as_str).collect::<Vec<_>>());
    for row in &table.rows {
        aligned.push(row.iter().map(|cell| cell.shown.clone()).collect());
    }
    writeln!(out, "\n{}", ::figures::plain(&table.caption))?;
    aligned.write(out)
}

fn errors(report: &LabelledReport) -> PageTable {
    let row = |name: &str, of: &MeanErrors, factor: f64, decimals: usize| {
        let mut row = vec![text(name), count(of.number as u64)];
        for estimate in [of.mean_absolute, of.root_mean_square] {
            row.extend(cells(estimate, factor, decimals));
        }
        (of.number > 0.0).then_some(row)
    };
    let rows = [
        row("energy (meV/atom)", &report.energy, 1000.0, 2),
        row("energy without offsets of elements", &report.energy_without_offsets, 1000.0, 2),
        row("force components (meV/Å)", &report.forces, 1000.0, 2),
        row("stress components (GPa)", &report.stress, GPA_PER_EV_A3, 3),
    ];
    let caption = format!("Errors of the model against the labels, {}", intervals(report));
    let titles = ["", "number", "MAE", INTERVAL, "RMSE", INTERVAL];
    PageTable {
        rows: rows.into_iter().flatten().collect(),
        ..PageTable::new("label-errors", &caption, &titles)
    }
}

fn ranks(report: &LabelledReport) -> PageTable {
    let row = |score: &ScoreReport| {
        let area = report.threshold(LARGE_ERROR).map(|k| score.auc[k]).unwrap_or_default();
        let estimates = [score.spearman, area, score.worst_decile];
        let cells = estimates.into_iter().flat_map(|estimate| cells(estimate, 1.0, 3));
        [name(score)].into_iter().chain(cells).collect()
    };
    let caption = "Scores and force errors |F_{model} − F_{label}| of atoms: Spearman’s ρ, ROC-AUC for errors above 1 eV/Å and for the \
                   worst decile of each element (mean over elements)";
    let titles = ["score", "ρ", INTERVAL, "AUC > 1 eV/Å", INTERVAL, "AUC worst decile", INTERVAL];
    PageTable { rows: report.scores.iter().map(row).collect(), ..PageTable::new("ranks", caption, &titles) }
}

fn confident(report: &LabelledReport) -> PageTable {
    let places = [CONTAMINATION, LARGE_ERROR].map(|error| report.threshold(error));
    let row = |score: &ScoreReport| {
        let (limit, found) = (score.limit?, score.confident.as_ref()?);
        let mut row = vec![text(::figures::plain(&format!("{} ≤ {limit}", score.name)))];
        row.extend(cells(found.retention, 100.0, 1));
        let of = |place: Option<usize>| place.map(|k| found.contamination[k]).unwrap_or_default();
        row.extend(places.into_iter().flat_map(|place| cells(of(place), 100.0, 2)));
        Some(row)
    };
    let mut rows: Vec<_> = report.scores.iter().filter_map(row).collect();
    if !rows.is_empty() {
        let estimate = |value| IntervalEstimate { value, interval: None };
        let mut all = vec![text("all atoms")];
        all.extend(cells(estimate(Some(1.0)), 100.0, 1));
        let unfiltered = places.map(|place| estimate(place.and_then(|k| report.unfiltered[k])));
        all.extend(unfiltered.into_iter().flat_map(|estimate| cells(estimate, 100.0, 2)));
        rows.push(all);
    }
    let caption = "Atoms within the limit of a score: their share of all atoms, and the share of them with a force error above 0.5 and \
                   1 eV/Å";
    let titles = ["", "kept (%)", INTERVAL, "above 0.5 (%)", INTERVAL, "above 1 (%)", INTERVAL];
    PageTable { rows, ..PageTable::new("confident", caption, &titles) }
}

fn auc_thresholds(report: &LabelledReport) -> PageTable {
    // The titles have them too.
    let places = SHOWN_ERROR_THRESHOLDS.map(|error| report.threshold(error));
    let row = |score: &ScoreReport| {
        let of = |place: Option<usize>| place.map(|k| score.auc[k]).unwrap_or_default();
        let areas = places.into_iter().flat_map(|place| cells(of(place), 1.0, 3));
        [name(score)].into_iter().chain(areas).collect()
    };
    let caption = "ROC-AUC of a score as a test for force errors above a threshold (eV/Å)";
    let titles = ["score", "> 0.1", INTERVAL, "> 0.3", INTERVAL, "> 1", INTERVAL, "> 3", INTERVAL];
    PageTable {
        rows: report.scores.iter().map(row).collect(),
        ..PageTable::new("auc-thresholds", caption, &titles)
    }
}

/// By element and score; without rows if there is only one element.
fn worst_deciles(report: &LabelledReport) -> PageTable {
    let caption = "ROC-AUC of a score as a test for the worst decile of each element: the atoms with a force error above the threshold \
                   (eV/Å), the 90 % quantile of the sampled atoms of the element";
    let titles = ["element", "sampled atoms", "threshold", "score", "AUC", INTERVAL];
    let mut table = PageTable::new("worst-deciles", caption, &titles);
    let elements = report.scores.first().map_or(0, |score| score.worst_decile_by_element.len());
    if elements < 2 {
        return table;
    }
    for k in 0..elements {
        for score in &report.scores {
            let of = &score.worst_decile_by_element[k];
            let mut row = vec![text(of.element), count(of.atoms as u64), real(of.threshold, 3), name(score)];
            row.extend(cells(of.auc, 1.0, 3));
            table.rows.push(row);
        }
    }
    table
}

fn quantiles(report: &LabelledReport) -> PageTable {
    let row = |score: &ScoreReport, bin: &Bin| {
        let mut row = vec![name(score), text(range(bin.above, bin.up_to)), count(bin.atoms)];
        row.push(percent(Some(bin.share)));
        row.extend([bin.median, bin.p90].into_iter().flat_map(|error| cells(error, 1.0, 3)));
        row.push(real(bin.p99, 3));
        row.extend(cells(bin.large, 100.0, 1));
        row
    };
    let rows = report.scores.iter().flat_map(|score| score.bins.iter().map(move |bin| row(score, bin)));
    let caption = "Force errors (eV/Å) by bins of a score";
    let titles = [
        "score",
        "bin",
        "atoms",
        "atoms (%)",
        "median",
        INTERVAL,
        "p90",
        INTERVAL,
        "p99",
        "above 1 eV/Å (%)",
        INTERVAL,
    ];
    PageTable { rows: rows.collect(), ..PageTable::new("quantiles", caption, &titles) }
}

/// Title of the columns with intervals.
const INTERVAL: &str = "interval";

fn intervals(report: &LabelledReport) -> String {
    let level = 100.0 * report.bootstrap.level;
    format!("with {level:.0} % intervals (bootstrap over structures) here and below")
}

/// Value and interval.
pub(super) fn cells(estimate: IntervalEstimate, factor: f64, digits: usize) -> [TableCell; 2] {
    let interval = estimate.interval.map(|(low, high)| [low, high].map(|x| real(factor * x, digits)));
    let text = |of: fn(&TableCell) -> &String| {
        interval.as_ref().map_or(String::new(), |[low, high]| format!("{} to {}", of(low), of(high)))
    };
    let interval =
        TableCell { shown: text(|cell| &cell.shown), exact: text(|cell| &cell.exact), is_number: true };
    [real(estimate.value.map(|value| factor * value), digits), interval]
}
