//! Contamination and ROC-AUC against the threshold of the force error (the paper's contamination curves and sweep).

use ::figures::{Anchor, Axis, AxisScale, Colour, Figure, Panel, Rectangle, Stroke};

use super::super::report::{Confident, IntervalEstimate, LabelledReport};
use super::{runs, stroke};
use crate::csv::{Csv, number};
use crate::page::style::WIDTH;
use crate::page::{FigureContent, FigureEntry};

const PLACE: Rectangle = Rectangle { x: 48.0, y: 14.0, width: 270.0, height: 190.0 };
const HEIGHT: f64 = 240.0;

/// Range of the thresholds for the ROC-AUC, eV/Å.
const SWEEP: (f64, f64) = (0.05, 5.0);

/// Axis of the thresholds.
const ERROR: &str = "threshold of the force error (eV Å^{−1})";

pub fn contamination(report: &LabelledReport) -> FigureEntry {
    const TITLE: &str = "Contamination of the confident set";
    let mut chart = unfiltered(TITLE, report);
    for (k, score) in report.scores.iter().enumerate() {
        let (Some(limit), Some(confident)) = (score.limit, &score.confident) else { continue };
        let name = format!("{} ≤ {limit}{}", score.name, kept(confident));
        chart.curve(&name, stroke(k), &report.thresholds, &confident.contamination);
    }
    let caption = format!(
        "Probability that an atom within the limit of a score has a force error above a threshold, with {} intervals; dashed, all \
         {} atoms; vertical line, 0.5 eV Å^{{−1}}.",
        level(report),
        report.atoms
    );
    chart.finish(TITLE, caption)
}

/// A chart of contamination with the curve of all atoms.
fn unfiltered(title: &str, report: &LabelledReport) -> Chart {
    let (low, high) = (report.thresholds[0], report.thresholds[report.thresholds.len() - 1]);
    let x = Axis::new(ERROR, AxisScale::Logarithmic, low, high);
    let y = Axis::new("probability of a larger error", AxisScale::Linear, 0.0, 1.0);
    let mut chart = Chart::new("contamination", title, x, y);
    chart.panel.vertical_line(0.5);
    let all = report.unfiltered.iter().map(|value| IntervalEstimate { value: *value, interval: None });
    chart.curve("no filter", Colour::INK.dashed(1.1), &report.thresholds, &all.collect::<Vec<_>>());
    chart
}

/// The share of the atoms that a limit keeps, for legends.
fn kept(confident: &Confident) -> String {
    confident.retention.value.map_or(String::new(), |kept| format!(" ({:.1} % kept)", 100.0 * kept))
}

pub fn areas(report: &LabelledReport) -> FigureEntry {
    let is_shown = |x: &&f64| (SWEEP.0..=SWEEP.1).contains(*x);
    let thresholds: Vec<_> = report.thresholds.iter().filter(is_shown).copied().collect();
    let first = report.thresholds.iter().position(|x| *x >= SWEEP.0).unwrap_or(0);
    let lows = report.scores.iter().flat_map(|score| &score.auc[first..first + thresholds.len()]);
    let lowest = lows.filter_map(|estimate| estimate.value).fold(0.5, f64::min);
    let x = Axis::new(ERROR, AxisScale::Logarithmic, SWEEP.0, SWEEP.1);
    let y = Axis::new("ROC-AUC", AxisScale::Linear, (lowest - 0.05).max(0.0), 1.0);
    let mut chart = Chart::new("auc-sweep", "Detection of large force errors", x, y);
    chart.panel.line([[SWEEP.0, 0.5], [SWEEP.1, 0.5]], Colour::GREY.dashed(0.7));
    for (k, score) in report.scores.iter().enumerate() {
        chart.curve(&score.name, stroke(k), &thresholds, &score.auc[first..first + thresholds.len()]);
    }
    let caption = format!(
        "Area under the ROC curve of the score of an atom as a test for force errors above a threshold, with {} intervals; dashed, \
         chance.",
        level(report)
    );
    chart.finish("Detection of large force errors", caption)
}

/// The kind of the intervals.
pub fn level(report: &LabelledReport) -> String {
    format!("{:.0} % bootstrap", 100.0 * report.bootstrap.level)
}

/// Draws a curve over thresholds with its interval.
pub fn draw_curve(panel: &mut Panel, stroke: Stroke, thresholds: &[f64], estimates: &[IntervalEstimate]) {
    for run in runs(thresholds, estimates) {
        let band: Vec<_> = run.iter().map(|(x, low, _, high)| (*x, *low, *high)).collect();
        if run.iter().any(|(_, low, _, high)| low < high) {
            panel.band(&band, stroke.paint.colour.faint(0.15));
        }
        panel.line(run.iter().map(|(x, _, value, _)| [*x, *value]), stroke);
    }
}

/// A panel with a legend beside it.
struct Chart {
    name: &'static str,
    figure: Figure,
    panel: Panel,
    numbers: Csv,
    curves: usize,
}

impl Chart {
    fn new(name: &'static str, description: &str, x: Axis, y: Axis) -> Self {
        Self {
            name,
            figure: Figure::new(name, description, WIDTH, HEIGHT),
            panel: Panel::new(PLACE, x, y),
            numbers: Csv::new(&["curve", "threshold", "value", "low", "high"]),
            curves: 0,
        }
    }

    /// Draws a curve with its interval, and its entry of the legend.
    fn curve(&mut self, name: &str, stroke: Stroke, thresholds: &[f64], estimates: &[IntervalEstimate]) {
        draw_curve(&mut self.panel, stroke, thresholds, estimates);
        for (x, estimate) in thresholds.iter().zip(estimates) {
            let (low, high) = estimate.interval.unzip();
            let numbers = [Some(*x), estimate.value, low, high].map(number);
            self.numbers.push(&[&[::figures::plain(name)], &numbers[..]].concat());
        }
        let (x, y) = (PLACE.right() + 12.0, PLACE.y + 10.0 + 13.0 * self.curves as f64);
        self.figure.line(vec![[x, y - 3.0], [x + 14.0, y - 3.0]], stroke);
        self.figure.text([x + 18.0, y], name, Anchor::Start);
        self.curves += 1;
    }

    fn finish(self, title: &'static str, caption: String) -> FigureEntry {
        let Self { name, mut figure, panel, numbers, .. } = self;
        panel.draw(&mut figure);
        FigureEntry { name: name.into(), title, drawn: Ok(FigureContent { figure, caption, numbers }) }
    }
}
