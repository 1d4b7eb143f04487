//! Cost of labels.

use ::figures::{Axis, AxisScale, Colour, Figure, Marker, Panel};
use analysis::{Histogram, logarithmic_edges, quantile};
use store::LabelCost;

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, axis, grouped};
use super::super::{Csv, FigureContent, csv};
use super::row;
use crate::output::four_digits;
use crate::wording::cost::core_time;

/// Bins of the histogram.
const BINS: usize = 24;
/// Largest number of labels drawn as points.
const MAX_DRAWN: usize = 3000;

pub fn draw(data: &ReportData) -> Result<FigureContent, String> {
    let costs = data.labels.as_ref().map_or(&[][..], |labels| &labels.costs);
    if costs.is_empty() {
        return Err("No label was made in this campaign, so none has a cost.".into());
    }
    let mut figure = Figure::new("cost", "Core-seconds of labels", WIDTH, 176.0);
    let mut numbers = Csv::new(&["formula", "atoms", "electrons", "k_points", "core_seconds"]);
    for cost in costs {
        let electrons = csv::number(cost.electrons);
        let points = cost.k_points.map_or(String::new(), |points| points.to_string());
        let seconds = csv::number(cost.core_seconds);
        numbers.push(&[cost.formula.clone(), cost.atoms.to_string(), electrons, points, seconds]);
    }
    let places = row(2, [46.0, 62.0, 12.0], 22.0, 112.0);
    let seconds: Vec<_> = costs.iter().map(|cost| cost.core_seconds).collect();
    let x = axis("core-seconds per label", AxisScale::Logarithmic, &seconds, None);
    let histogram = Histogram::from_values(logarithmic_edges(x.low, x.high, BINS), seconds.iter().copied());
    let largest = histogram.counts().iter().max().copied().unwrap_or(0) as f64;
    let mut panel =
        Panel::new(places[0], x, Axis::new("labels", AxisScale::Linear, 0.0, 1.1 * largest.max(1.0)));
    for (edges, count) in histogram.edges().windows(2).zip(histogram.counts()) {
        panel.bar([edges[0], 0.0], [edges[1], *count as f64], Colour::BLUE.faint(0.6));
    }
    panel.panel_letter('a');
    panel.draw(&mut figure);
    let (title, size) = size(costs);
    let sizes: Vec<_> = costs.iter().map(size).collect();
    let x = axis(title, AxisScale::Logarithmic, &sizes, None);
    let y = axis("core-seconds per label", AxisScale::Logarithmic, &seconds, None);
    let mut panel = Panel::new(places[1], x, y);
    let every = costs.len().div_ceil(MAX_DRAWN);
    let points = costs.iter().step_by(every).map(|cost| [size(cost), cost.core_seconds]);
    panel.dots(points, Marker::Disc, 1.8, Colour::BLUE.faint(0.45), None);
    panel.panel_letter('b');
    panel.draw(&mut figure);
    Ok(FigureContent { figure, caption: caption(data, seconds), numbers })
}

/// The size that the cost depends on: electrons if every label has them, otherwise atoms.
fn size(costs: &[LabelCost]) -> (&'static str, fn(&LabelCost) -> f64) {
    match costs.iter().all(|cost| cost.electrons.is_some_and(|electrons| electrons > 0.0)) {
        true => ("electrons", |cost| cost.electrons.unwrap_or(f64::NAN)),
        false => ("atoms", |cost| f64::from(cost.atoms)),
    }
}

fn caption(data: &ReportData, mut seconds: Vec<f64>) -> String {
    seconds.sort_by(f64::total_cmp);
    let of = |share| quantile(&seconds, share).map_or(String::new(), |x| four_digits(x, 3));
    format!(
        "Core-seconds of successful label attempts (n = {}): median {}, 90 % quantile {}. a, Distribution. b, By size. Failed attempts \
         are not shown; all attempts together took {}.",
        grouped(seconds.len() as u64),
        of(0.5),
        of(0.9),
        core_time(data.status.budget.used.core_hours)
    )
}
