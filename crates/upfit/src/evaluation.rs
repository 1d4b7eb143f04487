//! The errors of a model on a set of frames, without derivatives.

use std::sync::{Arc, Mutex, PoisonError};

use atoms::{Evaluation, Potential};
use potentials::grace::{Grace, GraceModel, Threads};

use crate::data::{FrameFault, LabelledFrame};
use crate::differences::FrameDifferences;
use crate::error::UpfitError;
use crate::loss::LossSettings;
use crate::prepared::{NEIGHBOUR_BYTES, PreparedFrame, prepare};
use crate::progress::SetErrors;

/// What the model says of one frame.
#[derive(Clone, Copy, Debug)]
pub struct EvaluatedFrame {
    /// Energy of the model, eV.
    pub energy: f64,
    /// Its differences from the labels.
    pub differences: FrameDifferences,
}

/// Asks whether to stop; once it says so, it goes on to say so.
pub type StopRequest<'a> = &'a (dyn Fn() -> bool + Sync);

/// Evaluates all frames, with the δ of the loss. The result does not depend on the number of threads. Returns `None` if `stop` asked
/// for it before the last frame.
///
/// # Errors
/// A frame that the model cannot evaluate.
pub fn evaluate(
    model: &GraceModel,
    frames: &[PreparedFrame<'_>],
    delta: f64,
    threads: &Threads,
    stop: StopRequest<'_>,
) -> Result<Option<Vec<EvaluatedFrame>>, UpfitError> {
    let model = Arc::new(model.clone());
    let worker = || (Grace::new(Arc::clone(&model)), Evaluation::default());
    let mut workers: Vec<_> =
        std::iter::repeat_with(worker).take(threads.count().min(frames.len())).collect();
    let mut tasks: Vec<_> = frames.iter().map(|frame| (frame, None)).collect();
    let remaining = Mutex::new(tasks.iter_mut());
    let next = || remaining.lock().unwrap_or_else(PoisonError::into_inner).next();
    threads.for_each(&mut workers, |(grace, evaluation)| {
        while let Some((frame, result)) = next() {
            if stop() {
                break;
            }
            *result = Some(evaluate_frame(grace, evaluation, frame, delta));
        }
    });
    let evaluated = tasks
        .into_iter()
        .map(|(frame, result)| Some(result?.map_err(|fault| frame.frame.wrong(fault))))
        .collect::<Option<Result<Vec<_>, _>>>();
    evaluated.transpose()
}

/// The sums over these frames, in their order.
pub fn sum(evaluated: &[EvaluatedFrame]) -> FrameDifferences {
    let mut sums = FrameDifferences::default();
    evaluated.iter().for_each(|frame| sums.merge(&frame.differences));
    sums
}

/// The first frame whose numbers are not finite.
pub fn first_not_finite<'a>(
    frames: &[PreparedFrame<'a>],
    evaluated: &[EvaluatedFrame],
) -> Option<&'a LabelledFrame> {
    let index = evaluated.iter().position(|frame| !frame.differences.is_finite())?;
    Some(frames[index].frame)
}

/// The errors of a model on these frames. The loss is that of the demonstration ([`LossSettings::demo`]). Returns `None` if `stop` asked
/// for it.
///
/// # Errors
/// No frames; a frame that the model cannot evaluate, or whose numbers are not finite.
pub fn errors_of(
    model: &GraceModel,
    frames: &[LabelledFrame],
    threads: &Threads,
    stop: StopRequest<'_>,
) -> Result<Option<SetErrors>, UpfitError> {
    if frames.is_empty() {
        return Err(UpfitError::NoFrames);
    }
    let loss = LossSettings::demo();
    let Some(prepared) = prepare(model, frames, &mut { NEIGHBOUR_BYTES }, stop)? else { return Ok(None) };
    let Some(evaluated) = evaluate(model, &prepared, loss.delta, threads, stop)? else { return Ok(None) };
    if let Some(frame) = first_not_finite(&prepared, &evaluated) {
        return Err(frame.wrong(FrameFault::ModelNotFinite));
    }
    Ok(Some(sum(&evaluated).errors(&loss.stages[0].weights)))
}

fn evaluate_frame(
    grace: &mut Grace,
    evaluation: &mut Evaluation,
    prepared: &PreparedFrame<'_>,
    delta: f64,
) -> Result<EvaluatedFrame, FrameFault> {
    let neighbours = prepared.neighbours()?;
    grace.evaluate(&prepared.frame.structure, &neighbours, evaluation)?;
    let differences = FrameDifferences::new(prepared.frame, evaluation, delta);
    Ok(EvaluatedFrame { energy: evaluation.energy(), differences })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_frames::{aluminium, model};

    #[test]
    fn the_model_of_the_demonstration_fits_its_training_data() {
        let (model, frames) = (model(), aluminium(3));
        let prepared = prepare(model.model(), &frames, &mut { usize::MAX }, &|| false).unwrap().unwrap();
        let [one, two] = [1, 2].map(|threads| {
            let threads = Threads::new(threads).unwrap();
            sum(&evaluate(model.model(), &prepared, 0.01, &threads, &|| false).unwrap().unwrap())
        });
        assert_eq!(one, two);
        let errors = one.errors(&LossSettings::demo().stages[0].weights);
        assert_eq!(errors.structures, 3);
        assert!(errors.energy_rmse < 0.02 && errors.force_rmse < 0.1, "{errors:?}");
        assert!(errors.force_mae <= errors.force_rmse && errors.stress_rmse.unwrap() < 0.01, "{errors:?}");
    }
}
