//! The errors of a model on a set of frames, without derivatives.

use std::borrow::Cow;
use std::sync::{Arc, Mutex, PoisonError};

use analysis::LabelledEnergy;
use atoms::{Evaluation, Potential, composition};
use potentials::grace::{Grace, GraceModel, Threads};

use crate::data::LabelledFrame;
use crate::differences::FrameDifferences;
use crate::energy_zero::EnergyZero;
use crate::error::UpfitError;
use crate::frame_fault::FrameFault;
use crate::loss::LossSettings;
use crate::prepared::{NEIGHBOUR_BYTES, PreparedFrame, prepare};
use crate::progress::SetErrors;
use crate::stop_request::StopRequest;

/// What the model says of one frame.
#[derive(Clone, Copy, Debug)]
pub struct EvaluatedFrame {
    /// Energy of the model, eV.
    pub energy: f64,
    /// Its differences from the labels.
    pub differences: FrameDifferences,
}

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

/// Frames per thread whose neighbour lists are in memory.
const CHUNK: usize = 16;

/// How a model's zero of the energies has to be moved to that of these labels, as a training with them moves it. A model whose zero
/// cannot be told from the labels keeps its own. `None` if `stop` asked for it.
///
/// # Errors
/// A frame that the model cannot evaluate, or whose numbers are not finite.
pub fn zero_of_labels(
    model: &GraceModel,
    sets: &[&[LabelledFrame]],
    threads: &Threads,
    stop: StopRequest<'_>,
) -> Result<Option<EnergyZero>, UpfitError> {
    let mut energies = Vec::new();
    for frames in sets {
        let evaluated = evaluate_in_chunks(model, frames, &EnergyZero::default(), threads, stop)?;
        let Some(evaluated) = evaluated else { return Ok(None) };
        energies.extend(frames.iter().zip(&evaluated).map(|(frame, evaluated)| LabelledEnergy {
            composition: composition(&frame.structure.species),
            model: evaluated.energy,
            label: frame.energy,
        }));
    }
    Ok(Some(EnergyZero::find(&energies, &[]).unwrap_or_default()))
}

/// The errors of a model, with this zero of its energies, on these frames. The loss is that of the demonstration
/// ([`LossSettings::demo`]). `None` if `stop` asked for it.
///
/// # Errors
/// No frames; a frame that the model cannot evaluate, or whose numbers are not finite.
pub fn errors_of(
    model: &GraceModel,
    frames: &[LabelledFrame],
    zero: &EnergyZero,
    threads: &Threads,
    stop: StopRequest<'_>,
) -> Result<Option<SetErrors>, UpfitError> {
    if frames.is_empty() {
        return Err(UpfitError::NoFrames);
    }
    let evaluated = evaluate_in_chunks(model, frames, zero, threads, stop)?;
    Ok(evaluated.map(|evaluated| sum(&evaluated).errors(&LossSettings::demo().stages[0].weights)))
}

/// Evaluates frames of any number; only the neighbour lists of a chunk are in memory.
fn evaluate_in_chunks(
    model: &GraceModel,
    frames: &[LabelledFrame],
    zero: &EnergyZero,
    threads: &Threads,
    stop: StopRequest<'_>,
) -> Result<Option<Vec<EvaluatedFrame>>, UpfitError> {
    let delta = LossSettings::demo().delta;
    let mut all = Vec::with_capacity(frames.len());
    for chunk in frames.chunks(CHUNK * threads.count()) {
        let moved = with_zero(chunk, zero);
        let Some(prepared) = prepare(model, &moved, &mut { NEIGHBOUR_BYTES }, stop)? else { return Ok(None) };
        let Some(evaluated) = evaluate(model, &prepared, delta, threads, stop)? else { return Ok(None) };
        if let Some(frame) = first_not_finite(&prepared, &evaluated) {
            return Err(frame.wrong(FrameFault::ModelNotFinite));
        }
        all.extend(evaluated);
    }
    Ok(Some(all))
}

/// The frames with energies that a model without the shifts of `zero` is to give.
fn with_zero<'a>(frames: &'a [LabelledFrame], zero: &EnergyZero) -> Cow<'a, [LabelledFrame]> {
    if zero.shifts.is_empty() {
        return Cow::Borrowed(frames);
    }
    let moved = |frame: &LabelledFrame| {
        let energy = frame.energy - zero.of(&composition(&frame.structure.species));
        LabelledFrame { energy, ..frame.clone() }
    };
    Cow::Owned(frames.iter().map(moved).collect())
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
    use crate::test_frames::{aluminium, model, stronger};

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

    #[test]
    fn energies_are_compared_with_the_zero_of_the_labels() {
        let (model, frames, threads) = (model(), stronger(3), Threads::new(2).unwrap());
        let none = EnergyZero::default();
        let zero = zero_of_labels(model.model(), &[&frames[..1], &frames[1..]], &threads, &|| false)
            .unwrap()
            .unwrap();
        // The labels' energies are a tenth larger: −0.34 eV/atom.
        assert!((zero.shifts[0].shift + 0.34).abs() < 0.02, "{zero:?}");
        let errors = |zero| errors_of(model.model(), &frames, zero, &threads, &|| false).unwrap().unwrap();
        let (with, without) = (errors(&zero), errors(&none));
        assert!(with.energy_mae < 0.05 && without.energy_mae > 0.3, "{with:?} {without:?}");
        assert_eq!((with.force_mae, with.structures), (without.force_mae, 3));
        assert_eq!(errors_of(model.model(), &frames, &none, &threads, &|| true).unwrap(), None);
        assert_eq!(zero_of_labels(model.model(), &[&frames[..]], &threads, &|| true).unwrap(), None);
        let message = errors_of(model.model(), &[], &none, &threads, &|| false).unwrap_err().to_string();
        assert!(message.contains("no labelled structures"), "{message}");
    }
}
