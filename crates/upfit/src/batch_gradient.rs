//! The gradient of one batch, over threads.

use std::cmp::Reverse;
use std::sync::{Mutex, PoisonError};

use potentials::grace::{GradientWorker, Threads, TrainableGrace, WeightSums};

use crate::differences::FrameDifferences;
use crate::error::UpfitError;
use crate::frame_fault::FrameFault;
use crate::loss::{BatchCounts, LossWeights, loss_gradient};
use crate::prepared::PreparedFrame;

/// Frames for each thread until their sums are added: with more, threads wait less for the largest frame.
const FRAMES_PER_THREAD: usize = 4;

/// Sums over structures, which all batches use again: a total, and those of the frames that are at work together.
pub struct BatchSums {
    total: WeightSums,
    slots: Vec<BatchSlot>,
    threads: Threads,
}

/// One frame of a batch.
struct BatchSlot {
    frame: usize,
    sums: WeightSums,
    outcome: Result<FrameDifferences, FrameFault>,
}

impl BatchSums {
    /// For these threads, each of which takes one frame at a time, and batches of at most `batch_size` frames.
    pub fn new(model: &TrainableGrace, threads: Threads, batch_size: usize) -> Self {
        let at_work = if threads.count() > 1 { FRAMES_PER_THREAD * threads.count() } else { 1 };
        let slot = || BatchSlot { frame: 0, sums: model.sums(), outcome: Ok(FrameDifferences::default()) };
        let slots = std::iter::repeat_with(slot).take(at_work.min(batch_size).max(1)).collect();
        Self { total: model.sums(), slots, threads }
    }
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

/// The gradient of the loss of `batch`, indices of `frames`. Threads take one frame after another, the largest first, and then add
/// up. Each frame has sums of its own, which are added to the total in the order of the batch, so that the result does not depend
/// on the number of threads.
///
/// # Errors
/// A frame that the model cannot evaluate.
pub fn batch_gradient(
    model: &TrainableGrace,
    frames: &[PreparedFrame<'_>],
    batch: &[usize],
    sums: &mut BatchSums,
    loss: &BatchLoss,
) -> Result<BatchGradient, UpfitError> {
    let counts = BatchCounts::new(batch.iter().map(|&index| frames[index].frame));
    let BatchSums { total, slots, threads } = sums;
    let mut workers: Vec<_> = (0..threads.count().min(slots.len())).map(|_| model.worker()).collect();
    let mut differences = FrameDifferences::default();
    let mut not_finite = Vec::new();
    for (number, together) in batch.chunks(slots.len()).enumerate() {
        let slots = &mut slots[..together.len()];
        slots.iter_mut().zip(together).for_each(|(slot, &index)| slot.frame = index);
        let mut queue: Vec<_> = slots.iter_mut().collect();
        queue.sort_by_key(|slot| Reverse(frames[slot.frame].frame.structure.len()));
        let queue = Mutex::new(queue.into_iter());
        let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
        threads.for_each(&mut workers, |worker| {
            while let Some(slot) = next() {
                slot.sums.clear();
                slot.outcome = frame_gradient(worker, &frames[slot.frame], loss, &counts, &mut slot.sums);
            }
        });
        for slot in slots.iter() {
            let found = slot.outcome.clone().map_err(|fault| frames[slot.frame].frame.wrong(fault))?;
            if !found.is_finite() {
                not_finite.push(slot.frame);
            }
            differences.merge(&found);
        }
        let sums: Vec<_> = slots.iter().map(|slot| &slot.sums).collect();
        match number {
            0 => total.set_to_sum(&sums, threads),
            _ => total.add_all(&sums, threads),
        }
    }
    Ok(BatchGradient { differences, gradient: model.gradient(total), not_finite })
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
        let prepared = prepare(model.model(), &frames, &mut { usize::MAX }, &|| false).unwrap().unwrap();
        let loss = BatchLoss { delta: 0.01, weights: LossSettings::demo().stages[0].weights };
        let found =
            |sums: &mut BatchSums| batch_gradient(&model, &prepared, &[2, 0, 1], sums, &loss).unwrap();
        let one = found(&mut BatchSums::new(&model, Threads::default(), 3));
        // Batches of three frames at work together, and of two and one.
        for (threads, together) in [(2, 3), (3, 3), (5, 3), (2, 2), (1, 1)] {
            let mut sums = BatchSums::new(&model, Threads::new(threads).unwrap(), together);
            assert_eq!(sums.slots.len(), together);
            // Sums are used again, and threads change no bit.
            for _ in 0..2 {
                let other = found(&mut sums);
                assert!(one.gradient == other.gradient && one.differences == other.differences);
            }
        }
        assert!(one.not_finite.is_empty());

        let square: f64 = one.gradient.iter().map(|g| g * g).sum();
        let before = one.differences.loss(&loss.weights);
        let step = 1e-4 * before / square;
        let weights: Vec<_> =
            model.weights().iter().zip(&one.gradient).map(|(weight, g)| weight - step * g).collect();
        model.set_weights(&weights);
        let evaluated =
            evaluate(model.model(), &prepared, 0.01, &Threads::default(), &|| false).unwrap().unwrap();
        let after = sum(&evaluated).loss(&loss.weights);
        // To first order, the loss falls by a part in 10⁴.
        let fall = (before - after) / before;
        assert!((fall - 1e-4).abs() < 2e-5, "{before} {after} {fall}");
    }
}
