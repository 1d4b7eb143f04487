//! Tables of the report, for the terminal and for pages.

use std::io::{self, Write};

use super::collect::LARGE_ERROR;
use super::report::{Bin, Estimate, LabelledReport, MeanErrors, ScoreReport};
use crate::csv::{self, Csv};
use crate::output::{self, Table, decimals, range};

/// The force error of the paper's table of contamination, eV/Å.
const CONTAMINATION: f64 = 0.5;

/// A table.
#[derive(Clone, Debug)]
pub struct LabelledTable {
    /// Letters and hyphens.
    pub name: &'static str,
    /// Supports `_{…}` and `^{…}`, as the titles and cells do.
    pub caption: String,
    pub titles: Vec<&'static str>,
    pub rows: Vec<Vec<Cell>>,
}

/// A cell.
#[derive(Clone, Debug)]
pub struct Cell {
    /// Rounded.
    pub shown: String,
    /// With full precision.
    pub exact: String,
    /// Numbers are right-aligned.
    pub is_number: bool,
}

impl LabelledTable {
    /// The content of its file.
    pub fn csv(&self) -> Csv {
        let titles: Vec<_> = self.titles.iter().map(|title| ::figures::plain(title)).collect();
        let mut csv = Csv::new(&titles.iter().map(String::as_str).collect::<Vec<_>>());
        for row in &self.rows {
            csv.push(&row.iter().map(|cell| ::figures::plain(&cell.exact)).collect::<Vec<_>>());
        }
        csv
    }
}

