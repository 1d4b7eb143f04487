//! The traces of biased walks, a figure for each group of walks.

use ::figures::{AxisScale, Colour, Figure, LegendKey, Panel, Rectangle, Stroke, legend};
use wire::TracePoint;

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, axis};
use super::super::walk_traces::{GroupTraces, QUANTITIES, TraceContent, TraceRange};
use super::super::{Csv, FigureContent, FigureEntry, csv};
use super::row;

/// Height of a panel, and of a row of panels with its axis, points.
const PANEL: f64 = 88.0;
const ROW: f64 = 132.0;
/// Dashes of lines beyond the colours that there are.
const DASHES: [&[f64]; 2] = [&[], &[4.0, 1.6]];

/// Names of the figures: `walks`, `walks-2`, …
pub fn name(number: usize) -> String {
    if number == 0 { "walks".to_owned() } else { format!("walks-{}", number + 1) }
}

/// A figure for each group with traces.
pub fn all(data: &ReportData) -> Vec<FigureEntry> {
    let threshold = data.collection_threshold();
    let groups = data.walk_traces.iter().enumerate();
    let entry = |(number, group): (usize, &GroupTraces)| FigureEntry {
        name: name(number).into(),
        title: "Biased walks along their steps",
        drawn: Ok(draw(&name(number), group, threshold)),
    };
    groups.map(entry).collect()
}

fn draw(name: &str, group: &GroupTraces, threshold: Option<f64>) -> FigureContent {
    let shown: Vec<_> = (0..QUANTITIES.len()).filter(|quantity| is_shown(group, *quantity)).collect();
    let height = 34.0 + ROW * shown.len().div_ceil(2) as f64;
    let mut figure =
        Figure::new(name, "State, grade and bias of biased walks along their steps", WIDTH, height);
    for (place, quantity) in shown.iter().enumerate() {
        let area = row(2, [52.0, 60.0, 12.0], 30.0 + ROW * (place / 2) as f64, PANEL)[place % 2];
        let mut panel = panel(group, *quantity, area, threshold);
        panel.panel_letter(char::from(b'a' + place as u8));
        panel.draw(&mut figure);
    }
    if let TraceContent::Lines(lines) = &group.content {
        let names: Vec<_> = lines.iter().map(|(walk, _)| format!("walk {walk}")).collect();
        let keys = names.iter().enumerate().map(|(k, name)| (LegendKey::Line(stroke(k)), name.as_str()));
        legend(&mut figure, [WIDTH - 8.0, 12.0], &keys.collect::<Vec<_>>());
    }
    FigureContent { figure, caption: caption(group, threshold), numbers: numbers(group) }
}

/// The gain of the bias on the cell is shown only if there is one, and the pressure only of periodic structures.
fn is_shown(group: &GroupTraces, quantity: usize) -> bool {
    let values = values(group, quantity);
    !values.is_empty()
        && (QUANTITIES[quantity].key != "cell_gain" || values.iter().any(|value| *value != 0.0))
}

/// All values of a quantity that are drawn.
fn values(group: &GroupTraces, quantity: usize) -> Vec<f64> {
    match &group.content {
        TraceContent::Lines(lines) => {
            lines.iter().flat_map(|(_, points)| points).filter_map(QUANTITIES[quantity].of).collect()
        }
        TraceContent::Ranges(ranges) => ranges_of(ranges, quantity).flat_map(|range| range.values).collect(),
    }
}

fn ranges_of(ranges: &[TraceRange], quantity: usize) -> impl Iterator<Item = &TraceRange> {
    ranges.iter().filter(move |range| range.quantity == quantity)
}

