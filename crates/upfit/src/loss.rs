//! The loss: means of Huber functions (Huber, Ann. Math. Stat. 35, 73 (1964)) of the errors of energies per atom, force
//! components and stress components.

use atoms::{Evaluation, Vec3};
use potentials::grace::LossGradient;

use crate::data::LabelledFrame;

/// The six components of a symmetric matrix.
pub const STRESS_COMPONENTS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)];

/// δ of the demonstration and the paper's programs, in the unit of each quantity (eV, eV/Å, eV/Å³).
const DELTA: f64 = 0.01;

/// Weights of the three means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Of the energies per atom.
    pub energy: f64,
    /// Of the force components.
    pub forces: f64,
    /// Of the stress components.
    pub stress: f64,
}

/// Weights from one epoch on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossStage {
    /// Share of the epochs after which they hold, from 0.
    pub begins: f64,
    /// The weights.
    pub weights: LossWeights,
}

/// The loss of a training.
#[derive(Clone, Debug, PartialEq)]
pub struct LossSettings {
    /// By ascending share of the epochs; the first begins at 0.
    pub stages: Vec<LossStage>,
    /// δ of the Huber functions, in the unit of each quantity: errors above it count linearly.
    pub delta: f64,
}

impl LossSettings {
    /// The loss with which the demonstration's models were trained: weights 20, 5 and 20.
    pub fn demo() -> Self {
        let weights = LossWeights { energy: 20.0, forces: 5.0, stress: 20.0 };
        Self { stages: vec![LossStage { begins: 0.0, weights }], delta: DELTA }
    }

    /// The loss of the paper's controlled tests: weights 1, 5 and 0.1, and after 250 of 600 epochs 25, 1 and 0.1.
    pub fn paper() -> Self {
        let stage = |begins, energy, forces| LossStage {
            begins,
            weights: LossWeights { energy, forces, stress: 0.1 },
        };
        Self { stages: vec![stage(0.0, 1.0, 5.0), stage(250.0 / 600.0, 25.0, 1.0)], delta: DELTA }
    }

    /// Index of the stage of epoch number `epoch` (from 0) of `epochs`.
    pub(crate) fn stage(&self, epoch: u64, epochs: u64) -> usize {
        // Rounding must not move a stage by an epoch.
        let begun = |stage: &LossStage| stage.begins * epochs as f64 <= epoch as f64 + 1e-6;
        self.stages.iter().rposition(begun).unwrap_or(0)
    }

    /// Index of the first stage that none of `epochs` epochs belongs to.
    pub(crate) fn empty_stage(&self, epochs: u64) -> Option<usize> {
        let all = epochs as f64;
        // As in [`LossSettings::stage`].
        let first = |stage: &LossStage| (stage.begins * all - 1e-6).ceil();
        let ends = self.stages.iter().skip(1).map(first).chain([all]);
        self.stages.iter().map(first).zip(ends).position(|(begin, end)| begin >= end)
    }
}

/// Number of terms in each mean of a batch, at least 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BatchCounts {
    energies: f64,
    forces: f64,
    stresses: f64,
}

impl BatchCounts {
    /// Those of these structures.
    pub fn new<'a>(frames: impl Iterator<Item = &'a LabelledFrame>) -> Self {
        let (mut energies, mut forces, mut stresses) = (0, 0, 0);
        for frame in frames {
            energies += 1;
            forces += 3 * frame.structure.len();
            stresses += if frame.stress.is_some() { STRESS_COMPONENTS.len() } else { 0 };
        }
        let count = |number: usize| number.max(1) as f64;
        Self { energies: count(energies), forces: count(forces), stresses: count(stresses) }
    }
}

/// ½ x² up to |x| = δ, and δ (|x| − ½ δ) beyond.
pub fn huber(x: f64, delta: f64) -> f64 {
    let size = x.abs();
    if size <= delta { 0.5 * size * size } else { delta * (size - 0.5 * delta) }
}

