//! Errors of the force components within and beyond γ_nbr = 1 (the paper's Fig. 5) and γ = 1 (Fig. S7), a row of panels for each model and
//! a column for each set of labelled structures.

use ::figures::{Anchor, Figure};

use super::super::report::{LabelledReport, ScoreReport};
use super::super::sets::{ComparedModel, LabelledSet};
use super::error_histograms::{PANEL, ROW, Split, draw_split, push_split, split};
use crate::csv::Csv;
use crate::page::style::{WIDTH, row};
use crate::page::{FigureContent, FigureEntry};

/// Most sets in a row: panels have words and insets.
const COLUMNS: usize = 2;
/// Height above the first row, points.
const TOP: f64 = 24.0;

/// A grade whose limit divides the errors.
struct GridScore {
    /// Of the figure's files.
    name: &'static str,
    title: &'static str,
    /// In captions.
    symbol: &'static str,
    of_report: fn(&LabelledReport) -> Option<&ScoreReport>,
    of_model: fn(&ComparedModel) -> &ScoreReport,
}

const SCORES: [GridScore; 2] = [
    GridScore {
        name: "error-grid",
        title: "Force errors by model and set",
        symbol: "γ_{nbr}",
        of_report: LabelledReport::average,
        of_model: |model| &model.average,
    },
    GridScore {
        name: "error-grid-gamma",
        title: "Force errors by model and set, before averaging",
        symbol: "γ",
        of_report: LabelledReport::grade,
        of_model: |model| &model.grade,
    },
];

/// A figure for γ_nbr and one for γ. None for one model and one set, whose panels are in another figure, or without an error above zero.
pub fn draw(sets: &[LabelledSet]) -> Vec<FigureEntry> {
    SCORES.iter().filter_map(|score| draw_score(sets, score)).collect()
}

fn draw_score(sets: &[LabelledSet], score: &GridScore) -> Option<FigureEntry> {
    let panels: Vec<_> = sets.chunks(COLUMNS).flat_map(|sets| panels(sets, score)).collect();
    if panels.iter().flatten().flatten().count() < 2 {
        return None;
    }
    let description =
        "Errors of the force components on either side of the limit, by model and set of structures";
    let height = ROW * panels.len() as f64 + 4.0;
    let mut figure = Figure::new(score.name, description, WIDTH, height);
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
    let symbol = score.symbol;
    let caption = format!(
        "Absolute errors of the force components of the sampled atoms with {symbol} up to 1 (blue) and beyond it (red), each by themselves, in \
         ten bins a decade, with means, medians (eV Å^{{−1}}) and the share beyond. Rows, models, each with its own mixture and its own errors; \
         columns, sets of labelled structures. Insets, force error of an atom against {symbol}; ρ, Spearman’s."
    );
    let drawn = Ok(FigureContent { figure, caption, numbers });
    Some(FigureEntry { name: score.name.into(), title: score.title, drawn })
}

/// A panel with its title; `None` for a set without errors on either side of the limit.
type GridPanel<'a> = Option<(String, Split<'a>)>;

/// Rows of panels: the model of the scores, then the others. Rows without any panel are left out.
fn panels<'a>(sets: &'a [LabelledSet], score: &GridScore) -> Vec<Vec<GridPanel<'a>>> {
    let models = sets.first().map_or(0, |set| set.models.len());
    let GridScore { of_report, of_model, .. } = *score;
    let panel = |line: usize| {
        sets.iter().map(move |set| {
            let (model, score) = match line.checked_sub(1) {
                None => ("model", of_report(&set.report)?),
                Some(k) => (set.models[k].model.as_str(), of_model(&set.models[k])),
            };
            Some((format!("{model}: {}", set.file), split(score)?))
        })
    };
    let mut rows: Vec<Vec<_>> = (0..=models).map(|line| panel(line).collect()).collect();
    rows.retain(|panels| panels.iter().any(Option::is_some));
    rows
}
