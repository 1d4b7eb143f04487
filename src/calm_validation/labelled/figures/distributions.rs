//! Distributions of the scores of all atoms in one panel (the paper's figure of density- and leverage-based estimators).

use ::figures::{Anchor, Axis, AxisScale, Figure, Panel, Rectangle};

use super::super::report::{LabelledReport, ScoreReport};
use super::stroke;
use crate::csv::{Csv, number};
use crate::page::style::WIDTH;
use crate::page::{FigureContent, FigureEntry};

const PLACE: Rectangle = Rectangle { x: 48.0, y: 14.0, width: 270.0, height: 170.0 };
const HEIGHT: f64 = 220.0;

/// Of the scores with a limit, of which there must be one.
pub fn draw(report: &LabelledReport) -> FigureEntry {
    // A score has the same stroke as in the figures of all scores.
    let shown: Vec<_> = report.scores.iter().enumerate().filter(|(_, score)| score.limit.is_some()).collect();
    let bands = || shown.iter().flat_map(|(_, score)| &score.bands).filter(|band| band.atoms > 0);
    let (low, high) =
        bands().fold((1.0, 1.0), |(low, high): (f64, f64), band| (low.min(band.low), high.max(band.high)));
    let outlines: Vec<_> =
        shown.iter().map(|(_, score)| outline(score, report.sampled_atoms as f64)).collect();
    let most = outlines.iter().flatten().map(|[_, share]| *share).fold(0.0, f64::max);
    let x = Axis::new("score", AxisScale::Logarithmic, low, high);
    let y = Axis::new("share of the atoms", AxisScale::Linear, 0.0, 1.05 * most);
    let mut figure = Figure::new("score-distributions", "Distributions of scores", WIDTH, HEIGHT);
    let mut panel = Panel::new(PLACE, x, y);
    let mut numbers = Csv::new(&["score", "low", "high", "atoms"]);
    panel.vertical_line(1.0);
    for (row, ((k, score), outline)) in shown.iter().zip(outlines).enumerate() {
        panel.line(outline, stroke(*k));
        let (x, y) = (PLACE.right() + 12.0, PLACE.y + 10.0 + 13.0 * row as f64);
        figure.line(vec![[x, y - 3.0], [x + 14.0, y - 3.0]], stroke(*k));
        figure.text([x + 18.0, y], &score.name, Anchor::Start);
        for band in &score.bands {
            let name = ::figures::plain(&score.name);
            numbers.push(&[name, number(band.low), number(band.high), band.atoms.to_string()]);
        }
    }
    panel.draw(&mut figure);
    let caption = format!(
        "Distribution of each score with a limit over the {} sampled atoms, in ten bins a decade; dashed, 1. Shares are of \
         all sampled atoms. Not drawn are values of zero, and those that are at once below a tenth of the limit, six decades \
         below the largest value and three below the median.",
        report.sampled_atoms
    );
    let drawn = Ok(FigureContent { figure, caption, numbers });
    FigureEntry { name: "score-distributions".into(), title: "Distributions of the scores", drawn }
}

/// Outline of the histogram of shares of `all` atoms.
fn outline(score: &ScoreReport, all: f64) -> Vec<[f64; 2]> {
    let all = all.max(1.0);
    let steps =
        score.bands.iter().flat_map(|band| [band.low, band.high].map(|x| [x, band.atoms as f64 / all]));
    steps.collect()
}
