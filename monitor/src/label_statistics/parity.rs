//! Energies, forces and stresses of the potential beside those of labels, with their mean errors.

use analysis::SystematicSample;
use serde::{Serialize, Serializer};
use store::LabelledCandidate;

use super::frames::stress_components;

/// Largest number of points kept of each quantity.
pub const MAX_POINTS: usize = 2000;

/// The three quantities, of structures from walks with one version of the potential.
#[derive(Clone, Debug, Serialize)]
pub struct Parity {
    /// Energy per atom without the offsets of the elements, eV, in the zero of the potential.
    pub energy: ParityErrors,
    /// Components of forces, eV/Å.
    pub force: ParityErrors,
    /// The six components of the stress, eV/Å³; only of structures that are periodic in three directions.
    pub stress: ParityErrors,
}

/// Errors of one quantity, and a sample of its values.
#[derive(Clone, Debug, Serialize)]
pub struct ParityErrors {
    #[serde(flatten)]
    sums: ErrorSums,
    #[serde(serialize_with = "kept")]
    points: SystematicSample<ParityPoint>,
}

/// A value of the potential with that of the label.
#[derive(Clone, Debug, Serialize)]
pub struct ParityPoint {
    /// By the label.
    pub label: f64,
    /// By the potential.
    pub model: f64,
    /// Name of the candidate.
    pub id: String,
    /// `biased` or `control`.
    pub origin: &'static str,
}

/// Sums over all values, also those that are not kept as points.
#[derive(Clone, Copy, Debug, Default)]
struct ErrorSums {
    number: u64,
    absolute: f64,
    squared: f64,
}

impl Parity {
    /// Nothing yet.
    pub(super) fn new() -> Self {
        let none = || ParityErrors { sums: ErrorSums::default(), points: SystematicSample::new(MAX_POINTS) };
        Self { energy: none(), force: none(), stress: none() }
    }

    /// Adds a labelled candidate. `energy_error` is E_model − E_label per atom without the offsets, eV; `None` if it is not known.
    pub fn add(&mut self, row: &LabelledCandidate, energy_error: Option<f64>) {
        let view = row.block.view();
        let (id, origin) = (view.id(), view.origin().name());
        let point = |label: f64, model: f64| ParityPoint { label, model, id: id.to_string(), origin };
        if let Some(error) = energy_error {
            let model = view.energy() / row.structure.len() as f64;
            self.energy.add(error, || point(model - error, model));
        }
        for (model, label) in view.forces.iter().flatten().zip(row.label.forces.iter().flatten()) {
            self.force.add(model - label, || point(*label, *model));
        }
        let stress =
            row.label.stress.and_then(|label| stress_components(&row.structure, view.virial(), label));
        for [model, label] in stress.into_iter().flatten() {
            self.stress.add(model - label, || point(label, model));
        }
    }
}

impl ParityErrors {
    fn add(&mut self, error: f64, point: impl FnOnce() -> ParityPoint) {
        if error.is_finite() {
            self.sums.number += 1;
            self.sums.absolute += error.abs();
            self.sums.squared += error * error;
            self.points.add_with(point);
        }
    }

    /// Number of values.
    pub fn number(&self) -> u64 {
        self.sums.number
    }

    /// Mean absolute error; `None` without values.
    pub fn mae(&self) -> Option<f64> {
        self.sums.mae()
    }

    /// Root mean square error; `None` without values.
    pub fn rmse(&self) -> Option<f64> {
        self.sums.rmse()
    }

    /// The values that are kept.
    pub fn points(&self) -> impl ExactSizeIterator<Item = &ParityPoint> {
        self.points.items()
    }
}

impl ErrorSums {
    fn mae(&self) -> Option<f64> {
        (self.number > 0).then(|| self.absolute / self.number as f64)
    }

    fn rmse(&self) -> Option<f64> {
        (self.number > 0).then(|| (self.squared / self.number as f64).sqrt())
    }
}

impl Serialize for ErrorSums {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        #[derive(Serialize)]
        struct Shown {
            number: u64,
            mae: Option<f64>,
            rmse: Option<f64>,
        }
        Shown { number: self.number, mae: self.mae(), rmse: self.rmse() }.serialize(serializer)
    }
}

fn kept<S: Serializer>(points: &SystematicSample<ParityPoint>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(points.items())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_of_all_values_and_points_are_bounded() {
        let Parity { mut energy, .. } = Parity::new();
        assert_eq!((energy.mae(), energy.rmse()), (None, None));
        // Errors 3 and −4 in turn, and one that is not a number.
        for k in 0..9000 {
            let error = if k % 2 == 0 { 3.0 } else { -4.0 };
            energy.add(error, || ParityPoint {
                label: 0.0,
                model: error,
                id: String::new(),
                origin: "biased",
            });
        }
        energy.add(f64::NAN, || panic!("left out"));
        assert_eq!((energy.number(), energy.mae()), (9000, Some(3.5)));
        assert!((energy.rmse().unwrap() - 12.5_f64.sqrt()).abs() < 1e-12);
        assert!((500..=MAX_POINTS).contains(&energy.points().len()));
        let json = serde_json::to_value(&energy).unwrap();
        assert_eq!((&json["number"], &json["mae"]), (&9000.into(), &3.5.into()));
        assert_eq!(json["points"].as_array().unwrap().len(), energy.points().len());
    }
}
