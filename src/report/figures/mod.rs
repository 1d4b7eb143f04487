//! The figures, one per file: each draws a panel or more and provides its caption and data.

mod calibration;
mod collection;
mod completion;
mod cost;
mod distributions;
mod errors;
mod grades;
mod history;
mod pairs;
mod parity;
mod projection;
mod space;
mod versions;
pub(super) mod walks;

use ::figures::{Axis, AxisScale, Panel};
use analysis::Histogram;
use wire::Origin;

use super::collections::Collections;
use super::report_data::ReportData;
use super::style::origin_style;
use super::{Csv, FigureEntry, csv};
use crate::page::style::row;

/// All figures, in the order of the page.
pub fn all(data: &ReportData) -> Vec<FigureEntry> {
    let part = |name: &'static str, title, drawn| FigureEntry { name: name.into(), title, drawn };
    let mut all = vec![
        part("collection", "Candidates and accepted structures", collection::draw(data)),
        part("pairs", "Errors of biased walks and of their controls, pair by pair", pairs::draw(data)),
        part("distributions", "Grades and force errors", distributions::draw(&data.collections)),
        part("errors", "Force errors of new and of stretched structures", errors::draw(&data.collections)),
        part("space", "Volumes and composition", space::draw(&data.collections)),
        part("features", "Feature space", projection::draw(&data.collections)),
        part("parity", "The potential against labels", parity::draw(data)),
        part("grades", "Force errors by grade", grades::draw(&data.collections)),
        part("error-bounds", "Bounds of the force error", calibration::draw(data)),
        part("history", "The campaign over time", history::draw(data)),
        part("cost", "Cost of labels", cost::draw(data)),
        part("completion", "Labelled share of structures", completion::draw(data)),
    ];
    all.splice(1..1, walks::all(data));
    if !data.versions.all.is_empty() {
        all.push(part("errors-by-labels", "Force errors by number of labels", versions::by_labels(data)));
        all.push(part("errors-by-cost", "Force errors by cost", versions::by_core_hours(data)));
    }
    all
}

/// Draws histograms of either origin as shares in percent.
fn draw_histograms(panel: &mut Panel, histograms: &[(Origin, Histogram)]) {
    for (origin, histogram) in histograms {
        let style = origin_style(*origin);
        let (edges, fractions) = (histogram.edges(), histogram.fractions());
        let mut outline = vec![[edges[0], 0.0]];
        for (edges, fraction) in edges.windows(2).zip(&fractions) {
            outline.extend([[edges[0], 100.0 * fraction], [edges[1], 100.0 * fraction]]);
        }
        outline.push([edges[edges.len() - 1], 0.0]);
        panel.polygons([outline.clone()], Some(style.colour.faint(0.18)), None);
        panel.line(outline, style.line);
    }
}

/// The vertical axis of histograms.
fn share_axis(title: &str, histograms: &[(Origin, Histogram)]) -> Axis {
    let largest = histograms.iter().flat_map(|(_, histogram)| histogram.fractions()).fold(0.0, f64::max);
    Axis::new(title, AxisScale::Linear, 0.0, 108.0 * largest.max(1e-6))
}

/// Writes the bins of histograms to the figure's data: panel, origin, lower edge, upper edge, count.
fn push_histograms(numbers: &mut Csv, panel: &str, histograms: &[(Origin, Histogram)]) {
    for (origin, histogram) in histograms {
        for (edges, count) in histogram.edges().windows(2).zip(histogram.counts()) {
            let cells =
                [panel.to_owned(), origin.name().to_owned(), csv::number(edges[0]), csv::number(edges[1])];
            numbers.push(&[&cells[..], &[count.to_string()]].concat());
        }
    }
}

/// The origins with collected structures.
fn origins_of(collections: &Collections) -> Vec<Origin> {
    let both = collections.both().into_iter();
    both.filter(|(_, of)| of.structures.total() > 0).map(|(origin, _)| origin).collect()
}

/// Shown instead of a figure of collected structures.
const NOTHING_COLLECTED: &str = "No structure has been collected yet.";
/// Shown instead of a figure of force errors.
const NO_LABELS: &str = "No structure has a label yet, so no force error is known.";
