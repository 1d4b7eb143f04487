//! Learning curves.

use ::upfit::{EpochRecord, SetErrors};
use figures::{Axis, AxisScale, Colour, Figure, LegendKey, Marker, Panel, Point, legend};

use crate::page::style::{WIDTH, axis, row};

const HEIGHT: f64 = 190.0;
const TRAINING: Colour = Colour::BLUE;
const VALIDATION: Colour = Colour::VERMILLION;

/// One of the errors of a set.
type ErrorOfSet = fn(&SetErrors) -> f64;

/// Titles and values of the panels.
const QUANTITIES: [(&str, ErrorOfSet); 3] = [
    ("loss", |errors| errors.loss),
    ("energy RMSE (meV per atom)", |errors| 1e3 * errors.energy_rmse),
    ("force RMSE (meV Å^{−1})", |errors| 1e3 * errors.force_rmse),
];

/// Loss and errors of both sets by epoch.
pub fn learning_curves(history: &[EpochRecord]) -> Figure {
    let mut figure = Figure::new("learning-curves", "Loss and errors by epoch", WIDTH, HEIGHT);
    let areas = row(QUANTITIES.len(), [48.0, 54.0, 8.0], 26.0, 120.0);
    for ((area, (title, value)), letter) in areas.into_iter().zip(QUANTITIES).zip('a'..) {
        let point =
            |record: &EpochRecord, errors: &SetErrors| -> Point { [record.epoch as f64, value(errors)] };
        let training: Vec<_> = history.iter().map(|record| point(record, &record.errors.training)).collect();
        let validation = history
            .iter()
            .filter_map(|record| record.errors.validation.as_ref().map(|errors| point(record, errors)));
        let validation: Vec<_> = validation.collect();
        let values: Vec<_> = training.iter().chain(&validation).map(|point| point[1]).collect();
        let x = Axis::new("epoch", AxisScale::Linear, 0.0, history.len().max(1) as f64);
        let mut panel = Panel::new(area, x, axis(title, AxisScale::Logarithmic, &values, None));
        for (points, colour) in [(training, TRAINING), (validation, VALIDATION)] {
            if points.len() == 1 {
                panel.dots(points, Marker::Disc, 1.5, colour, None);
            } else {
                panel.line(points, colour.line(1.2));
            }
        }
        panel.panel_letter(letter);
        panel.draw(&mut figure);
    }
    let keys = [
        (LegendKey::Line(TRAINING.line(1.2)), "training, during the epoch"),
        (LegendKey::Line(VALIDATION.line(1.2)), "validation, after it"),
    ];
    legend(&mut figure, [WIDTH - 8.0, 12.0], &keys);
    figure
}

#[cfg(test)]
mod tests {
    use ::upfit::ErrorsBySet;
    use figures::to_svg;

    use super::*;

    #[test]
    fn any_history_can_be_drawn() {
        let errors = |loss| SetErrors {
            structures: 3,
            loss,
            energy_mae: 0.1,
            energy_rmse: 0.2,
            force_mae: 0.1,
            force_rmse: 0.0,
            stress_mae: None,
            stress_rmse: None,
        };
        let record = |epoch, validation: bool| EpochRecord {
            epoch,
            stage: 0,
            learning_rate: 1e-3,
            errors: ErrorsBySet {
                training: errors(1.0 / epoch as f64),
                validation: validation.then(|| errors(2.0)),
            },
            updates_per_second: 7.0,
        };
        let histories = [vec![], vec![record(1, true)], (1..30).map(|k| record(k, k % 2 == 0)).collect()];
        for history in histories {
            let svg = to_svg(&learning_curves(&history));
            assert!(svg.contains("epoch") && !svg.contains("NaN"), "{svg}");
        }
    }
}
