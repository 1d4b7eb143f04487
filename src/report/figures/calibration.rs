//! Bounds of the force error against the errors of labelled atoms, and how often bounds held while labels came.

use ::figures::{Axis, AxisScale, Colour, Figure, LegendKey, Marker, Panel, Rectangle, legend};
use analysis::{QuantileBin, binned_quantiles, logarithmic_edges};
use monitor::calibration::{CALIBRATION, CalibrationBin, CalibrationState};

use super::super::collections::Collections;
use super::super::report_data::ReportData;
use super::super::style::{WIDTH, axis, grouped};
use super::super::{Csv, FigureContent, csv};
use super::errors::{MIN_ATOMS, middle};
use super::{NO_LABELS, row};
use crate::wording;

/// Number of bins of labelled atoms.
const BINS: usize = 18;
/// Largest number of points of a curve.
const POINTS: usize = 400;
/// Index of the 90 % quantile among [`QuantileBin::LEVELS`].
const P90: usize = 5;

pub fn draw(data: &ReportData) -> Result<FigureContent, String> {
    let labels =
        data.labels.as_ref().filter(|labels| labels.calibration.structures() > 0).ok_or(NO_LABELS)?;
    let summary = labels.calibration.summary();
    let bins: Vec<_> = summary.pooled().into_iter().map(|(bin, _)| bin).collect();
    if bins.iter().all(|bin| bin.bound.is_none()) {
        return Err(format!("{}.", wording::calibration::sentence(&summary)));
    }
    let description = "Bounds of the force error by grade, and how often they held";
    let mut figure = Figure::new("error-bounds", description, WIDTH, 226.0);
    let mut numbers = Csv::new(&["panel", "low", "high", "number", "value"]);
    let places = row(2, [46.0, 56.0, 12.0], 28.0, 162.0);
    draw_bounds(&mut figure, &mut numbers, &data.collections, &bins, places[0]);
    draw_coverage(&mut figure, &mut numbers, &labels.calibration, places[1]);
    let keys = [
        (LegendKey::Line(Colour::VERMILLION.line(1.3)), "bound"),
        (LegendKey::Line(Colour::INK.dashed(1.3)), "expected error"),
        (LegendKey::Line(Colour::BLUE.line(1.0)), "P_{90} of labelled atoms"),
    ];
    legend(&mut figure, [WIDTH - 8.0, 12.0], &keys);
    let by_value = match labels.calibration.outcomes_by_value().len() {
        0 => String::new(),
        number => format!("; blue, of labels chosen by value, n = {}", grouped(number as u64)),
    };
    let caption = format!(
        "a, Bound of the force error |F_{{model}} − F_{{label}}| and expected error by γ_{{nbr}} under the original mixture, from the newest \
         structures of each bin, with the 90 % quantile of all labelled atoms in equally wide bins with at least {MIN_ATOMS} atoms: {}. b, \
         Share of the atoms of a structure whose error was not above the bound from before its label came, mean over the newest {} \
         structures at that time (n = {}{by_value}). Dashed grey, γ_{{nbr}} = 1 and the promised share.{}",
        wording::calibration::sentence(&summary).replace("γ_nbr", "γ_{nbr}"),
        CALIBRATION.counted,
        grouped(labels.calibration.outcomes().len() as u64),
        data.collections.of_version()
    );
    Ok(FigureContent { figure, caption, numbers })
}

