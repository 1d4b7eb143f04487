//! The campaign over time.

use ::figures::{AxisScale, Colour, Figure, Panel};
use store::HistorySample;

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, axis};
use super::super::{Csv, FigureContent, csv};
use super::row;
use crate::wording::date;

/// Height of a panel, and of a row of panels with its axis, points.
const PANEL: f64 = 88.0;
const ROW: f64 = 132.0;
const MILLISECONDS_PER_HOUR: f64 = 3.6e6;
/// Longer campaigns have an axis in days, h.
const DAYS_FROM: f64 = 72.0;

/// A quantity with a panel.
struct HistoryQuantity {
    title: &'static str,
    of: fn(&HistorySample) -> Option<f64>,
    /// Its largest value by the budget.
    limit: Option<f64>,
}

/// Panels of what has happened since the beginning.
pub fn draw(data: &ReportData) -> Result<FigureContent, String> {
    let history = &data.history;
    let Some(first) = history.samples.first() else {
        return Err("No run has recorded its history.".into());
    };
    let hours = |sample: &HistorySample| (sample.time - first.time) as f64 / MILLISECONDS_PER_HOUR;
    let is_long = history.samples.last().is_some_and(|last| hours(last) > DAYS_FROM);
    let (unit, name) = if is_long { (24.0, "days") } else { (1.0, "hours") };
    let along: Vec<_> = history.samples.iter().map(|sample| hours(sample) / unit).collect();
    let quantities = quantities(data);
    let height = 14.0 + ROW * quantities.len().div_ceil(2) as f64;
    let mut figure = Figure::new("history", "The campaign over time", WIDTH, height);
    for (place, quantity) in quantities.iter().enumerate() {
        let area = row(2, [52.0, 60.0, 12.0], 14.0 + ROW * (place / 2) as f64, PANEL)[place % 2];
        let x = axis(name, AxisScale::Linear, &along, Some(0.0));
        let values: Vec<_> =
            history.samples.iter().filter_map(quantity.of).chain([0.0]).chain(quantity.limit).collect();
        let ends = [x.low, x.high];
        let mut panel =
            Panel::new(area, x, axis(quantity.title, AxisScale::Linear, &values, Some(0.0)).with_ticks(4));
        if let Some(limit) = quantity.limit {
            panel.line(ends.map(|time| [time, limit]), Colour::GREY.dashed(0.7));
        }
        // Nothing ran between two runs.
        for run in history.runs() {
            let point = |sample: &HistorySample| Some([hours(sample) / unit, (quantity.of)(sample)?]);
            panel.line(run.iter().filter_map(point).collect::<Vec<_>>(), Colour::BLUE.line(1.2));
        }
        panel.panel_letter(char::from(b'a' + place as u8));
        panel.draw(&mut figure);
    }
    let runs = history.runs().count();
    let caption = format!(
        "The campaign since {} (n = {runs} runs), while it ran. Dashed lines, budget.",
        date::utc(first.time)
    );
    Ok(FigureContent { figure, caption, numbers: numbers(data) })
}

fn quantities(data: &ReportData) -> Vec<HistoryQuantity> {
    let limits = &data.history.limits;
    let quantity = |title, of, limit| HistoryQuantity { title, of, limit };
    vec![
        quantity("accepted structures", |one| Some(one.accepted as f64), None),
        quantity("labels", |one| Some(one.labels as f64), limits.labels.map(|limit| limit as f64)),
        quantity("core-hours of labels", |one| Some(one.core_hours), limits.core_hours),
        quantity("failed attempts", |one| Some(one.failed_attempts as f64), None),
        quantity("version of the mixture", |one| Some(one.mixture_version as f64), None),
        quantity("steps/s", |one| one.steps_per_second, None),
    ]
}

fn numbers(data: &ReportData) -> Csv {
    let mut numbers = Csv::new(&[
        "time",
        "run",
        "seen",
        "accepted",
        "queued",
        "leased",
        "labels",
        "failed_attempts",
        "failed_jobs",
        "core_hours",
        "mixture_version",
        "steps_per_second",
    ]);
    for one in &data.history.samples {
        let whole = [
            one.seen,
            one.accepted,
            one.queued,
            one.leased,
            one.labels,
            one.failed_attempts,
            one.failed_jobs,
        ];
        let mut cells = vec![one.time.to_string(), one.run.to_string()];
        cells.extend(whole.map(|number| number.to_string()));
        cells.extend([
            csv::number(one.core_hours),
            one.mixture_version.to_string(),
            csv::number(one.steps_per_second),
        ]);
        numbers.push(&cells);
    }
    numbers
}
