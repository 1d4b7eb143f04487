//! Errors pair by pair, and the ROC-AUC over thresholds of the error, with intervals.

use ::figures::{Axis, AxisScale, Colour, Figure, Marker, Panel, Rectangle, Stroke};
use monitor::label_statistics::comparison::{ComparedGroup, ConfidenceEstimate, WalkComparison};
use wire::Origin;

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, axis, grouped, origin_style, origins};
use super::super::{Csv, FigureContent, csv};
use super::{NO_LABELS, row};
use crate::wording;

pub fn draw(data: &ReportData) -> Result<FigureContent, String> {
    let comparison = &data.labels.as_ref().ok_or(NO_LABELS)?.comparison;
    if comparison.pooled.all.structures == 0 {
        return Err(NO_LABELS.into());
    }
    let points = &comparison.pairs.points;
    if !points.iter().any(|point| point.biased > 0.0 && point.control > 0.0) {
        return Err("No labelled structure of a biased walk has a labelled control frame at its step.".into());
    }
    let mut figure =
        Figure::new("pairs", "Errors of biased candidates against those of control frames", WIDTH, 222.0);
    let mut numbers = Csv::new(&[
        "panel",
        "seed_structure",
        "walk",
        "step",
        "threshold",
        "biased",
        "biased_low",
        "biased_high",
        "control",
        "control_low",
        "control_high",
    ]);
    let places = row(2, [46.0, 56.0, 12.0], 28.0, 158.0);
    draw_pairs(&mut figure, &mut numbers, comparison, places[0]);
    draw_areas(&mut figure, &mut numbers, comparison, places[1]);
    origins(&mut figure, &[Origin::Biased, Origin::Control]);
    Ok(FigureContent { figure, caption: caption(data, comparison), numbers })
}

/// The force MAE of each pair, with the medians of both sides.
fn draw_pairs(figure: &mut Figure, numbers: &mut Csv, comparison: &WalkComparison, place: Rectangle) {
    let pairs = &comparison.pairs;
    let all: Vec<f64> = pairs.points.iter().flat_map(|point| [point.biased, point.control]).collect();
    let named = |title| axis(title, AxisScale::Logarithmic, &all, None);
    let (x, y) = (named("force MAE of control (eV Å^{−1})"), named("force MAE of biased (eV Å^{−1})"));
    let (low, high) = (x.low, x.high);
    let mut panel = Panel::new(place, x, y);
    panel.line([[low, low], [high, high]], Colour::GREY.dashed(0.7));
    let points: Vec<_> = pairs.points.iter().map(|point| [point.control, point.biased]).collect();
    panel.dots(points, Marker::Disc, 1.8, Colour::INK.faint(0.4), None);
    let (biased, control) = (pairs.force_mae.biased, pairs.force_mae.control);
    if let Some((across, up)) = control.value.zip(biased.value) {
        let solid = |origin: Origin| Stroke { dashes: &[], width: 1.6, ..origin_style(origin).line };
        if let Some((low, high)) = control.interval {
            panel.line([[low, up], [high, up]], solid(Origin::Control));
        }
        if let Some((low, high)) = biased.interval {
            panel.line([[across, low], [across, high]], solid(Origin::Biased));
        }
        panel.dots([[across, up]], Marker::Disc, 3.4, Colour::INK, Some(Colour::WHITE.line(0.6)));
    }
    panel.panel_letter('a');
    panel.draw(figure);
    for point in &pairs.points {
        let mut cells = vec!["a".to_owned(), point.seed_structure.to_string(), point.walk.to_string()];
        cells.extend([point.step.to_string(), String::new()]);
        cells.extend([csv::number(point.biased), String::new(), String::new()]);
        cells.extend([csv::number(point.control), String::new(), String::new()]);
        numbers.push(&cells);
    }
    push_estimates(numbers, "a median", None, [&biased, &control]);
}

