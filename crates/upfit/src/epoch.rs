//! The gradient of one batch, over threads.

use potentials::grace::{GradientWorker, TrainableGrace, WeightSums};

use crate::data::FrameFault;
use crate::differences::FrameDifferences;
use crate::error::UpfitError;
use crate::loss::{BatchCounts, LossWeights, loss_gradient};
use crate::parallel::for_each;
use crate::prepared::PreparedFrame;

/// The sums of one frame of a batch; the next batch uses them again.
pub struct BatchSlot {
    frame: usize,
    sums: WeightSums,
    outcome: Result<FrameDifferences, FrameFault>,
}

/// The loss of a batch: δ, and the weights of its stage.
#[derive(Clone, Copy, Debug)]
pub struct BatchLoss {
    /// δ of the Huber functions.
    pub delta: f64,
    /// Weights of the means.
    pub weights: LossWeights,
}

/// What a batch gives.
pub struct BatchGradient {
    /// Between the model before the update and the labels.
    pub differences: FrameDifferences,
    /// Of the loss with respect to all weights.
    pub gradient: Vec<f64>,
    /// Indices of the frames whose differences are not finite.
    pub not_finite: Vec<usize>,
}

/// The gradient of the loss of `batch`, indices of `frames`. Each frame has sums of its own, which are added in the order of
/// the batch, so that the result does not depend on the number of threads.
///
/// # Errors
/// A frame that the model cannot evaluate.
pub fn batch_gradient(
    model: &TrainableGrace,
    frames: &[PreparedFrame<'_>],
    batch: &[usize],
    slots: &mut Vec<BatchSlot>,
    loss: &BatchLoss,
    threads: usize,
) -> Result<BatchGradient, UpfitError> {
    let counts = BatchCounts::new(batch.iter().map(|&index| frames[index].frame));
    while slots.len() < batch.len() {
        slots.push(BatchSlot { frame: 0, sums: model.sums(), outcome: Ok(FrameDifferences::default()) });
    }
    let slots = &mut slots[..batch.len()];
    slots.iter_mut().zip(batch).for_each(|(slot, &index)| slot.frame = index);
    for_each(
        slots,
        threads,
        || model.worker(),
        |worker, slot| {
            slot.sums.clear();
            slot.outcome = frame_gradient(worker, &frames[slot.frame], loss, &counts, &mut slot.sums);
        },
    );
    let mut differences = FrameDifferences::default();
    let mut not_finite = Vec::new();
    for slot in slots.iter() {
        let found = slot.outcome.clone().map_err(|fault| frames[slot.frame].frame.wrong(fault))?;
        if !found.is_finite() {
            not_finite.push(slot.frame);
        }
        differences.merge(&found);
    }
    let Some((first, others)) = slots.split_first_mut() else {
        return Ok(BatchGradient { differences, gradient: vec![0.0; model.weights().len()], not_finite });
    };
    others.iter().for_each(|slot| first.sums.add(&slot.sums));
    Ok(BatchGradient { differences, gradient: model.gradient(&first.sums), not_finite })
}

fn frame_gradient(
    worker: &mut GradientWorker,
    prepared: &PreparedFrame<'_>,
    loss: &BatchLoss,
    counts: &BatchCounts,
    sums: &mut WeightSums,
) -> Result<FrameDifferences, FrameFault> {
    let neighbours = prepared.neighbours()?;
    let frame = prepared.frame;
    let mut differences = FrameDifferences::default();
    worker.accumulate(
        &frame.structure,
        &neighbours,
        |evaluation| {
            differences = FrameDifferences::new(frame, evaluation, loss.delta);
            loss_gradient(frame, evaluation, loss.delta, &loss.weights, counts)
        },
        sums,
    )?;
    Ok(differences)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::{evaluate, sum};
    use crate::loss::LossSettings;
    use crate::prepared::prepare;
    use crate::test_frames::{model, stronger};

    #[test]
    fn a_step_against_the_gradient_lowers_the_loss_of_the_batch() {
        let (mut model, frames) = (model(), stronger(3));
        let prepared = prepare(model.model(), &frames, &mut { usize::MAX }).unwrap();
        let loss = BatchLoss { delta: 0.01, weights: LossSettings::demo().stages[0].weights };
        let mut slots = Vec::new();
        let found = |threads, slots: &mut Vec<BatchSlot>| {
            batch_gradient(&model, &prepared, &[2, 0, 1], slots, &loss, threads).unwrap()
        };
        let one = found(1, &mut slots);
        // Sums are used again, and threads change no bit.
        let two = found(2, &mut slots);
        assert!(one.gradient == two.gradient && one.differences == two.differences);
        assert!(one.not_finite.is_empty());

        let square: f64 = one.gradient.iter().map(|g| g * g).sum();
        let before = one.differences.loss(&loss.weights);
        let step = 1e-4 * before / square;
        let weights: Vec<_> =
            model.weights().iter().zip(&one.gradient).map(|(weight, g)| weight - step * g).collect();
        model.set_weights(&weights);
        let after = sum(&evaluate(model.model(), &prepared, 0.01, 1).unwrap()).loss(&loss.weights);
        // To first order, the loss falls by a part in 10⁴.
        let fall = (before - after) / before;
        assert!((fall - 1e-4).abs() < 2e-5, "{before} {after} {fall}");
    }
}
