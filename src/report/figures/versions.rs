//! Force errors of the versions of the potential, against what they cost.

use ::figures::{AxisScale, Colour, Figure, LegendKey, Marker, Panel, Rectangle, Stroke, legend};
use monitor::versions::{CampaignVersions, VersionSummary};

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, axis};
use super::super::{Csv, FigureContent, csv};

/// Dashes of the curves beyond the colours that there are.
const DASHES: [&[f64]; 3] = [&[], &[4.0, 1.6], &[1.4, 1.4]];

/// Against the number of labels in the training set.
pub fn by_labels(data: &ReportData) -> Result<FigureContent, String> {
    let caption = "Mean absolute error of the force components of each version of the potential on each data set, against the \
                   number of labels in its training set.";
    draw(&data.versions, "errors-by-labels", "labels in the training set", caption, &|version| {
        version.labels as f64
    })
}

/// Against the core-hours of labels and refits.
pub fn by_core_hours(data: &ReportData) -> Result<FigureContent, String> {
    let used = &data.status.budget.used;
    let per_label = if used.labels > 0 { used.core_hours / used.labels as f64 } else { 0.0 };
    let caption = "The same against the core-hours of the labels in its training set, at the campaign’s mean cost of a label with \
                   its failed attempts, and of its refit and all before it, refused ones included.";
    let versions = &data.versions;
    draw(versions, "errors-by-cost", "core-hours of labels and refits", caption, &|version| {
        per_label * version.labels as f64 + versions.core_hours_until(version.number)
    })
}

/// Draws a curve for each data set. `cost` of a version is its place on the horizontal axis.
fn draw(
    versions: &CampaignVersions,
    name: &str,
    title: &str,
    caption: &str,
    cost: &dyn Fn(&VersionSummary) -> f64,
) -> Result<FigureContent, String> {
    let of_set = |set: &str, is_registered: bool| -> Vec<[f64; 2]> {
        let shown = versions.all.iter().filter(|version| version.is_registered() == is_registered);
        let point = |version: &VersionSummary| {
            let error = version.errors_on(set)?.force_mae().filter(|error| *error > 0.0)?;
            Some([cost(version), error])
        };
        shown.filter_map(point).collect()
    };
    let sets = versions.sets();
    let all: Vec<[f64; 2]> =
        sets.iter().copied().flat_map(|set| [of_set(set, true), of_set(set, false)]).flatten().collect();
    if all.is_empty() {
        return Err("The errors of no version are known.".into());
    }
    let along = |k: usize| all.iter().map(|point| point[k]).collect::<Vec<_>>();
    let x = axis(title, AxisScale::Linear, &along(0), Some(0.0));
    let y = axis("force MAE (eV Å^{−1})", AxisScale::Logarithmic, &along(1), None);
    let mut figure = Figure::new(name, "Force errors of versions of the potential", WIDTH, 210.0);
    let place = Rectangle { x: 52.0, y: 28.0, width: WIDTH - 64.0, height: 146.0 };
    let mut panel = Panel::new(place, x, y);
    let mut keys = Vec::new();
    for (k, set) in sets.iter().copied().enumerate() {
        let line = stroke(k);
        panel.line(of_set(set, true), line);
        panel.dots(of_set(set, true), Marker::Disc, 2.4, line.paint, None);
        panel.dots(of_set(set, false), Marker::Square, 2.4, line.paint, None);
        keys.push((LegendKey::Line(line), set));
    }
    panel.draw(&mut figure);
    legend(&mut figure, [WIDTH - 8.0, 12.0], &keys);
    let caption = format!(
        "{caption} Discs, registered versions, in the order of their training; squares, refused ones. Held-out sets grow with the \
         campaign."
    );
    Ok(FigureContent { figure, caption, numbers: numbers(versions, cost) })
}

/// Style of the curve of the k-th data set.
fn stroke(k: usize) -> Stroke {
    let colours = Colour::SERIES;
    Stroke { dashes: DASHES[k / colours.len() % DASHES.len()], ..colours[k % colours.len()].line(1.3) }
}

fn numbers(versions: &CampaignVersions, cost: &dyn Fn(&VersionSummary) -> f64) -> Csv {
    let mut numbers = Csv::new(&["set", "kind", "version", "state", "x", "structures", "force_mae"]);
    for version in &versions.all {
        for set in &version.errors {
            numbers.push(&[
                set.name.clone(),
                set.kind.clone(),
                version.number.to_string(),
                version.state.name().to_owned(),
                csv::number(cost(version)),
                set.structures.to_string(),
                csv::number(set.force_mae()),
            ]);
        }
    }
    numbers
}
