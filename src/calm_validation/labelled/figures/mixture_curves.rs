//! Contamination of what γ and γ_nbr up to 1 keep under several mixtures, in panels by dimension (the paper's contamination curves).

use ::figures::{Anchor, Axis, AxisScale, Colour, Figure, Panel, Rectangle, width};

use super::super::ComparedMixture;
use super::super::report::{Confident, IntervalEstimate, LabelledReport};
use super::curves::{draw_curve, level};
use super::mixture_map::MixturePlaces;
use super::stroke;
use crate::csv::{Csv, number};
use crate::page::style::{WIDTH, row};
use crate::page::{FigureContent, FigureEntry};

/// Height of a panel, of a row of panels with their titles, and of what is above the first row, points.
const PANEL: f64 = 124.0;
const ROW: f64 = 174.0;
const TOP: f64 = 22.0;
/// Most panels in a row.
const COLUMNS: usize = 4;
/// Scores with a row of panels: γ and γ_nbr.
const SCORES: usize = 2;
/// Size of the legend, and distance of its lines, points.
const SMALL: f64 = 7.0;
const LINE: f64 = 9.0;

/// What all panels are drawn from.
struct MixtureCurves<'a> {
    mixtures: &'a [ComparedMixture],
    report: &'a LabelledReport,
    places: MixturePlaces,
    /// Whether components tell the mixtures of each dimension apart.
    is_unique: bool,
}

/// `report` is that of any of the mixtures. `None` without mixtures or force labels.
pub fn draw(mixtures: &[ComparedMixture], report: &LabelledReport) -> Option<FigureEntry> {
    if mixtures.is_empty() || report.atoms == 0 {
        return None;
    }
    let curves = MixtureCurves::new(mixtures, report);
    let drawn =
        Ok(FigureContent { figure: curves.figure(), caption: curves.caption(), numbers: curves.numbers() });
    Some(FigureEntry {
        name: "mixture-contamination".into(),
        title: "Contamination under several mixtures",
        drawn,
    })
}

impl<'a> MixtureCurves<'a> {
    fn new(mixtures: &'a [ComparedMixture], report: &'a LabelledReport) -> Self {
        let places = MixturePlaces::new(mixtures);
        let mut found: Vec<_> = mixtures.iter().map(|mixture| places.position(mixture)).collect();
        found.sort_unstable();
        found.dedup();
        Self { mixtures, report, is_unique: found.len() == mixtures.len(), places }
    }

    /// A row of panels for each score, and further rows for more dimensions than fit.
    fn figure(&self) -> Figure {
        let description = "Contamination of the confident set under several mixtures";
        let blocks = self.places.rows.chunks(COLUMNS);
        let height = TOP + ROW * (SCORES * blocks.len()) as f64 - 4.0;
        let mut figure = Figure::new("mixture-contamination", description, WIDTH, height);
        let (columns, mut letters) = (self.places.rows.len().clamp(2, COLUMNS), 'a'..='z');
        for (block, dimensions) in blocks.enumerate() {
            for score in 0..SCORES {
                let top = TOP + ROW * (SCORES * block + score) as f64;
                for (dimension, place) in dimensions.iter().zip(row(columns, [46.0, 40.0, 8.0], top, PANEL)) {
                    let letter = letters.next().unwrap_or(' ');
                    self.draw_panel(&mut figure, (score, *dimension), place, letter);
                }
            }
        }
        figure
    }