/// All tables that have rows.
pub fn all(report: &LabelledReport) -> Vec<LabelledTable> {
    let mut tables = vec![errors(report)];
    if report.atoms > 0 {
        tables.extend([ranks(report), confident(report), quantiles(report)]);
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
    for table in all(report) {
        let align = |(title, cell): (&&str, &Cell)| {
            format!("{}{}", if cell.is_number { ">" } else { "" }, ::figures::plain(title))
        };
        let titles: Vec<_> = table.titles.iter().zip(&table.rows[0]).map(align).collect();
        let mut aligned = Table::new(&titles.iter().map(String::as_str).collect::<Vec<_>>());
        for row in &table.rows {
            aligned.push(row.iter().map(|cell| ::figures::plain(&cell.shown)).collect());
        }
        writeln!(out, "\n{}", ::figures::plain(&table.caption))?;
        aligned.write(out)?;
    }
    Ok(())
}

fn errors(report: &LabelledReport) -> LabelledTable {
    let row = |name: &str, of: &MeanErrors| {
        let mut row = vec![text(name), count(of.number as u64)];
        for estimate in [of.mean_absolute, of.root_mean_square] {
            row.extend(cells(estimate, 1000.0, 2));
        }
        (of.number > 0.0).then_some(row)
    };
    let rows = [
        row("energy (meV/atom)", &report.energy),
        row("energy without offsets of elements", &report.energy_without_offsets),
        row("force components (meV/Å)", &report.forces),
        row("stress components (meV/Å³)", &report.stress),
    ];
    LabelledTable {
        name: "label-errors",
        caption: format!("Errors of the model against the labels, {}", intervals(report)),
        titles: vec!["", "number", "MAE", INTERVAL, "RMSE", INTERVAL],
        rows: rows.into_iter().flatten().collect(),
    }
}

fn ranks(report: &LabelledReport) -> LabelledTable {
    let row = |score: &ScoreReport| {
        let area = report.threshold(LARGE_ERROR).map(|k| score.auc[k]).unwrap_or_default();
        let estimates = [score.spearman, area, score.worst_decile];
        let cells = estimates.into_iter().flat_map(|estimate| cells(estimate, 1.0, 3));
        [text(&score.name)].into_iter().chain(cells).collect()
    };
    LabelledTable {
        name: "ranks",
        caption: "Scores and force errors |F_{model} − F_{label}| of atoms: Spearman’s ρ, ROC-AUC for errors above 1 eV/Å and for the \
                  worst decile of each element (mean over elements)"
            .into(),
        titles: vec!["score", "ρ", INTERVAL, "AUC > 1 eV/Å", INTERVAL, "AUC worst decile", INTERVAL],
        rows: report.scores.iter().map(row).collect(),
    }
}

fn confident(report: &LabelledReport) -> LabelledTable {
    let places = [CONTAMINATION, LARGE_ERROR].map(|error| report.threshold(error));
    let row = |score: &ScoreReport| {
        let (limit, found) = (score.limit?, score.confident.as_ref()?);
        let mut row = vec![text(&format!("{} ≤ {limit}", score.name))];
        row.extend(cells(found.retention, 100.0, 1));
        let of = |place: Option<usize>| place.map(|k| found.contamination[k]).unwrap_or_default();
        row.extend(places.into_iter().flat_map(|place| cells(of(place), 100.0, 2)));
        Some(row)
    };
    let mut rows: Vec<_> = report.scores.iter().filter_map(row).collect();
    if !rows.is_empty() {
        let estimate = |value| Estimate { value, interval: None };
        let mut all = vec![text("all atoms")];
        all.extend(cells(estimate(Some(1.0)), 100.0, 1));
        let unfiltered = places.map(|place| estimate(place.and_then(|k| report.unfiltered[k])));
        all.extend(unfiltered.into_iter().flat_map(|estimate| cells(estimate, 100.0, 2)));
        rows.push(all);
    }
    LabelledTable {
        name: "confident",
        caption: "Atoms within the limit of a score: their share of all atoms, and the share of them with a force error above 0.5 and \
                  1 eV/Å"
            .into(),
        titles: vec!["", "kept (%)", INTERVAL, "above 0.5 (%)", INTERVAL, "above 1 (%)", INTERVAL],
        rows,
    }
}

fn quantiles(report: &LabelledReport) -> LabelledTable {
    let row = |score: &ScoreReport, bin: &Bin| {
        let percent = |share: Option<f64>| number(share.map(|share| 100.0 * share), 1);
        let mut row = vec![text(&score.name), text(&range(bin.above, bin.up_to)), count(bin.atoms)];
        row.push(percent(Some(bin.share)));
        row.extend([bin.median, bin.p90, bin.p99].map(|error| number(error, 3)));
        row.push(percent(bin.large));
        row
    };
    let rows = report.scores.iter().flat_map(|score| score.bins.iter().map(move |bin| row(score, bin)));
    LabelledTable {
        name: "quantiles",
        caption: "Force errors (eV/Å) by bins of a score".into(),
        titles: vec!["score", "bin", "atoms", "atoms (%)", "median", "p90", "p99", "above 1 eV/Å (%)"],
        rows: rows.collect(),
    }
}

/// Title of the columns with intervals.
const INTERVAL: &str = "interval";

fn intervals(report: &LabelledReport) -> String {
    let level = 100.0 * report.bootstrap.level;
    format!("with {level:.0} % intervals (bootstrap over structures) here and below")
}

fn text(words: &str) -> Cell {
    Cell { shown: words.into(), exact: words.into(), is_number: false }
}

fn count(number: u64) -> Cell {
    Cell { shown: number.to_string(), exact: number.to_string(), is_number: true }
}

fn number(x: Option<f64>, digits: usize) -> Cell {
    Cell { shown: decimals(x, digits), exact: csv::number(x), is_number: true }
}

/// Value and interval.
fn cells(estimate: Estimate, factor: f64, digits: usize) -> [Cell; 2] {
    let interval = estimate.interval.map(|(low, high)| [low, high].map(|x| number(Some(factor * x), digits)));
    let text = |of: fn(&Cell) -> &String| {
        interval.as_ref().map_or(String::new(), |[low, high]| format!("{} to {}", of(low), of(high)))
    };
    let interval = Cell { shown: text(|cell| &cell.shown), exact: text(|cell| &cell.exact), is_number: true };
    [number(estimate.value.map(|value| factor * value), digits), interval]
}