fn panel(group: &GroupTraces, quantity: usize, area: Rectangle, threshold: Option<f64>) -> Panel {
    let threshold = threshold.filter(|_| QUANTITIES[quantity].key == "gamma_max");
    let steps: Vec<f64> = match &group.content {
        TraceContent::Lines(lines) => {
            lines.iter().flat_map(|(_, points)| points).map(|point| point.step as f64).collect()
        }
        TraceContent::Ranges(ranges) => ranges.iter().map(|range| range.step).collect(),
    };
    let title = group.time_step.map_or("step".to_owned(), |time_step| format!("step of {time_step} fs"));
    let x = axis(&title, AxisScale::Linear, &steps, Some(0.0));
    let ends = [x.low, x.high];
    let y = axis(QUANTITIES[quantity].title, AxisScale::Linear, &values(group, quantity), threshold);
    let mut panel = Panel::new(area, x, y.with_ticks(4));
    if let Some(threshold) = threshold {
        panel.line(ends.map(|step| [step, threshold]), Colour::GREY.dashed(0.7));
    }
    match &group.content {
        TraceContent::Lines(lines) => {
            for (k, (_, points)) in lines.iter().enumerate() {
                // A roll back begins a new line.
                for path in points.chunk_by(|a, b| a.segment == b.segment) {
                    let of =
                        |point: &TracePoint| Some([point.step as f64, (QUANTITIES[quantity].of)(point)?]);
                    panel.line(path.iter().filter_map(of).collect::<Vec<_>>(), stroke(k));
                }
            }
        }
        TraceContent::Ranges(ranges) => {
            let all = ranges_of(ranges, quantity);
            let band: Vec<_> = all.map(|range| (range.step, range.values[0], range.values[2])).collect();
            panel.band(&band, Colour::VERMILLION.faint(0.2));
            let median = ranges_of(ranges, quantity).map(|range| [range.step, range.values[1]]);
            panel.line(median.collect::<Vec<_>>(), Colour::VERMILLION.line(1.3));
        }
    }
    panel
}

fn stroke(k: usize) -> Stroke {
    let colours = Colour::SERIES;
    Stroke { dashes: DASHES[k / colours.len() % DASHES.len()], ..colours[k % colours.len()].line(1.0) }
}

fn caption(group: &GroupTraces, threshold: Option<f64>) -> String {
    let of = match group.group.as_str() {
        "" => format!("Biased walks (n = {})", group.walks),
        name => format!("Biased walks of the group ‘{name}’ (n = {})", group.walks),
    };
    let how = match group.content {
        TraceContent::Lines(_) => "a line for each walk; a roll back begins a new line",
        TraceContent::Ranges(_) => {
            "line, median over the walks; band, from the smallest to the largest, of the means of each walk over a hundredth of \
             the steps"
        }
    };
    let threshold = threshold.map_or(String::new(), |threshold| {
        format!(
            " γ_{{max}} is under the walker’s mixture, or the original one where the axis says so; dashed, the threshold {threshold} of the \
             collection rule."
        )
    });
    format!(
        "{of} along their steps, equilibration included: {how}.{threshold} τ_{{r}} is the factor on the gradient of Σγ in the force, \
         the share of the bias Σ‖τ_{{r}}∇Σγ‖ / Σ‖F‖ over atoms."
    )
}

fn numbers(group: &GroupTraces) -> Csv {
    match &group.content {
        TraceContent::Lines(lines) => {
            let mut titles = vec!["walk", "segment", "step"];
            titles.extend(QUANTITIES.iter().map(|quantity| quantity.key));
            let mut numbers = Csv::new(&titles);
            for (walk, points) in lines {
                for point in points {
                    let mut cells = vec![walk.to_string(), point.segment.to_string(), point.step.to_string()];
                    cells.extend(QUANTITIES.iter().map(|quantity| csv::number((quantity.of)(point))));
                    numbers.push(&cells);
                }
            }
            numbers
        }
        TraceContent::Ranges(ranges) => {
            let mut numbers = Csv::new(&["quantity", "step", "walks", "smallest", "median", "largest"]);
            for range in ranges {
                let mut cells = vec![QUANTITIES[range.quantity].key.to_owned(), csv::number(range.step)];
                cells.push(range.walks.to_string());
                cells.extend(range.values.map(csv::number));
                numbers.push(&cells);
            }
            numbers
        }
    }
}
