//! The figures of the report, with captions and data.

mod curves;
mod reliability;

use ::figures::{Colour, Stroke};

pub use self::curves::mixtures;

use super::report::{IntervalEstimate, LabelledReport};
use crate::page::FigureEntry;

/// The figures, none without force labels.
pub fn all(report: &LabelledReport) -> Vec<FigureEntry> {
    if report.atoms == 0 {
        return Vec::new();
    }
    let mut figures = vec![curves::areas(report)];
    if report.scores.iter().any(|score| score.confident.is_some()) {
        figures.splice(0..0, [reliability::draw(report), curves::contamination(report)]);
    }
    figures
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
