//! Contamination of what γ and γ_nbr up to 1 keep, as a map over dimension and components of several mixtures (the paper's figure of
//! contamination at a fixed threshold).

use ::figures::{Anchor, Axis, Colour, Figure, Paint, Panel};

use super::super::ComparedMixture;
use super::super::report::{LabelledReport, ScoreReport};
use super::super::tables::CONTAMINATION;
use crate::csv::{Csv, number};
use crate::output::decimals;
use crate::page::style::{WIDTH, row};
use crate::page::{FigureContent, FigureEntry};

/// Height of the panels, points.
const HEIGHT: f64 = 150.0;

/// The columns (K of each element) and the rows (D), and their labels.
pub struct MixturePlaces {
    columns: Vec<Vec<usize>>,
    components: Vec<String>,
    /// Ascending.
    pub rows: Vec<usize>,
    dimensions: Vec<String>,
}

impl MixturePlaces {
    /// Of all mixtures. Columns ascend by the largest K, then by the smallest.
    pub fn new(mixtures: &[ComparedMixture]) -> Self {
        let key = |mixture: &ComparedMixture| {
            let components = &mixture.components;
            (components.iter().max().copied(), components.iter().min().copied(), components.clone())
        };
        let mut found: Vec<_> = mixtures.iter().map(|mixture| (key(mixture), mixture.range())).collect();
        found.sort();
        found.dedup();
        let (columns, components) =
            found.into_iter().map(|((_, _, components), range)| (components, range)).unzip();
        let mut rows: Vec<_> = mixtures.iter().map(|mixture| mixture.dimension).collect();
        rows.sort_unstable();
        rows.dedup();
        let dimensions = rows.iter().map(ToString::to_string).collect();
        Self { columns, components, rows, dimensions }
    }

    /// Column and row of a mixture.
    pub fn position(&self, mixture: &ComparedMixture) -> Option<(usize, usize)> {
        let column = self.columns.iter().position(|components| *components == mixture.components)?;
        Some((column, self.rows.iter().position(|dimension| *dimension == mixture.dimension)?))
    }
}

/// `report` is that of any of the mixtures. `None` with fewer than two mixtures, or without force labels.
pub fn draw(mixtures: &[ComparedMixture], report: &LabelledReport) -> Option<FigureEntry> {
    if mixtures.len() < 2 || report.atoms == 0 {
        return None;
    }
    let drawn = draw_map(mixtures, report);
    Some(FigureEntry {
        name: "mixture-map".into(),
        title: "Contamination by dimension and components",
        drawn,
    })
}

fn draw_map(mixtures: &[ComparedMixture], report: &LabelledReport) -> Result<FigureContent, String> {
    let mut cells: Vec<_> = mixtures.iter().map(|mixture| (mixture.dimension, &mixture.components)).collect();
    cells.sort();
    cells.dedup();
    if cells.len() < mixtures.len() {
        return Err(
            "Two mixtures have the same dimension and the same number of components of each element.".into(),
        );
    }
    let places = MixturePlaces::new(mixtures);
    let description = "Contamination of the confident set by dimension and components of the mixture";
    let mut figure = Figure::new("mixture-map", description, WIDTH, HEIGHT + 64.0);
    let mut numbers = Csv::new(&["score", "dimension", "components", "contamination", "retention"]);
    let unfiltered = report.threshold(CONTAMINATION).and_then(|k| report.unfiltered[k]);
    for (k, place) in row(2, [46.0, 60.0, 8.0], 26.0, HEIGHT).into_iter().enumerate() {
        let Some(score) = report.scores.get(k).filter(|score| score.limit.is_some()) else { continue };
        figure.text([place.x, place.y - 8.0], &format!("{} ≤ 1", score.name), Anchor::Start);
        let mut panel = Panel::new(
            place,
            Axis::categorical("components K", &places.components),
            Axis::categorical("dimension D", &places.dimensions),
        );
        for mixture in mixtures {
            let Some(score) = mixture.scores.get(k) else { continue };
            let found = values(score, report);
            draw_cell(&mut panel, &places, mixture, found, unfiltered);
            let head = [::figures::plain(&score.name), mixture.dimension.to_string(), mixture.range()];
            numbers.push(&[&head[..], &found.map(number)].concat());
        }
        panel.panel_letter(char::from(b'a' + k as u8));
        panel.draw(&mut figure);
    }
    let caption = format!(
        "Large, share of the atoms within the limit that have a force error above {CONTAMINATION} eV Å^{{−1}} (%); small, share of all atoms that \
         the limit keeps (%). Colour, the large number, from white at 0 to red at the share of all atoms, {} %.",
        decimals(unfiltered.map(|share| 100.0 * share), 2)
    );
    Ok(FigureContent { figure, caption, numbers })
}

/// Contamination and retention.
fn values(score: &ScoreReport, report: &LabelledReport) -> [Option<f64>; 2] {
    let Some(confident) = &score.confident else { return [None; 2] };
    let contamination = report.threshold(CONTAMINATION).and_then(|k| confident.contamination[k].value);
    [contamination, confident.retention.value]
}

fn draw_cell(
    panel: &mut Panel,
    places: &MixturePlaces,
    mixture: &ComparedMixture,
    [contamination, retention]: [Option<f64>; 2],
    unfiltered: Option<f64>,
) {
    let Some((x, y)) = places.position(mixture).map(|(x, y)| (x as f64, y as f64)) else { return };
    let share = contamination.zip(unfiltered.filter(|all| *all > 0.0)).map_or(0.0, |(of, all)| of / all);
    let paint: Paint = Colour::VERMILLION.faint(0.8 * share.clamp(0.0, 1.0));
    panel.bar([x, y], [x + 1.0, y + 1.0], paint);
    let percent = |share: Option<f64>, digits| decimals(share.map(|share| 100.0 * share), digits);
    let middle = [x + 0.5, y + 0.5];
    panel.text(middle, [0.0, 0.0], &percent(contamination, 2), Anchor::Middle).bold = true;
    panel.text(middle, [0.0, 10.0], &percent(retention, 1), Anchor::Middle);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The range of K does not tell mixtures apart.
    #[test]
    fn columns_are_the_components_of_each_element() {
        let mixture = |dimension, components: &[usize]| ComparedMixture {
            artifact: "a.npz".into(),
            dimension,
            components: components.to_vec(),
            scores: Vec::new(),
        };
        let mixtures = [mixture(8, &[8, 4]), mixture(4, &[8, 2]), mixture(8, &[4, 8]), mixture(8, &[16, 1])];
        let places = MixturePlaces::new(&mixtures);
        assert_eq!(places.components, ["2–8", "4–8", "4–8", "1–16"]);
        let found = mixtures.each_ref().map(|mixture| places.position(mixture));
        assert_eq!(found, [Some((2, 1)), Some((0, 0)), Some((1, 1)), Some((3, 1))]);
    }
}
