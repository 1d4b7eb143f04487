//! Force error against γ_nbr and against the relative nearest-neighbour distance, with marginal densities (the paper's Fig. 8).

use ::figures::{Axis, AxisScale, Colour, Figure, MarginalSide, Panel, Rectangle};
use analysis::{QuantileBin, binned_quantiles, kernel_density, linear_edges, quantile};
use wire::Origin;

use super::super::collections::{CollectedAtom, Collections};
use super::super::style::{WIDTH, axis, grouped, origin_style, origins};
use super::super::{Csv, FigureContent, csv};
use super::NO_LABELS;

/// Number of bins of a panel.
const BINS: usize = 16;
/// Bins with fewer atoms are not drawn.
pub const MIN_ATOMS: u64 = 20;
/// Grid points of a marginal density.
const GRID_POINTS: usize = 160;

/// A quantity to plot the error against.
struct Quantity {
    letter: char,
    title: &'static str,
    scale: AxisScale,
    of: fn(&CollectedAtom) -> Option<f64>,
}

const QUANTITIES: [Quantity; 2] = [
    Quantity {
        letter: 'a',
        title: "γ_{nbr}",
        scale: AxisScale::Logarithmic,
        of: |atom| Some(atom.gamma_nbr),
    },
    Quantity { letter: 'b', title: "d_{nn} / d_{nn}^{0}", scale: AxisScale::Linear, of: |atom| atom.stretch },
];

pub fn draw(collections: &Collections) -> Result<FigureContent, String> {
    let has_labels = |of: &(Origin, _)| !pairs(collections, of.0, |_| Some(1.0)).is_empty();
    let shown: Vec<_> = collections.both().into_iter().filter(has_labels).map(|(origin, _)| origin).collect();
    if shown.is_empty() {
        return Err(NO_LABELS.into());
    }
    let description =
        "Force error against neighbourhood-averaged grade and relative nearest-neighbour distance";
    let mut figure = Figure::new("errors", description, WIDTH, 262.0);
    let mut numbers =
        Csv::new(&["panel", "origin", "low", "high", "atoms", "p10", "p25", "median", "p75", "p90"]);
    for (against, left) in QUANTITIES.iter().zip([46.0, 302.0]) {
        let place = Rectangle { x: left, y: 56.0, width: 162.0, height: 170.0 };
        draw_panel(&mut figure, &mut numbers, collections, &shown, against, place);
    }
    origins(&mut figure, &shown);
    Ok(FigureContent { figure, caption: caption(collections, &shown), numbers })
}

fn draw_panel(
    figure: &mut Figure,
    numbers: &mut Csv,
    collections: &Collections,
    shown: &[Origin],
    against: &Quantity,
    place: Rectangle,
) {
    let of: Vec<_> = shown.iter().map(|origin| (*origin, pairs(collections, *origin, against.of))).collect();
    let all =
        |k: usize| -> Vec<f64> { of.iter().flat_map(|(_, pairs)| pairs.iter().map(move |p| p[k])).collect() };
    let x = axis(against.title, against.scale, &all(0), Some(1.0));
    let y = axis("force error (eV Å^{−1})", AxisScale::Logarithmic, &all(1), None);
    let mut panel = Panel::new(place, x.clone(), y.clone());
    panel.vertical_line(1.0);
    let edges = edges(&x);
    let found: Vec<_> = of
        .iter()
        .map(|(origin, pairs)| (*origin, binned_quantiles(&edges, pairs.iter().map(|[x, y]| (*x, *y)))))
        .collect();
    for (origin, bands) in &found {
        draw_bands(&mut panel, *origin, bands);
        push_bands(numbers, &against.letter.to_string(), origin.name(), bands);
    }
    for (origin, bands) in &found {
        draw_medians(&mut panel, *origin, bands);
    }
    panel.panel_letter(against.letter);
    panel.draw(figure);
    draw_margins(figure, &of, place, &x, &y);
}

/// Edges of the bins of a panel, equally wide on its axis.
fn edges(x: &Axis) -> Vec<f64> {
    match x.scale {
        AxisScale::Linear => linear_edges(x.low, x.high, BINS),
        AxisScale::Logarithmic => analysis::logarithmic_edges(x.low, x.high, BINS),
    }
}

/// Midpoint of a bin on the axis of a panel.
pub fn middle(panel: &Panel, band: &QuantileBin) -> f64 {
    match panel.x.scale {
        AxisScale::Linear => 0.5 * (band.low + band.high),
        AxisScale::Logarithmic => (band.low * band.high).sqrt(),
    }
}

/// Draws the band between two quantiles over runs of bins with enough atoms.
pub fn ribbons(panel: &mut Panel, bands: &[QuantileBin], [low, high]: [usize; 2], paint: ::figures::Paint) {
    for run in bands.split(|band| band.number < MIN_ATOMS) {
        let points: Vec<_> = run
            .iter()
            .filter_map(|band| band.quantiles.map(|q| (middle(panel, band), q[low], q[high])))
            .collect();
        panel.band(&points, paint);
    }
}

fn draw_bands(panel: &mut Panel, origin: Origin, bands: &[QuantileBin]) {
    let colour = origin_style(origin).colour;
    ribbons(panel, bands, [1, 5], colour.faint(0.14));
    ribbons(panel, bands, [2, 4], colour.faint(0.22));
}

