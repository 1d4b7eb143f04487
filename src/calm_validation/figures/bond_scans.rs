//! Energy and scores along bond scans (the paper's Figs. 3a, S1 and S10).

use figures::{Axis, AxisScale, Colour, Figure, LegendKey, Panel, Point, Rectangle};

use super::super::detection::{COMPRESSION, DetectionRule, LONGEST, STRETCHING};
use super::super::{BondScan, Validation};
use super::layout::{
    OTHER_CRYSTAL, PanelGrid, axis, crystal_names, legend_height, legend_rows, letter, line, other_line,
    panel_name,
};
use crate::csv::{self, Csv};
use crate::page::FigureContent;
use crate::page::style::WIDTH;

/// Largest energy per atom that is drawn, eV.
const MAX_ENERGY: f64 = 12.0;
/// Height of the panel of energies and the gap below it, points.
const ENERGIES: f64 = 44.0;
const GAP: f64 = 6.0;

pub fn draw(validation: &Validation) -> Result<FigureContent, String> {
    let scans: Vec<_> = validation.bond_scans.iter().filter(|scan| scan.is_ground_state).collect();
    if scans.is_empty() {
        return Err("No element was tested.".into());
    }
    let keys = keys(validation);
    let top = 20.0 + legend_height(&keys);
    let grid = PanelGrid { number: scans.len(), height: ENERGIES + GAP + 110.0, top };
    let description = "Energy and extrapolation scores along bond scans of elemental crystals";
    let mut figure = Figure::new("bond-scans", description, WIDTH, grid.total_height());
    legend_rows(&mut figure, &keys);
    for (k, scan) in scans.iter().enumerate() {
        let place = grid.panel_rectangle(k);
        let others: Vec<_> =
            validation.bond_scans.iter().filter(|other| is_other_crystal(scan, other)).collect();
        let above = Rectangle { height: ENERGIES, ..place };
        draw_energies(&mut figure, scan, &others, above, letter(k));
        let height = place.height - ENERGIES - GAP;
        let below = Rectangle { y: place.y + ENERGIES + GAP, height, ..place };
        draw_scores(&mut figure, validation, scan, &others, below);
    }
    Ok(FigureContent { figure, caption: caption(validation), numbers: numbers(validation) })
}

fn is_other_crystal(scan: &BondScan, other: &BondScan) -> bool {
    other.element == scan.element && !other.is_ground_state
}

fn keys(validation: &Validation) -> Vec<(LegendKey, String)> {
    let drawn = validation.scores.iter().enumerate().filter(|(_, score)| score.rule.is_some());
    let mut keys: Vec<_> = drawn.map(|(k, score)| (LegendKey::Line(line(k)), score.name.clone())).collect();
    keys.push((LegendKey::Line(other_line()), format!("γ, {OTHER_CRYSTAL}")));
    keys
}

fn distances(title: &str, scan: &BondScan) -> Axis {
    let first = scan.points.first().map_or(0.0, |point| point.distance);
    Axis::new(title, AxisScale::Linear, first, LONGEST)
}

/// Energies per atom along a scan, relative to `zero`, eV.
fn energies(scan: &BondScan, zero: f64) -> Vec<Point> {
    scan.points.iter().filter_map(|point| Some([point.distance, point.energy? - zero])).collect()
}

fn draw_energies(figure: &mut Figure, scan: &BondScan, others: &[&BondScan], place: Rectangle, letter: char) {
    let lowest = scan.energy.unwrap_or(0.0);
    let own = energies(scan, lowest);
    let stretched = own.iter().filter(|[d, _]| *d > scan.equilibrium).map(|[_, energy]| *energy);
    let depth = stretched.fold(0.1, f64::max).min(MAX_ENERGY);
    let y = Axis::new("ΔE (eV)", AxisScale::Linear, -0.15 * depth, 1.25 * depth).with_ticks(3);
    let mut panel = Panel::new(place, distances("", scan).without_ticks(), y);
    panel.vertical_line(scan.equilibrium);
    others.iter().for_each(|other| panel.line(energies(other, lowest), Colour::INK.dashed(0.8)));
    panel.line(own, Colour::INK.line(1.0));
    panel.panel_letter(letter);
    panel.draw(figure);
    let dashed = others.first().map(|other| other.prototype.as_str());
    panel_name(figure, place, &scan.element, &crystal_names(&scan.prototype, dashed));
}

/// What the scores of a scan are divided by, so that 1 is the limit of detection.
fn limit(validation: &Validation, scan: &BondScan, score: usize) -> Option<f64> {
    match validation.scores[score].rule? {
        DetectionRule::Threshold(limit) => Some(limit),
        DetectionRule::TimesMedian(factor) => Some(factor * scan.detection[score].median_near_equilibrium?),
    }
}

