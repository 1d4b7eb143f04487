//! The figures of the report, with captions and data.

mod compositions;
mod curves;
mod distributions;
mod error_grid;
mod error_histograms;
mod mixture_curves;
mod mixture_map;
mod reliability;

use ::figures::{Colour, Point, Stroke};

pub use self::error_grid::draw as error_grid;
pub use self::mixture_curves::draw as mixtures;
pub use self::mixture_map::draw as mixture_map;

use super::report::{ErrorHistograms, IntervalEstimate, LabelledReport, TrainingErrors};
use crate::page::FigureEntry;

/// The figures, none without force labels; with the errors on training data, where both are comparable.
pub fn all(report: &LabelledReport, training: Option<TrainingErrors>) -> Vec<FigureEntry> {
    if report.atoms == 0 {
        return Vec::new();
    }
    let mut figures = Vec::new();
    if report.scores.iter().any(|score| score.confident.is_some()) {
        figures.push(reliability::draw(report));
        figures.extend(error_histograms::draw(report));
        figures.push(distributions::draw(report));
        figures.push(curves::contamination(report));
    }
    figures.push(curves::areas(report));
    figures.extend(compositions::draw(report, training));
    figures
}

/// Outlines of the histograms within and beyond the limit: (error, share of these errors), from zero to zero.
fn outlines(histograms: &ErrorHistograms) -> [Vec<Point>; 2] {
    let edges = &histograms.edges;
    histograms.populations.each_ref().map(|population| {
        let all = population.counts.iter().sum::<u64>().max(1) as f64;
        let mut outline = vec![[edges[0], 0.0]];
        for (edges, count) in edges.windows(2).zip(&population.counts) {
            let share = *count as f64 / all;
            outline.extend([[edges[0], share], [edges[1], share]]);
        }
        outline.push([edges[edges.len() - 1], 0.0]);
        outline
    })
}

/// Line of the curve with this number: colours, then dashes.
fn stroke(number: usize) -> Stroke {
    let colour = Colour::SERIES[number % Colour::SERIES.len()];
    match number / Colour::SERIES.len() {
        0 => colour.line(1.3),
        _ => colour.dashed(1.3),
    }
}

/// Curve of estimates over thresholds, in runs without undefined values: (threshold, low, value, high).
fn runs(thresholds: &[f64], estimates: &[IntervalEstimate]) -> Vec<Vec<(f64, f64, f64, f64)>> {
    let point = |(x, estimate): (&f64, &IntervalEstimate)| {
        let value = estimate.value?;
        let (low, high) = estimate.interval.unwrap_or((value, value));
        Some((*x, low, value, high))
    };
    let points: Vec<_> = thresholds.iter().zip(estimates).map(point).collect();
    points.split(Option::is_none).map(|run| run.iter().flatten().copied().collect()).collect()
}