fn draw_medians(panel: &mut Panel, origin: Origin, bands: &[QuantileBin]) {
    let style = origin_style(origin);
    for run in bands.split(|band| band.number < MIN_ATOMS) {
        let median = |band: &QuantileBin| Some([middle(panel, band), band.quantiles?[3]]);
        let points: Vec<_> = run.iter().filter_map(median).collect();
        panel.line(points.clone(), style.line);
        panel.dots(points, style.marker, 1.9, style.colour, Some(Colour::WHITE.line(0.4)));
    }
}

/// Draws the marginal densities above and to the right.
fn draw_margins(figure: &mut Figure, of: &[(Origin, Vec<[f64; 2]>)], place: Rectangle, x: &Axis, y: &Axis) {
    let above = Rectangle { y: place.y - 31.0, height: 28.0, ..place };
    let right = Rectangle { x: place.right() + 3.0, width: 30.0, ..place };
    let along = |axis: &Axis, k: usize| -> Vec<(Origin, Vec<(f64, f64)>)> {
        let on = |pairs: &Vec<[f64; 2]>| pairs.iter().map(|pair| axis.position(pair[k])).collect::<Vec<_>>();
        of.iter()
            .map(|(origin, pairs)| (*origin, kernel_density(&on(pairs), 0.0, 1.0, GRID_POINTS)))
            .collect()
    };
    let (horizontal, vertical) = (along(x, 0), along(y, 1));
    let (places, densities) = (
        || Axis::new("", AxisScale::Linear, 0.0, 1.0).without_ticks(),
        |lines: &[(Origin, Vec<(f64, f64)>)]| {
            let largest =
                lines.iter().flat_map(|(_, line)| line).map(|(_, density)| *density).fold(0.0, f64::max);
            Axis::new("", AxisScale::Linear, 0.0, 1.05 * largest).without_ticks()
        },
    );
    let mut panel = Panel::new(above, places(), densities(&horizontal));
    horizontal
        .iter()
        .for_each(|(origin, line)| draw_density(&mut panel, *origin, line, |x, density| [x, density]));
    panel.draw_as_margin(figure, MarginalSide::Below);
    let mut panel = Panel::new(right, densities(&vertical), places());
    vertical
        .iter()
        .for_each(|(origin, line)| draw_density(&mut panel, *origin, line, |y, density| [density, y]));
    panel.draw_as_margin(figure, MarginalSide::Left);
}

fn draw_density(panel: &mut Panel, origin: Origin, line: &[(f64, f64)], at: fn(f64, f64) -> [f64; 2]) {
    let (Some(first), Some(last)) = (line.first(), line.last()) else { return };
    let style = origin_style(origin);
    let points: Vec<_> = line.iter().map(|(place, density)| at(*place, *density)).collect();
    let ring = [at(first.0, 0.0)].into_iter().chain(points.clone()).chain([at(last.0, 0.0)]);
    panel.polygons([ring], Some(style.colour.faint(0.15)), None);
    panel.line(points, ::figures::Stroke { width: 1.0, ..style.line });
}

/// Pairs of quantity and error of the labelled atoms.
fn pairs(collections: &Collections, origin: Origin, of: fn(&CollectedAtom) -> Option<f64>) -> Vec<[f64; 2]> {
    let (_, collection) = collections.both()[usize::from(origin == Origin::Control)];
    let pair =
        |atom: &CollectedAtom| Some([of(atom)?, atom.error?]).filter(|[x, y]| x.is_finite() && y.is_finite());
    collection.atoms.items().filter_map(pair).collect()
}

/// Writes the bins to the figure's data: panel, origin, edges, number of atoms and five quantiles.
pub fn push_bands(numbers: &mut Csv, panel: &str, origin: &str, bands: &[QuantileBin]) {
    for band in bands {
        let mut cells =
            vec![panel.to_owned(), origin.to_owned(), csv::number(band.low), csv::number(band.high)];
        cells.push(band.number.to_string());
        cells.extend((1..6).map(|k| csv::number(band.quantiles.map(|quantiles| quantiles[k]))));
        numbers.push(&cells);
    }
}

fn caption(collections: &Collections, shown: &[Origin]) -> String {
    let medians = |origin: &Origin| {
        let stretched = pairs(collections, *origin, |atom| atom.stretch);
        let mut errors: Vec<_> = stretched.iter().filter(|[x, _]| *x > 1.15).map(|[_, y]| *y).collect();
        errors.sort_by(f64::total_cmp);
        let far = match quantile(&errors, 0.5) {
            Some(median) => format!("{median:.3} eV Å^{{−1}} (n = {})", grouped(errors.len() as u64)),
            None => "unknown (n = 0)".to_owned(),
        };
        let (a, b) = (pairs(collections, *origin, |atom| Some(atom.gamma_nbr)).len(), stretched.len());
        format!(
            "{}: n = {} atoms in a and {} in b, median error where d_{{nn}}/d_{{nn}}^{{0}} > 1.15: {far}",
            origin.name(),
            grouped(a as u64),
            grouped(b as u64)
        )
    };
    let both: Vec<_> = shown.iter().map(medians).collect();
    format!(
        "a, Force error |F_{{model}} − F_{{label}}| of labelled atoms against γ_{{nbr}} under the original mixture. b, The same errors \
         against the distance of an atom to its nearest neighbour relative to the shortest distance in the seed structure of its walk; \
         atoms without a neighbour within twice that distance are omitted. Lines, medians; bands, P_{{25}}–P_{{75}} and \
         P_{{10}}–P_{{90}}, in equally wide bins with at least {MIN_ATOMS} atoms. Margins, Gaussian kernel densities on the axes as \
         drawn, each with area 1. Dashed, γ_{{nbr}} = 1 and the distance in the seed structure. {}.{}",
        both.join("; "),
        collections.of_version()
    )
}