/// The derivative of the loss of a batch with respect to energy, forces and virial of one of its structures.
pub fn loss_gradient(
    frame: &LabelledFrame,
    evaluation: &Evaluation,
    delta: f64,
    weights: &LossWeights,
    counts: &BatchCounts,
) -> LossGradient {
    let slope = |difference: f64| frame.weight * difference.clamp(-delta, delta);
    let atoms = frame.structure.len() as f64;
    let energy =
        weights.energy / counts.energies * slope((evaluation.energy() - frame.energy) / atoms) / atoms;
    let of_forces = weights.forces / counts.forces;
    let pairs = evaluation.forces.iter().zip(&frame.forces);
    let force = |(model, label): (&Vec3, &Vec3)| -> Vec3 {
        std::array::from_fn(|k| of_forces * slope(model[k] - label[k]))
    };
    let mut virial = [[0.0; 3]; 3];
    if let (Some(label), Some(model)) = (frame.stress, evaluation.stress(&frame.structure)) {
        // σ = −W / V; each component off the diagonal stands for two numbers of W.
        let of_stress = -weights.stress / counts.stresses / frame.structure.cell.volume();
        for (i, k) in STRESS_COMPONENTS {
            let derivative = of_stress * slope(model[i][k] - label[i][k]);
            virial[i][k] += 0.5 * derivative;
            virial[k][i] += 0.5 * derivative;
        }
    }
    LossGradient { energy, forces: pairs.map(force).collect(), virial }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::differences::FrameDifferences;
    use crate::test_frames::aluminium;

    #[test]
    fn the_huber_function_is_smooth_where_it_becomes_linear() {
        assert_eq!([0.0, 0.5, -1.0, 2.0, -3.0].map(|x| huber(x, 1.0)), [0.0, 0.125, 0.5, 1.5, 2.5]);
        let slope = |x: f64| (huber(x + 1e-6, 0.3) - huber(x - 1e-6, 0.3)) / 2e-6;
        for x in [-1.0, -0.3, -0.1, 0.0, 0.2, 0.3, 4.0] {
            assert!((slope(x) - x.clamp(-0.3, 0.3)).abs() < 1e-6, "{x}");
        }
    }

    #[test]
    fn stages_begin_at_their_share_of_the_epochs() {
        let paper = LossSettings::paper();
        let stages = [0, 249, 250, 599].map(|epoch| paper.stage(epoch, 600));
        assert_eq!(stages, [0, 0, 1, 1]);
        assert_eq!([0, 4, 5].map(|epoch| paper.stage(epoch, 12)), [0, 0, 1]);
        assert_eq!(LossSettings::demo().stage(7, 8), 0);
    }

    #[test]
    fn a_stage_without_epochs_is_found() {
        let paper = LossSettings::paper();
        for epochs in 1..50 {
            let used: Vec<_> = (0..epochs).map(|epoch| paper.stage(epoch, epochs)).collect();
            let empty = (0..2).find(|stage| !used.contains(stage));
            assert_eq!(paper.empty_stage(epochs), empty, "{epochs}");
        }
        assert_eq!(paper.empty_stage(1), Some(1));
        assert_eq!((paper.empty_stage(0), paper.empty_stage(u64::MAX)), (Some(0), None));
        let with = |begins: &[f64]| {
            let stage = |begins: &f64| LossStage { begins: *begins, ..paper.stages[0] };
            LossSettings { stages: begins.iter().map(stage).collect(), delta: 0.01 }.empty_stage(100)
        };
        assert_eq!([with(&[0.0, 0.5]), with(&[0.0, 0.5, 0.5]), with(&[0.0, 1.0])], [None, Some(1), Some(1)]);
    }

    /// A model's result that differs from the labels by about δ, in both directions.
    fn evaluation(frame: &LabelledFrame) -> Evaluation {
        let n = frame.structure.len();
        let wave = |k: usize| 0.02 * (k as f64 * 1.7).sin();
        let mut found = Evaluation::default();
        found.reset(n);
        found.atomic_energies.fill(frame.energy / n as f64 + 0.004);
        let components = found.forces.as_flattened_mut().iter_mut().zip(frame.forces.as_flattened());
        components.enumerate().for_each(|(k, (force, label))| *force = label + wave(k));
        let (stress, volume) = (frame.stress.unwrap(), frame.structure.cell.volume());
        for (i, k) in STRESS_COMPONENTS {
            let w = -volume * (stress[i][k] + wave(i + 3 * k + 5));
            (found.virial[i][k], found.virial[k][i]) = (w, w);
        }
        found
    }

    /// The loss of two structures, of which the second is changed.
    fn loss(frames: &[LabelledFrame], evaluations: &[Evaluation], weights: &LossWeights) -> f64 {
        let mut sums = FrameDifferences::default();
        for (frame, evaluation) in frames.iter().zip(evaluations) {
            sums.merge(&FrameDifferences::new(frame, evaluation, 0.01));
        }
        sums.loss(weights)
    }

    #[test]
    fn the_gradient_is_that_of_finite_differences() {
        let mut frames = aluminium(2);
        frames[1].weight = 0.7;
        let evaluations: Vec<_> = frames.iter().map(evaluation).collect();
        let weights = LossWeights { energy: 3.0, forces: 5.0, stress: 7.0 };
        let counts = BatchCounts::new(frames.iter());
        let gradient = loss_gradient(&frames[1], &evaluations[1], 0.01, &weights, &counts);
        let difference = |step: f64, change: &dyn Fn(&mut Evaluation, f64)| {
            let at = |step: f64| {
                let mut changed = evaluations.clone();
                change(&mut changed[1], step);
                loss(&frames, &changed, &weights)
            };
            (at(step) - at(-step)) / (2.0 * step)
        };
        let assert_near = |found: f64, expected: f64, scale: f64| {
            assert!((found - expected).abs() < 1e-5 * scale, "{found} {expected}");
        };
        let energy = difference(1e-5, &|changed: &mut Evaluation, step| changed.atomic_energies[0] += step);
        assert_near(gradient.energy, energy, energy.abs());
        let largest = gradient.forces.as_flattened().iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
        for (atom, k) in [(0, 0), (17, 1), (50, 2), (107, 2)] {
            let expected =
                difference(1e-6, &|changed: &mut Evaluation, step| changed.forces[atom][k] += step);
            assert_near(gradient.forces[atom][k], expected, largest);
        }
        for (i, k) in STRESS_COMPONENTS {
            // A strain changes both numbers of a symmetric matrix.
            let expected = difference(1e-3, &|changed: &mut Evaluation, step| {
                changed.virial[i][k] += step;
                if i != k {
                    changed.virial[k][i] += step;
                }
            });
            let found = if i == k { gradient.virial[i][k] } else { 2.0 * gradient.virial[i][k] };
            assert_near(found, expected, expected.abs());
            assert_eq!(gradient.virial[i][k], gradient.virial[k][i]);
        }
    }

    #[test]
    fn a_structure_without_stress_has_no_term_of_it() {
        let mut frames = aluminium(2);
        frames[0].stress = None;
        let evaluations: Vec<_> = aluminium(2).iter().map(evaluation).collect();
        let weights = LossWeights { energy: 0.0, forces: 0.0, stress: 1.0 };
        let counts = BatchCounts::new(frames.iter());
        let [without, with] =
            [0, 1].map(|k| loss_gradient(&frames[k], &evaluations[k], 0.01, &weights, &counts));
        assert_eq!(without.virial, [[0.0; 3]; 3]);
        assert_ne!(with.virial, [[0.0; 3]; 3]);
        // Its mean is over the structures that have a stress.
        assert_eq!(loss(&frames, &evaluations, &weights), loss(&frames[1..], &evaluations[1..], &weights));
    }
}
