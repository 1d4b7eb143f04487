//! Force error against the score of an atom (the paper's Fig. 2): bands, medians, and marginal distributions.

use ::figures::{Anchor, Axis, AxisScale, Colour, Figure, MarginalSide, Panel, Rectangle};

use super::super::report::{Band, ErrorHistograms, LabelledReport, ScoreReport};
use super::outlines;
use crate::csv::{Csv, number};
use crate::page::style::WIDTH;
use crate::page::{FigureContent, FigureEntry};

/// Bins with fewer atoms are not drawn.
const MIN_ATOMS: u64 = 20;
/// Height of a row of two panels, points.
const ROW: f64 = 232.0;

/// Columns of [`Band::quantiles`] between which the bands are: 5–95, 10–90 and 25–75 %, with their opacity.
const BANDS: [(usize, usize, f64); 3] = [(0, 6, 0.12), (1, 5, 0.18), (2, 4, 0.26)];
const MEDIAN: usize = 3;

pub fn draw(report: &LabelledReport) -> FigureEntry {
    let shown: Vec<_> = report.scores.iter().filter(|score| score.limit.is_some()).collect();
    let rows = shown.len().div_ceil(2);
    let description = "Force error against the grade of an atom";
    let mut figure = Figure::new("reliability", description, WIDTH, ROW * rows as f64 + 8.0);
    let titles = ["score", "low", "high", "atoms", "p5", "p10", "p25", "median", "p75", "p90", "p95"];
    let mut numbers = Csv::new(&titles);
    for (k, score) in shown.iter().enumerate() {
        let (x, y) = ([46.0, 302.0][k % 2], 42.0 + ROW * (k / 2) as f64);
        let place = Rectangle { x, y, width: 162.0, height: 150.0 };
        draw_panel(&mut figure, score, place, char::from(b'a' + k as u8));
        score.bands.iter().for_each(|band| push(&mut numbers, &score.name, band));
    }
    let caption = format!(
        "Force error |F_{{model}} − F_{{label}}| of an atom against its score. Dashed, median; bands, P_{{25}}–P_{{75}}, \
         P_{{10}}–P_{{90}} and P_{{5}}–P_{{95}}, in ten bins a decade with at least {MIN_ATOMS} atoms each; blue up to the limit of the \
         score, red beyond it. Margins: distribution of the score, and of the force errors of either population by itself. {}.",
        shown.iter().map(|score| facts(score)).collect::<Vec<_>>().join("; ")
    );
    let drawn = Ok(FigureContent { figure, caption, numbers });
    FigureEntry { name: "reliability".into(), title: "Reliability of the threshold", drawn }
}

fn facts(score: &ScoreReport) -> String {
    let mut facts = score.name.clone();
    if let Some(rho) = score.spearman.value {
        facts += &format!(": Spearman’s ρ = {rho:.3}");
    }
    if let (Some(limit), Some(kept)) =
        (score.limit, score.confident.as_ref().and_then(|found| found.retention.value))
    {
        facts += &format!(", {:.1} % of the atoms above {limit}", 100.0 * (1.0 - kept));
    }
    facts
}

fn draw_panel(figure: &mut Figure, score: &ScoreReport, place: Rectangle, letter: char) {
    let (x, y) = (score_axis(score), error_axis(score));
    let mut panel = Panel::new(place, x.clone(), y.clone());
    draw_bands(&mut panel, score);
    if score.bands.iter().all(|band| band.atoms < MIN_ATOMS) {
        panel.placeholder("too few atoms");
    }
    panel.panel_letter(letter);
    draw_rank(&mut panel, score);
    panel.draw(figure);
    draw_scores(figure, score, place, &x);
    if let Some(histograms) = &score.error_histograms {
        draw_errors(figure, histograms, place, &y);
    }
}

/// The bands of a panel without its margins, small; nothing with too few atoms.
pub fn draw_inset(figure: &mut Figure, score: &ScoreReport, place: Rectangle) {
    if score.bands.iter().all(|band| band.atoms < MIN_ATOMS) {
        return;
    }
    let mut panel =
        Panel::new(place, score_axis(score).with_ticks(3), error_axis(score).with_title("").with_ticks(3));
    draw_bands(&mut panel, score);
    draw_rank(&mut panel, score);
    panel.draw(figure);
}

/// Whether all atoms of a bin are within the limit.
fn is_within(score: &ScoreReport, band: &Band) -> bool {
    band.high <= score.limit.unwrap_or(f64::INFINITY) * (1.0 + 1e-9)
}

fn colour(score: &ScoreReport, band: &Band) -> Colour {
    if is_within(score, band) { Colour::BLUE } else { Colour::VERMILLION }
}