/// The largest values of a score along a scan, with that at equilibrium, divided by `limit`.
fn points(scan: &BondScan, score: usize, limit: f64) -> Vec<[f64; 2]> {
    let of_scan = scan.points.iter().map(|point| (point.distance, point.scores[score]));
    let all = of_scan.chain([(scan.equilibrium, scan.detection[score].at_equilibrium)]);
    let mut points: Vec<_> = all.filter_map(|(distance, score)| Some([distance, score? / limit])).collect();
    points.retain(|[_, y]| y.is_finite() && *y > 0.0);
    points.sort_by(|a, b| a[0].total_cmp(&b[0]));
    points
}

fn draw_scores(
    figure: &mut Figure,
    validation: &Validation,
    scan: &BondScan,
    others: &[&BondScan],
    place: Rectangle,
) {
    let drawn = (0..validation.scores.len())
        .filter_map(|k| Some((line(k), points(scan, k, limit(validation, scan, k)?))));
    let mut lines: Vec<_> = others.iter().map(|other| (other_line(), points(other, 0, 1.0))).collect();
    let own: Vec<_> = drawn.collect();
    lines.extend(own.into_iter().rev());
    let values = lines.iter().flat_map(|(_, points)| points.iter().map(|[_, y]| *y));
    let x = distances("nearest-neighbour distance (Å)", scan);
    let y = axis(if validation.scores.len() == 1 { "γ" } else { "score" }, values);
    let (first, shade) = (x.low, Colour::GREY.faint(0.1));
    let mut panel = Panel::new(place, x, y);
    let (low, high) = (panel.y.low, panel.y.high);
    panel.bar([first, low], [(COMPRESSION * scan.equilibrium).max(first), high], shade);
    panel.bar([(STRETCHING * scan.equilibrium).min(LONGEST), low], [LONGEST, high], shade);
    panel.vertical_line(scan.equilibrium);
    panel.line([[first, 1.0], [LONGEST, 1.0]], Colour::GREY.dashed(0.7));
    for (stroke, points) in lines {
        panel.line(points, stroke);
    }
    panel.draw(figure);
}

fn caption(validation: &Validation) -> String {
    let relative =
        validation.scores.iter().any(|score| matches!(score.rule, Some(DetectionRule::TimesMedian(_))));
    let relative = match relative {
        true => {
            " Scores without a threshold are divided by ten times their median within 5 % of equilibrium."
        }
        false => "",
    };
    let without: Vec<_> = validation
        .scores
        .iter()
        .filter(|score| score.rule.is_none())
        .map(|score| score.name.as_str())
        .collect();
    let without = match without.is_empty() {
        true => String::new(),
        false => format!(" Not drawn, as it has no zero: {}.", without.join(", ")),
    };
    let guessed: Vec<_> = validation
        .bond_scans
        .iter()
        .filter(|scan| scan.is_ground_state && !scan.is_relaxed)
        .map(|scan| scan.element.as_str())
        .collect();
    let guessed = match guessed.is_empty() {
        true => String::new(),
        false => format!(
            " The model has no minimum of the energy near the published distance of {}; that distance is marked instead.",
            guessed.join(", ")
        ),
    };
    let stand_in: Vec<_> = validation
        .bond_scans
        .iter()
        .filter(|scan| scan.is_ground_state && !scan.is_own)
        .map(|scan| scan.element.as_str())
        .collect();
    let stand_in = match stand_in.is_empty() {
        true => String::new(),
        false => {
            format!(" {} form no such crystal: a related or close-packed one stands in.", stand_in.join(", "))
        }
    };
    format!(
        "Energy per atom relative to that at equilibrium (above) and largest score of an atom (below) of the elements’ ground-state crystals, scaled \
         over {} distances of nearest neighbours; dashed, energy and γ of a crystal that the element does not form. Dashed grey, the distance with \
         the lowest energy and the limit 1. Shaded, compression \
         (d < {COMPRESSION} d_{{eq}}) and stretching ({STRETCHING} d_{{eq}} < d < {LONGEST} Å), which a grade should flag.{relative}{without}{guessed}{stand_in}",
        validation.settings.scan_steps
    )
}

fn numbers(validation: &Validation) -> Csv {
    let mut titles = vec!["element", "prototype", "ground_state", "equilibrium", "distance", "energy"];
    titles.extend(validation.scores.iter().map(|score| score.name.as_str()));
    let mut numbers = Csv::new(&titles);
    for scan in &validation.bond_scans {
        for point in &scan.points {
            let mut row =
                vec![scan.element.clone(), scan.prototype.clone(), scan.is_ground_state.to_string()];
            row.extend([
                csv::number(scan.equilibrium),
                csv::number(point.distance),
                csv::number(point.energy),
            ]);
            row.extend(point.scores.iter().map(|score| csv::number(*score)));
            numbers.push(&row);
        }
    }
    numbers
}
