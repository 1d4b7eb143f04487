//! The loss of the demonstration on its structures, with derivatives.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, read_extxyz};
use potentials::grace::{Grace, LossGradient, TrainableGrace};
use upfit::{LabelledFrame, LossSettings, LossWeights};

/// δ of the Huber functions.
const DELTA: f64 = 0.01;
/// Weights of energies per atom, force components and stress components.
const WEIGHTS: [f64; 3] = [20.0, 100.0, 20.0];
/// Components of a symmetric matrix.
const COMPONENTS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)];
const TEST_SETS: [&str; 5] = ["cold", "hot", "liquid", "surface", "vacancy"];

struct Frame {
    labels: LabelledFrame,
    neighbours: NeighbourList,
}

/// A model with its training and test structures.
pub struct Objective {
    /// With the weights before the training, between trainings.
    pub model: TrainableGrace,
    begin: Vec<f64>,
    training: Vec<Frame>,
    /// By name: the frames of the model's own training data, then the test sets.
    tests: Vec<(&'static str, Vec<Frame>)>,
}

/// Numbers of energies, force and stress components of structures.
struct Counts([f64; 3]);

impl Objective {
    pub fn demonstration() -> Self {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data");
        let model = TrainableGrace::load(&data.join("al_eam_1l/kokkos.npz")).unwrap();
        let cutoff = model.model().cutoff();
        let read = |path: PathBuf| frames(&path, cutoff);
        let (mut training, mut tests) = (Vec::new(), Vec::new());
        let mut divide = |name, frames: Vec<Frame>, is_test: &dyn Fn(usize) -> bool| {
            let mut test = Vec::new();
            for (number, frame) in frames.into_iter().enumerate() {
                if is_test(number) { test.push(frame) } else { training.push(frame) }
            }
            tests.push((name, test));
        };
        divide("known", read(data.join("al_eam_1l/seed_frames.extxyz")), &|number| number % 5 == 0);
        for name in TEST_SETS {
            divide(name, read(data.join(format!("aluminium_tests/{name}.extxyz"))), &|number| number >= 3);
        }
        let begin = model.weights().to_vec();
        Self { model, begin, training, tests }
    }

    /// Those before the training.
    pub fn weights(&self) -> Vec<f64> {
        self.begin.clone()
    }

    /// Number of training structures.
    pub fn count(&self) -> usize {
        self.training.len()
    }

    /// The training structures.
    pub fn labelled(&self) -> Vec<LabelledFrame> {
        self.training.iter().map(|frame| frame.labels.clone()).collect()
    }

    /// The loss of these training structures, and its gradient.
    pub fn gradient(&mut self, weights: &[f64], batch: &[usize]) -> (f64, Vec<f64>) {
        self.model.set_weights(weights);
        let (mut sums, mut worker) = (self.model.sums(), self.model.worker());
        let counts = Counts::of(batch.iter().map(|&index| &self.training[index]));
        let mut loss = 0.0;
        for &index in batch {
            let frame = &self.training[index];
            let of_frame = |evaluation: &Evaluation| {
                let (value, gradient) = counts.loss(frame, evaluation);
                loss += value;
                gradient
            };
            worker.accumulate(&frame.labels.structure, &frame.neighbours, of_frame, &mut sums).unwrap();
        }
        (loss, self.model.gradient(&sums))
    }

    pub fn titles(&self) -> String {
        let sets = self.tests.iter().map(|(name, _)| format!("{name:>8}"));
        format!(
            "{:>9} {:>9} {}  (loss of training and test structures; force MAE, meV/Å)",
            "training",
            "test",
            sets.collect::<Vec<_>>().join(" ")
        )
    }

