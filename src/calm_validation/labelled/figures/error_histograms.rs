//! Errors of the force components of the atoms within and beyond the limit of a score (the paper's Figs. 5 and S7).

use ::figures::{Anchor, Axis, AxisScale, Colour, Figure, Panel, Rectangle};

use super::super::report::{ErrorHistograms, LabelledReport, ScoreReport};
use super::{outlines, reliability};
use crate::csv::{Csv, number};
use crate::output::decimals;
use crate::page::style::WIDTH;
use crate::page::{FigureContent, FigureEntry};

/// Height of a row of two panels, and of a panel, points.
pub const ROW: f64 = 240.0;
pub const PANEL: f64 = 180.0;
/// Height of the axis, in heights of the histograms, with room for words and inset.
const ROOM: f64 = 2.2;
/// Colours of the atoms within and beyond the limit.
const COLOURS: [Colour; 2] = [Colour::BLUE, Colour::VERMILLION];

/// A score with its limit and its histograms.
pub type Split<'a> = (&'a ScoreReport, f64, &'a ErrorHistograms);

/// `None` without a score that has a limit, or without an error above zero.
pub fn draw(report: &LabelledReport) -> Option<FigureEntry> {
    let shown: Vec<Split> = report.scores.iter().filter_map(split).collect();
    if shown.is_empty() {
        return None;
    }
    let description = "Errors of the force components of the atoms within and beyond the limit of a score";
    let height = ROW * shown.len().div_ceil(2) as f64 + 4.0;
    let mut figure = Figure::new("error-histograms", description, WIDTH, height);
    let mut numbers = Csv::new(&["score", "low", "high", "within", "beyond"]);
    for (k, split) in shown.iter().enumerate() {
        let (x, y) = ([46.0, 302.0][k % 2], 24.0 + ROW * (k / 2) as f64);
        let place = Rectangle { x, y, width: 192.0, height: PANEL };
        draw_split(&mut figure, split, place, char::from(b'a' + k as u8));
        figure.text([place.x - 8.0, place.y - 6.0], &split.0.name, Anchor::Start);
        push_split(&mut numbers, split, &split.0.name);
    }
    let names = shown.iter().map(|split| {
        let [within, beyond] = facts(split);
        format!("{} {within}; {beyond}", split.0.name)
    });
    let caption = format!(
        "Absolute errors of the force components of the {} sampled atoms up to the limit of a score (blue) and beyond it (red), each by \
         themselves, in ten bins a decade. Means and medians (eV Å^{{−1}}) and, in parentheses, the share of the atoms beyond the limit: {}. \
         Insets, force error |F_{{model}} − F_{{label}}| of an atom against its score, as in the figure of the reliability of the threshold; ρ, \
         Spearman’s.",
        report.sampled_atoms,
        names.collect::<Vec<_>>().join(". ")
    );
    let drawn = Ok(FigureContent { figure, caption, numbers });
    Some(FigureEntry {
        name: "error-histograms".into(),
        title: "Force errors on either side of the limit",
        drawn,
    })
}

/// `None` for a score without limit, or without an error above zero.
pub fn split(score: &ScoreReport) -> Option<Split<'_>> {
    Some((score, score.limit?, score.component_histograms.as_ref()?))
}

/// What is said of the atoms within and beyond the limit.
fn facts((score, limit, histograms): &Split) -> [String; 2] {
    let kept = score.confident.as_ref().and_then(|found| found.retention.value);
    let flagged = kept.map_or(String::new(), |kept| format!(" ({:.1} %)", 100.0 * (1.0 - kept)));
    let of = |name: String, k: usize| {
        let population = &histograms.populations[k];
        let [mean, median] = [population.mean, population.median].map(|error| decimals(error, 3));
        format!("{name}: mean {mean}, median {median}")
    };
    [of(format!("≤ {limit}"), 0), of(format!("> {limit}{flagged}"), 1)]
}

/// A panel with its inset.
pub fn draw_split(figure: &mut Figure, split: &Split, place: Rectangle, letter: char) {
    let (score, _, histograms) = split;
    let outlines = outlines(histograms);
    let most = outlines.iter().flatten().map(|[_, share]| *share).fold(0.0, f64::max);
    let (low, high) = (histograms.edges[0], histograms.edges[histograms.edges.len() - 1]);
    let x = Axis::new("error of a force component (eV Å^{−1})", AxisScale::Logarithmic, low, high);
    let y = Axis::new("share of the components", AxisScale::Linear, 0.0, ROOM * most);
    let mut panel = Panel::new(place, x, y);
    let top = [panel.x.low, panel.y.high];
    for (k, (outline, colour)) in outlines.into_iter().zip(COLOURS).enumerate() {
        panel.polygons([outline.clone()], Some(colour.faint(0.18)), None);
        panel.line(outline, colour.line(0.9));
        panel.text(top, [4.0, 10.0 + 10.0 * k as f64], &facts(split)[k], Anchor::Start).colour = colour;
    }
    panel.panel_letter(letter);
    panel.draw(figure);
    let inset = Rectangle { x: place.right() - 92.0, y: place.y + 30.0, width: 84.0, height: 44.0 };
    reliability::draw_inset(figure, score, inset);
}

/// The numbers of a panel, which has this name.
pub fn push_split(numbers: &mut Csv, (_, _, histograms): &Split, name: &str) {
    let [within, beyond] = &histograms.populations;
    let counts = within.counts.iter().zip(&beyond.counts);
    for (edges, (within, beyond)) in histograms.edges.windows(2).zip(counts) {
        let name = ::figures::plain(name);
        numbers.push(&[name, number(edges[0]), number(edges[1]), within.to_string(), beyond.to_string()]);
    }
}