/// Bands, medians and the limit.
fn draw_bands(panel: &mut Panel, score: &ScoreReport) {
    for run in score.bands.split(|band| band.atoms < MIN_ATOMS) {
        for part in run.chunk_by(|a, b| is_within(score, a) == is_within(score, b)) {
            let colour = colour(score, &part[0]);
            for (low, high, opacity) in BANDS {
                let point = |band: &Band| band.quantiles.map(|q| (middle(band), q[low], q[high]));
                panel.band(&part.iter().filter_map(point).collect::<Vec<_>>(), colour.faint(opacity));
            }
        }
        let median = |band: &Band| band.quantiles.map(|q| [middle(band), q[MEDIAN]]);
        panel.line(run.iter().filter_map(median), Colour::INK.dashed(1.1));
    }
    panel.vertical_line(score.limit.unwrap_or(f64::INFINITY));
}

/// Spearman's ρ, in the lower right corner.
fn draw_rank(panel: &mut Panel, score: &ScoreReport) {
    let corner = [panel.x.high, panel.y.low];
    if let Some(rho) = score.spearman.value {
        panel.text(corner, [-4.0, -5.0], &format!("ρ = {rho:.3}"), Anchor::End);
    }
}

/// Distribution of the score, above the panel.
fn draw_scores(figure: &mut Figure, score: &ScoreReport, place: Rectangle, x: &Axis) {
    let above = Rectangle { y: place.y - 31.0, height: 28.0, ..place };
    let most = score.bands.iter().map(|band| band.atoms).max().unwrap_or(0) as f64;
    let count = Axis::new("", AxisScale::Linear, 0.0, 1.05 * most).without_ticks();
    let mut panel = Panel::new(above, x.clone().with_title("").without_ticks(), count);
    for band in score.bands.iter().filter(|band| band.atoms > 0) {
        panel.bar([band.low, 0.0], [band.high, band.atoms as f64], colour(score, band).faint(0.3));
    }
    panel.draw_as_margin(figure, MarginalSide::Below);
}

/// Distributions of the error of either population, to the right.
fn draw_errors(figure: &mut Figure, histograms: &ErrorHistograms, place: Rectangle, y: &Axis) {
    let right = Rectangle { x: place.right() + 3.0, width: 30.0, ..place };
    let outlines = outlines(histograms);
    let most = outlines.iter().flatten().map(|[_, share]| *share).fold(0.0, f64::max);
    let share = Axis::new("", AxisScale::Linear, 0.0, 1.05 * most).without_ticks();
    let mut panel = Panel::new(right, share, y.clone().with_title("").without_ticks());
    for (outline, colour) in outlines.into_iter().zip([Colour::BLUE, Colour::VERMILLION]) {
        let outline: Vec<_> = outline.into_iter().map(|[error, share]| [share, error]).collect();
        panel.polygons([outline.clone()], Some(colour.faint(0.18)), None);
        panel.line(outline, colour.line(0.9));
    }
    panel.draw_as_margin(figure, MarginalSide::Left);
}

/// The bins that are drawn, and the limit.
fn score_axis(score: &ScoreReport) -> Axis {
    let shown = || score.bands.iter().filter(|band| band.atoms >= MIN_ATOMS);
    let limit = score.limit.unwrap_or(1.0);
    let low = shown().map(|band| band.low).fold(0.8 * limit, f64::min);
    let high = shown().map(|band| band.high).fold(1.25 * limit, f64::max);
    Axis::new(&score.name, AxisScale::Logarithmic, low, high)
}

/// From the smallest 5 % to the largest 95 % quantile.
fn error_axis(score: &ScoreReport) -> Axis {
    let shown = score.bands.iter().filter(|band| band.atoms >= MIN_ATOMS);
    let quantiles: Vec<_> = shown.filter_map(|band| band.quantiles).collect();
    let low = quantiles.iter().map(|q| q[0]).filter(|x| *x > 0.0).fold(f64::INFINITY, f64::min);
    let high = quantiles.iter().map(|q| q[6]).fold(0.0, f64::max);
    Axis::new("force error (eV Å^{−1})", AxisScale::Logarithmic, low / 1.2, 1.2 * high)
}

/// Midpoint of a bin on the axis.
fn middle(band: &Band) -> f64 {
    (band.low * band.high).sqrt()
}

fn push(numbers: &mut Csv, name: &str, band: &Band) {
    let mut cells = vec![::figures::plain(name), number(band.low), number(band.high), band.atoms.to_string()];
    cells.extend((0..7).map(|k| number(band.quantiles.map(|quantiles| quantiles[k]))));
    numbers.push(&cells);
}