    /// Prints the errors of these weights.
    pub fn show(&mut self, name: &str, passes: u64, seconds: f64, weights: &[f64]) {
        self.model.set_weights(weights);
        let mut grace = Grace::new(Arc::new(self.model.model().clone()));
        let training = mean_errors(&mut grace, &self.training.iter().collect::<Vec<_>>()).0;
        let test =
            mean_errors(&mut grace, &self.tests.iter().flat_map(|(_, frames)| frames).collect::<Vec<_>>()).0;
        let sets = self.tests.iter().map(|(_, frames)| {
            format!("{:>8.2}", 1000.0 * mean_errors(&mut grace, &frames.iter().collect::<Vec<_>>()).1)
        });
        let sets = sets.collect::<Vec<_>>().join(" ");
        println!("{name:<20} {passes:>6} {seconds:>7.1}  {training:>9.5} {test:>9.5} {sets}");
        self.model.set_weights(&self.begin);
    }
}

impl Counts {
    fn of<'a>(frames: impl Iterator<Item = &'a Frame>) -> Self {
        let mut counts = [0.0; 3];
        for frame in frames {
            counts[0] += 1.0;
            counts[1] += 3.0 * frame.labels.structure.len() as f64;
            counts[2] += if frame.labels.stress.is_some() { 6.0 } else { 0.0 };
        }
        Self(counts.map(|count: f64| count.max(1.0)))
    }

    /// The part of a structure in the loss, and its derivatives with respect to energy, forces and virial.
    fn loss(&self, frame: &Frame, evaluation: &Evaluation) -> (f64, LossGradient) {
        let labels = &frame.labels;
        let [energy, force, stress] = std::array::from_fn(|k| WEIGHTS[k] / self.0[k]);
        let slope = |x: f64| x.clamp(-DELTA, DELTA);
        let atoms = labels.structure.len() as f64;
        let difference = (evaluation.energy() - labels.energy) / atoms;
        let mut loss = energy * huber(difference);
        let forces = evaluation.forces.iter().zip(&labels.forces).map(|(model, label)| {
            std::array::from_fn(|k| {
                loss += force * huber(model[k] - label[k]);
                force * slope(model[k] - label[k])
            })
        });
        let forces = forces.collect();
        let mut virial = [[0.0; 3]; 3];
        if let (Some(label), Some(model)) = (labels.stress, evaluation.stress(&labels.structure)) {
            let volume = labels.structure.cell.volume();
            for (i, k) in COMPONENTS {
                let difference = model[i][k] - label[i][k];
                loss += stress * huber(difference);
                let derivative = -0.5 * stress / volume * slope(difference);
                virial[i][k] += derivative;
                virial[k][i] += derivative;
            }
        }
        (loss, LossGradient { energy: energy * slope(difference) / atoms, forces, virial })
    }
}

/// The same for `upfit`.
pub fn loss() -> LossSettings {
    let mut loss = LossSettings::demo();
    let [energy, forces, stress] = WEIGHTS;
    loss.stages[0].weights = LossWeights { energy, forces, stress };
    LossSettings { delta: DELTA, ..loss }
}

fn huber(x: f64) -> f64 {
    let size = x.abs();
    if size <= DELTA { 0.5 * size * size } else { DELTA * (size - 0.5 * DELTA) }
}

fn frames(path: &Path, cutoff: f64) -> Vec<Frame> {
    let read = read_extxyz(path).unwrap();
    let labelled = read.into_iter().map(|frame| {
        let (labels, place) = (frame.labels().unwrap(), frame.line.to_string());
        let labels = LabelledFrame::new(place.clone(), place, frame.structure, labels, 1.0).unwrap();
        let mut neighbours = NeighbourList::new(cutoff, 0.0);
        neighbours.update(&labels.structure).unwrap();
        Frame { labels, neighbours }
    });
    labelled.collect()
}

/// The loss of structures as one batch, and the mean absolute error of their forces, eV/Å.
fn mean_errors(grace: &mut Grace, frames: &[&Frame]) -> (f64, f64) {
    let counts = Counts::of(frames.iter().copied());
    let (mut loss, mut forces) = (0.0, 0.0);
    let mut evaluation = Evaluation::default();
    for frame in frames {
        grace.evaluate(&frame.labels.structure, &frame.neighbours, &mut evaluation).unwrap();
        loss += counts.loss(frame, &evaluation).0;
        let pairs = evaluation.forces.as_flattened().iter().zip(frame.labels.forces.as_flattened());
        forces += pairs.map(|(model, label)| (model - label).abs()).sum::<f64>();
    }
    (loss, forces / counts.0[1])
}
