//! Learning curves.

use ::upfit::{EpochRecord, SetErrors};
use figures::{Axis, AxisScale, Colour, Figure, LegendKey, Marker, Panel, Point, Rectangle, legend};

use crate::page::style::{WIDTH, axis, row};

/// Panels side by side.
const COLUMNS: usize = 3;
/// Top of the first row, height of an area, and distance between rows, points.
const TOP: f64 = 26.0;
const AREA: f64 = 120.0;
const PITCH: f64 = 170.0;
const TRAINING: Colour = Colour::BLUE;
const VALIDATION: Colour = Colour::VERMILLION;

/// One of the errors of a set; `None` without labels of that kind.
type ErrorOfSet = fn(&SetErrors) -> Option<f64>;

/// Titles and values of the panels with a curve for each set.
const QUANTITIES: [(&str, ErrorOfSet); 4] = [
    ("loss", |errors| Some(errors.loss)),
    ("energy MAE (eV per atom)", |errors| Some(errors.energy_mae)),
    ("force MAE (eV Å^{−1})", |errors| Some(errors.force_mae)),
    ("stress MAE (eV Å^{−3})", |errors| errors.stress_mae),
];

/// One panel: values by epoch, of each set or of the training as a whole.
struct CurvePanel {
    title: &'static str,
    scale: AxisScale,
    curves: Vec<(Vec<Point>, Colour)>,
}

/// Loss and mean absolute errors of both sets, and the learning rate, by epoch. Without labelled stresses, there is no panel of them.
pub fn learning_curves(history: &[EpochRecord]) -> Figure {
    let panels: Vec<_> = QUANTITIES.iter().filter_map(|quantity| of_sets(history, *quantity)).collect();
    let panels: Vec<_> = panels.into_iter().chain([learning_rates(history)]).collect();
    let rows = panels.len().div_ceil(COLUMNS) as f64;
    let height = TOP + PITCH * (rows - 1.0) + AREA + 44.0;
    let mut figure = Figure::new("learning-curves", "Loss and errors by epoch", WIDTH, height);
    let tops = (0_i32..).map(|number| TOP + PITCH * f64::from(number));
    let areas = tops.flat_map(|top| row(COLUMNS, [48.0, 54.0, 8.0], top, AREA));
    for ((panel, area), letter) in panels.into_iter().zip(areas).zip('a'..) {
        panel.draw(&mut figure, area, letter, history.len());
    }
    let mut keys = vec![(LegendKey::Line(TRAINING.line(1.2)), "training, during the epoch")];
    if history.iter().any(|record| record.errors.validation.is_some()) {
        keys.push((LegendKey::Line(VALIDATION.line(1.2)), "validation, after it"));
    }
    legend(&mut figure, [WIDTH - 8.0, 12.0], &keys);
    figure
}

/// `None` if no epoch has the quantity; without epochs, an empty panel for those that are always there.
fn of_sets(history: &[EpochRecord], (title, value): (&'static str, ErrorOfSet)) -> Option<CurvePanel> {
    let point = |record: &EpochRecord, errors: &SetErrors| -> Option<Point> {
        Some([record.epoch as f64, value(errors)?])
    };
    let training: Vec<_> =
        history.iter().filter_map(|record| point(record, &record.errors.training)).collect();
    let validated = history.iter().filter_map(|record| Some((record, record.errors.validation.as_ref()?)));
    let validation: Vec<_> = validated.filter_map(|(record, errors)| point(record, errors)).collect();
    let is_unlabelled = !history.is_empty() && training.is_empty() && validation.is_empty();
    let curves = vec![(training, TRAINING), (validation, VALIDATION)];
    (!is_unlabelled).then_some(CurvePanel { title, scale: AxisScale::Logarithmic, curves })
}

fn learning_rates(history: &[EpochRecord]) -> CurvePanel {
    let rates = history.iter().map(|record| [record.epoch as f64, record.learning_rate]).collect();
    CurvePanel { title: "learning rate", scale: AxisScale::Linear, curves: vec![(rates, Colour::INK)] }
}

impl CurvePanel {
    fn draw(self, figure: &mut Figure, area: Rectangle, letter: char, epochs: usize) {
        let values: Vec<_> =
            self.curves.iter().flat_map(|(points, _)| points.iter().map(|point| point[1])).collect();
        let must = (self.scale == AxisScale::Linear).then_some(0.0);
        let x = Axis::new("epoch", AxisScale::Linear, 0.0, epochs.max(1) as f64);
        let mut panel = Panel::new(area, x, axis(self.title, self.scale, &values, must));
        for (points, colour) in self.curves {
            if points.len() == 1 {
                panel.dots(points, Marker::Disc, 1.5, colour, None);
            } else {
                panel.line(points, colour.line(1.2));
            }
        }
        panel.panel_letter(letter);
        panel.draw(figure);
    }
}

#[cfg(test)]
mod tests {
    use ::upfit::ErrorsBySet;
    use figures::to_svg;

    use super::*;

    fn errors(loss: f64, stress_mae: Option<f64>) -> SetErrors {
        SetErrors {
            structures: 3,
            loss,
            energy_mae: 0.1,
            energy_rmse: 0.2,
            force_mae: 0.0,
            force_rmse: 0.0,
            stress_mae,
            stress_rmse: stress_mae,
        }
    }

    fn record(epoch: u64, validation: Option<SetErrors>) -> EpochRecord {
        let training = errors(1.0 / epoch as f64, None);
        EpochRecord {
            epoch,
            stage: 0,
            learning_rate: if epoch < 29 { 1e-3 } else { 0.0 },
            errors: ErrorsBySet { training, validation },
            updates_per_second: 7.0,
        }
    }

    #[test]
    fn any_history_can_be_drawn() {
        let validated = |epoch: u64| epoch.is_multiple_of(2).then(|| errors(2.0, None));
        let histories = [
            vec![],
            vec![record(1, validated(2))],
            (1..30).map(|epoch| record(epoch, validated(epoch))).collect(),
        ];
        for history in histories {
            let svg = to_svg(&learning_curves(&history));
            for expected in ["epoch", "loss", "energy MAE (eV per atom)", "force MAE (eV", "learning rate"] {
                assert!(svg.contains(expected) && !svg.contains("NaN"), "{svg}");
            }
        }
    }

    #[test]
    fn the_legend_has_validation_only_if_there_is_any() {
        let svg = |validation| to_svg(&learning_curves(&[record(1, validation)]));
        assert!(svg(Some(errors(2.0, None))).contains("validation"));
        assert!(!svg(None).contains("validation"));
    }

    #[test]
    fn labelled_stresses_have_a_panel() {
        let svg = |stress_mae| to_svg(&learning_curves(&[record(1, Some(errors(2.0, stress_mae)))]));
        assert!(svg(Some(1e-3)).contains("stress MAE (eV") && !svg(None).contains("stress MAE"));
    }
}