    fn draw_panel(
        &self,
        figure: &mut Figure,
        (score, dimension): (usize, usize),
        place: Rectangle,
        letter: char,
    ) {
        let thresholds = &self.report.thresholds;
        let (low, high) = (thresholds[0], thresholds[thresholds.len() - 1]);
        let x = Axis::new("force error (eV Å^{−1})", AxisScale::Logarithmic, low, high).with_ticks(4);
        let y = Axis::new("probability of a larger error", AxisScale::Linear, 0.0, 1.0);
        let mut panel = Panel::new(place, x, y);
        panel.vertical_line(0.5);
        let all =
            self.report.unfiltered.iter().map(|value| IntervalEstimate { value: *value, interval: None });
        draw_curve(&mut panel, Colour::INK.dashed(1.1), thresholds, &all.collect::<Vec<_>>());
        let shown = self.mixtures.iter().enumerate().filter(|(_, mixture)| mixture.dimension == dimension);
        let mut legend = Vec::new();
        for (k, mixture) in shown {
            let Some(confident) = confident(mixture, score) else { continue };
            let stroke = stroke(self.stroke_number(k, mixture));
            draw_curve(&mut panel, stroke, thresholds, &confident.contamination);
            let kept =
                confident.retention.value.map_or(String::new(), |kept| format!(", {:.1} %", 100.0 * kept));
            legend.push((stroke, format!("{}: K = {}{kept}", k + 1, mixture.range())));
        }
        panel.panel_letter(letter);
        panel.draw(figure);
        if let Some(score) = self.report.scores.get(score) {
            let name = format!("{} ≤ 1, D = {dimension}", score.name);
            figure.text([place.x - 8.0, place.y - 6.0], &name, Anchor::Start);
        }
        for (line, (stroke, words)) in legend.into_iter().enumerate() {
            let (right, y) = (place.right() - 4.0, place.y + 10.0 + LINE * line as f64);
            figure.text([right, y], &words, Anchor::End).size = SMALL;
            let x = right - SMALL * width(&words, false) - 3.0;
            figure.line(vec![[x - 10.0, y - 2.5], [x, y - 2.5]], stroke);
        }
    }

    /// One colour for each number of components, or for each mixture if that does not tell them apart.
    fn stroke_number(&self, k: usize, mixture: &ComparedMixture) -> usize {
        let column = self.places.position(mixture).map(|(column, _)| column);
        column.filter(|_| self.is_unique).unwrap_or(k)
    }

    fn caption(&self) -> String {
        let files =
            self.mixtures.iter().enumerate().map(|(k, mixture)| format!("{}, {}", k + 1, mixture.artifact));
        format!(
            "Probability that an atom with γ or γ_{{nbr}} up to 1 has a force error above a threshold, under mixtures of dimension D with K \
             components of each element, with {} intervals; in the legends, the share of all atoms that are kept. Dashed, all {} atoms; \
             vertical line, 0.5 eV Å^{{−1}}. Mixtures: {}.",
            level(self.report),
            self.report.atoms,
            files.collect::<Vec<_>>().join("; ")
        )
    }

    fn numbers(&self) -> Csv {
        let titles = ["score", "mixture", "dimension", "components", "threshold", "value", "low", "high"];
        let mut numbers = Csv::new(&titles);
        let thresholds = &self.report.thresholds;
        for (threshold, value) in thresholds.iter().zip(&self.report.unfiltered) {
            let head = ["no filter", "", "", ""].map(str::to_owned);
            numbers.push(&[&head[..], &[Some(*threshold), *value, None, None].map(number)].concat());
        }
        for (k, score) in self.report.scores.iter().enumerate().take(SCORES) {
            for (place, mixture) in self.mixtures.iter().enumerate() {
                let Some(confident) = confident(mixture, k) else { continue };
                let name = ::figures::plain(&score.name);
                let head = [name, (place + 1).to_string(), mixture.dimension.to_string(), mixture.range()];
                for (threshold, estimate) in thresholds.iter().zip(&confident.contamination) {
                    let (low, high) = estimate.interval.unzip();
                    let cells = [Some(*threshold), estimate.value, low, high].map(number);
                    numbers.push(&[&head[..], &cells].concat());
                }
            }
        }
        numbers
    }
}

/// What the limit of a score keeps under a mixture.
fn confident(mixture: &ComparedMixture, score: usize) -> Option<&Confident> {
    mixture.scores.get(score)?.confident.as_ref()
}