/// The ROC-AUC of γ_nbr of both sides of the pairs.
fn draw_areas(figure: &mut Figure, numbers: &mut Csv, comparison: &WalkComparison, place: Rectangle) {
    let thresholds = &comparison.thresholds;
    let x = axis("threshold of the force error (eV Å^{−1})", AxisScale::Logarithmic, thresholds, None);
    let (low, high) = (x.low, x.high);
    let mut panel =
        Panel::new(place, x, Axis::new("ROC-AUC of γ_{nbr}, matched", AxisScale::Linear, 0.0, 1.04));
    panel.line([[low, 0.5], [high, 0.5]], Colour::GREY.dashed(0.7));
    let sides =
        [(Origin::Biased, &comparison.matched.biased), (Origin::Control, &comparison.matched.control)];
    for (origin, group) in sides {
        draw_curve(&mut panel, origin, thresholds, group);
    }
    panel.panel_letter('b');
    panel.draw(figure);
    for (place, threshold) in thresholds.iter().enumerate() {
        let [biased, control] =
            sides.map(|(_, group)| group.gamma_nbr.roc_auc.get(place).copied().unwrap_or_default());
        push_estimates(numbers, "b", Some(*threshold), [&biased, &control]);
    }
}

fn draw_curve(panel: &mut Panel, origin: Origin, thresholds: &[f64], group: &ComparedGroup) {
    let style = origin_style(origin);
    let areas: Vec<(f64, &ConfidenceEstimate)> =
        thresholds.iter().copied().zip(&group.gamma_nbr.roc_auc).collect();
    for run in areas.split(|(_, area)| area.interval.is_none()) {
        let band = |(threshold, area): &(f64, &ConfidenceEstimate)| {
            area.interval.map(|(low, high)| (*threshold, low, high))
        };
        panel.band(&run.iter().filter_map(band).collect::<Vec<_>>(), style.colour.faint(0.16));
    }
    for run in areas.split(|(_, area)| area.value.is_none()) {
        let points: Vec<_> =
            run.iter().filter_map(|(threshold, area)| Some([*threshold, area.value?])).collect();
        panel.line(points.clone(), style.line);
        panel.dots(points, style.marker, 1.9, style.colour, Some(Colour::WHITE.line(0.4)));
    }
}

/// Writes two estimates to the figure's data.
fn push_estimates(
    numbers: &mut Csv,
    panel: &str,
    threshold: Option<f64>,
    estimates: [&ConfidenceEstimate; 2],
) {
    let mut cells =
        vec![panel.to_owned(), String::new(), String::new(), String::new(), csv::number(threshold)];
    for estimate in estimates {
        let (low, high) = estimate.interval.unzip();
        cells.extend([estimate.value, low, high].map(csv::number));
    }
    numbers.push(&cells);
}

fn caption(data: &ReportData, comparison: &WalkComparison) -> String {
    let pairs = &comparison.pairs;
    let counts = &pairs.counts;
    format!(
        "Labelled candidates of biased walks, each with the labelled frame of its control walk at the same step: n = {} pairs. a, Mean \
         absolute error of the force components of a structure, biased against control; dashed, equal errors. Large point, the medians, \
         {} against {} eV Å^{{−1}}, with the interval of either. b, ROC-AUC of γ_{{nbr}} under the original mixture for force errors of atoms \
         above a threshold, of the structures of the pairs; dashed, a grade that says nothing. {}. Not shown: {} pairs that are one \
         structure, {} with failed labels, whose errors are unknown.{}",
        grouped(counts.pairs),
        crate::output::decimals(pairs.force_mae.biased.value, 3),
        crate::output::decimals(pairs.force_mae.control.value, 3),
        wording::comparison::intervals(&pairs.units, comparison),
        grouped(counts.same_structure),
        grouped(counts.biased_failed + counts.control_failed + counts.both_failed),
        data.collections.of_version()
    )
}
