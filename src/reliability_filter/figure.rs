//! Kept share, mean absolute error and classification against the threshold (the paper's figure of the benchmark, panel c).

use figures::{Anchor, Axis, AxisScale, Colour, Figure, Panel, Rectangle, Stroke};

use super::{FilterReport, Metrics, ThresholdResult};

const WIDTH: f64 = 510.0;
const HEIGHT: f64 = 218.0;

/// A quantity of the metrics.
type Of = fn(&Metrics) -> Option<f64>;

/// The figure. `grade` is the title of the grade's column.
pub fn draw(report: &FilterReport, grade: &str) -> Figure {
    let mut figure = Figure::new("filter", "What a threshold of the grade keeps", WIDTH, HEIGHT);
    let number = if report.has_classes() { 3 } else { 2 };
    let (left, gap) = (46.0, 50.0);
    let width = (WIDTH - left - 12.0 - gap * (number - 1) as f64) / number as f64;
    let place = |k: usize| Rectangle { x: left + k as f64 * (width + gap), y: 32.0, width, height: 140.0 };
    let threshold = |step: &ThresholdResult| step.threshold;
    let ends = (report.steps.first().map_or(0.0, threshold), report.steps.last().map_or(1.0, threshold));
    let scale = if ends.0 > 0.0 { AxisScale::Logarithmic } else { AxisScale::Linear };
    let x = Axis::new(&format!("threshold of {grade}"), scale, ends.0, ends.1);

    let mut panel = Panel::new(place(0), x.clone(), Axis::new("kept share", AxisScale::Linear, 0.0, 1.0));
    panel.line(report.steps.iter().map(|step| [step.threshold, step.share]), Colour::INK.line(1.3));
    finish(panel, 'a', &mut figure);

    let mean: Of = |metrics| metrics.mean_absolute_error;
    let y = axis("mean absolute error", report, &[mean]);
    let mut panel = Panel::new(place(1), x.clone(), y);
    curve(&mut panel, report, mean, Colour::BLUE.line(1.3));
    finish(panel, 'b', &mut figure);

    if report.has_classes() {
        let classes: [(&str, Of); 3] = [
            ("precision", |metrics| metrics.precision),
            ("recall", |metrics| metrics.recall),
            ("F1", |metrics| metrics.f1),
        ];
        let y = axis("classification", report, &classes.map(|(_, of)| of));
        let mut panel = Panel::new(place(2), x, y);
        for (k, (name, of)) in classes.into_iter().enumerate() {
            let colour = Colour::SERIES[k];
            curve(&mut panel, report, of, colour.line(1.3));
            let at = place(2).x + 44.0 * k as f64;
            figure.line(vec![[at, 19.0], [at + 10.0, 19.0]], colour.line(1.3));
            figure.text([at + 13.0, 22.0], name, Anchor::Start).size = 7.0;
        }
        finish(panel, 'c', &mut figure);
    }
    figure
}

fn finish(mut panel: Panel, letter: char, figure: &mut Figure) {
    panel.vertical_line(1.0);
    panel.panel_letter(letter);
    panel.draw(figure);
}

/// What is kept, the band of one standard deviation of the random subsets, and a thin line for all rows.
fn curve(panel: &mut Panel, report: &FilterReport, of: Of, stroke: Stroke) {
    let colour = stroke.paint.colour;
    let band = |step: &ThresholdResult| {
        let (mean, deviation) = (of(&step.random_mean)?, of(&step.random_deviation)?);
        Some((step.threshold, mean - deviation, mean + deviation))
    };
    for run in report.steps.iter().map(band).collect::<Vec<_>>().split(Option::is_none) {
        panel.band(&run.iter().flatten().copied().collect::<Vec<_>>(), colour.faint(0.2));
    }
    if let Some(value) = of(&report.unfiltered) {
        panel.line([[panel.x.low, value], [panel.x.high, value]], colour.line(0.5));
    }
    let point = |step: &ThresholdResult| of(&step.metrics).map(|value| [step.threshold, value]);
    for run in report.steps.iter().map(point).collect::<Vec<_>>().split(Option::is_none) {
        panel.line(run.iter().flatten().copied(), stroke);
    }
}

/// From the smallest to the largest value that is drawn, bands included.
fn axis(title: &str, report: &FilterReport, quantities: &[Of]) -> Axis {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for of in quantities {
        let of_step = |step: &ThresholdResult| {
            let (mean, deviation) = (of(&step.random_mean), of(&step.random_deviation).unwrap_or(0.0));
            [of(&step.metrics), mean.map(|mean| mean - deviation), mean.map(|mean| mean + deviation)]
        };
        for value in report.steps.iter().flat_map(of_step).chain([of(&report.unfiltered)]).flatten() {
            (low, high) = (low.min(value), high.max(value));
        }
    }
    let margin = 0.08 * (high - low).max(1e-3 * high.abs());
    Axis::new(title, AxisScale::Linear, low - margin, high + margin)
}
