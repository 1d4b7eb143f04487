//! Errors of the force components within and beyond γ_nbr = 1, a row of panels for each model and a column for each set of labelled
//! structures (the paper's Fig. 5).

use ::figures::{Anchor, Figure};

use super::super::sets::LabelledSet;
use super::error_histograms::{PANEL, ROW, Split, draw_split, push_split, split};
use crate::csv::Csv;
use crate::page::style::{WIDTH, row};
use crate::page::{FigureContent, FigureEntry};

/// Most sets in a row: panels have words and insets.
const COLUMNS: usize = 2;
/// Height above the first row, points.
const TOP: f64 = 24.0;

/// `None` for one model and one set, whose panel is in another figure, or without an error above zero.
pub fn draw(sets: &[LabelledSet]) -> Option<FigureEntry> {
    let panels: Vec<_> = sets.chunks(COLUMNS).flat_map(panels).collect();
    if panels.iter().flatten().flatten().count() < 2 {
        return None;
    }
    let description =
        "Errors of the force components on either side of the limit, by model and set of structures";
    let height = ROW * panels.len() as f64 + 4.0;
    let mut figure = Figure::new("error-grid", description, WIDTH, height);
    let mut numbers = Csv::new(&["score", "low", "high", "within", "beyond"]);
    let mut letters = 'a'..='z';
    for (line, panels) in panels.iter().enumerate() {
        let places = row(COLUMNS, [46.0, 64.0, 16.0], TOP + ROW * line as f64, PANEL);
        for (panel, place) in panels.iter().zip(places) {
            let Some((title, split)) = panel else { continue };
            draw_split(&mut figure, split, place, letters.next().unwrap_or(' '));
            figure.text([place.x + 6.0, place.y - 6.0], title, Anchor::Start);
            push_split(&mut numbers, split, title);
        }
    }
    let caption = "Absolute errors of the force components of the sampled atoms with γ_{nbr} up to 1 (blue) and beyond it (red), each by \
                   themselves, in ten bins a decade, with means, medians (eV Å^{−1}) and the share beyond. Rows, models, each with its own \
                   mixture and its own errors; columns, sets of labelled structures. Insets, force error of an atom against γ_{nbr}; ρ, \
                   Spearman’s.";
    let drawn = Ok(FigureContent { figure, caption: caption.into(), numbers });
    Some(FigureEntry { name: "error-grid".into(), title: "Force errors by model and set", drawn })
}

/// A panel with its title; `None` for a set without errors on either side of the limit.
type GridPanel<'a> = Option<(String, Split<'a>)>;

/// Rows of panels: the model of the scores, then the others. Rows without any panel are left out.
fn panels(sets: &[LabelledSet]) -> Vec<Vec<GridPanel<'_>>> {
    let models = sets.first().map_or(0, |set| set.models.len());
    let panel = |line: usize| {
        sets.iter().map(move |set| {
            let (model, score) = match line.checked_sub(1) {
                None => ("model", set.report.average()?),
                Some(k) => (set.models[k].model.as_str(), &set.models[k].average),
            };
            Some((format!("{model}: {}", set.file), split(score)?))
        })
    };
    let mut rows: Vec<Vec<_>> = (0..=models).map(|line| panel(line).collect()).collect();
    rows.retain(|panels| panels.iter().any(Option::is_some));
    rows
}