fn draw_bounds(
    figure: &mut Figure,
    numbers: &mut Csv,
    collections: &Collections,
    bins: &[&CalibrationBin],
    place: Rectangle,
) {
    let atoms = collections.both().into_iter().flat_map(|(_, of)| of.atoms.items());
    let pairs = atoms.filter_map(|atom| Some((atom.gamma_nbr, atom.error?)));
    let pairs: Vec<_> = pairs.filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
    let (grades, mut errors): (Vec<_>, Vec<_>) = pairs.iter().copied().unzip();
    errors.extend(bins.iter().flat_map(|bin| [bin.bound, bin.mean]).flatten());
    let x = axis("γ_{nbr}", AxisScale::Logarithmic, &grades, Some(1.0));
    let y = axis("force error (eV Å^{−1})", AxisScale::Logarithmic, &errors, None);
    let (low, high) = (x.low, x.high);
    let found = binned_quantiles(&logarithmic_edges(low, high, BINS), pairs);
    let mut panel = Panel::new(place, x, y);
    panel.vertical_line(1.0);
    let quantile =
        |band: &QuantileBin| band.quantiles.filter(|_| band.number >= MIN_ATOMS).map(|all| all[P90]);
    let points: Vec<_> =
        found.iter().filter_map(|band| Some([middle(&panel, band), quantile(band)?])).collect();
    panel.line(points.clone(), Colour::BLUE.line(1.0));
    panel.dots(points, Marker::Disc, 1.9, Colour::BLUE, None);
    for bin in bins {
        let (left, right) = (bin.above.unwrap_or(low).max(low), bin.up_to.unwrap_or(high).min(high));
        if left >= right {
            continue;
        }
        let step = |value: f64| [[left, value], [right, value]];
        bin.mean.into_iter().for_each(|mean| panel.line(step(mean), Colour::INK.dashed(1.3)));
        bin.bound.into_iter().for_each(|bound| panel.line(step(bound), Colour::VERMILLION.line(1.3)));
    }
    panel.panel_letter('a');
    panel.draw(figure);
    for bin in bins {
        numbers.push(&[
            "a, bound".to_owned(),
            csv::number(bin.above),
            csv::number(bin.up_to),
            bin.structures.to_string(),
            csv::number(bin.bound),
        ]);
    }
    for band in &found {
        numbers.push(&[
            "a, P90 of labelled atoms".to_owned(),
            csv::number(band.low),
            csv::number(band.high),
            band.number.to_string(),
            csv::number(quantile(band)),
        ]);
    }
}

fn draw_coverage(figure: &mut Figure, numbers: &mut Csv, calibration: &CalibrationState, place: Rectangle) {
    let curves = [("b", calibration.outcomes()), ("b, by value", calibration.outcomes_by_value())];
    let curves = curves.map(|(name, outcomes)| (name, rolling_means(&outcomes, CALIBRATION.counted)));
    let points = || curves.iter().flat_map(|(_, curve)| curve);
    let most = points().map(|point| point[0]).fold(1.0, f64::max);
    let least = points().map(|point| point[1]).fold(80.0, f64::min);
    let x = Axis::new("structures with a bound", AxisScale::Linear, 0.0, most);
    let y = Axis::new("atoms below their bound (%)", AxisScale::Linear, (least - 2.0).max(0.0), 101.0);
    let promised = 100.0 * CALIBRATION.level;
    let mut panel = Panel::new(place, x, y);
    panel.line([[0.0, promised], [most, promised]], Colour::GREY.dashed(0.7));
    if points().next().is_none() {
        panel.placeholder("no label has tested a bound yet");
    }
    for ((_, curve), colour) in curves.iter().zip([Colour::VERMILLION, Colour::BLUE]) {
        panel.line(curve.clone(), colour.line(1.3));
    }
    panel.panel_letter('b');
    panel.draw(figure);
    for (name, curve) in curves {
        for [number, share] in curve {
            let empty = String::new;
            numbers.push(&[name.to_owned(), empty(), empty(), number.to_string(), csv::number(share)]);
        }
    }
}

/// Number of outcomes so far, and the mean of the newest `counted` of them in percent, at most at [`POINTS`] places.
fn rolling_means(outcomes: &[f64], counted: usize) -> Vec<[f64; 2]> {
    let stride = outcomes.len().div_ceil(POINTS).max(1);
    let at = |number: usize| {
        let newest = &outcomes[number.saturating_sub(counted)..number];
        [number as f64, 100.0 * newest.iter().sum::<f64>() / newest.len() as f64]
    };
    let last = outcomes.len();
    (1..=last).filter(|number| *number == last || number.is_multiple_of(stride)).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rolling_mean_is_of_the_newest() {
        assert_eq!(rolling_means(&[], 2), Vec::<[f64; 2]>::new());
        assert_eq!(rolling_means(&[0.0, 1.0, 1.0], 2), [[1.0, 0.0], [2.0, 50.0], [3.0, 100.0]]);
        let many = rolling_means(&vec![1.0; 1001], 200);
        assert!(many.len() <= POINTS && many.last() == Some(&[1001.0, 100.0]));
    }
}
