//! What labelled structures say, for `calmwalk calm validate --labelled`: the same as `calm score` says of them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::FileError;
use atoms::extxyz::Frame;
use calm::Mixture;
use tokio_util::sync::CancellationToken;

use super::other_scores::OtherScores;
use super::score_labels::ScoreLabels;
use super::scorer::Scorer;
use crate::calm_validation::labelled::{ComparedMixture, ComparedModel, LabelledReport, LabelledSet};
use crate::calm_validation::{FeaturePlanes, TrainingCompositions};
use crate::cli::CommandError;
use crate::feature_variant::FeatureModel;
use crate::output::{self, Bar};
use crate::xyz_reader::XyzReader;

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// A mixture with its file and its features: those of the model, or of another one.
pub struct NamedMixture {
    pub file: PathBuf,
    pub features: FeatureModel,
    pub mixture: Arc<Mixture>,
}

impl NamedMixture {
    /// The model and the mixture, with work arrays.
    pub fn scorer(&self) -> Scorer {
        Scorer::new(&self.features, self.mixture.clone())
    }
}

/// With what structures are graded besides the scores of the model.
pub struct LabelledComparison<'a> {
    /// Mixtures of the model, that of γ first; none without another one.
    pub mixtures: &'a [NamedMixture],
    /// Further models.
    pub models: &'a [NamedMixture],
}

/// Grades the structures of a file, and compares the scores with their labels. Also adds the atoms of those with force labels to `planes`.
/// `None` if it was stopped.
///
/// # Errors
/// As [`report`].
pub fn set(
    input: &Path,
    (scorer, others): (&mut Scorer, &mut OtherScores),
    comparison: &LabelledComparison<'_>,
    planes: &mut FeaturePlanes,
    stop: &CancellationToken,
) -> Result<Option<LabelledSet>, CommandError> {
    let Some(report) = report(input, scorer, others, Some(planes), stop)? else { return Ok(None) };
    // Other scores could leave atoms out.
    let graded =
        |by: &NamedMixture| self::report(input, &mut by.scorer(), &mut OtherScores::none(), None, stop);
    let (mut mixtures, mut models) = (Vec::new(), Vec::new());
    for by in comparison.mixtures {
        let Some(report) = graded(by)? else { return Ok(None) };
        mixtures.push(ComparedMixture::new(by.file.display().to_string(), &by.mixture, &report));
    }
    for by in comparison.models {
        let Some(report) = graded(by)? else { return Ok(None) };
        models.extend(ComparedModel::new(by.file.display().to_string(), &report));
    }
    Ok(Some(LabelledSet { file: input.display().to_string(), report, mixtures, models }))
}

/// Grades the structures of a file and compares the scores with their labels. Also adds the atoms of those with force labels to `planes`, if
/// they are given. `None` if it was stopped.
///
/// # Errors
/// A structure that cannot be read or graded, with its line; a file without labels.
fn report(
    input: &Path,
    scorer: &mut Scorer,
    others: &mut OtherScores,
    mut planes: Option<&mut FeaturePlanes>,
    stop: &CancellationToken,
) -> Result<Option<LabelledReport>, CommandError> {
    let mut labels = ScoreLabels::new(others.score_columns(), None, false)?;
    let add = |scorer: &Scorer, frame: &Frame| {
        let columns = others.columns(&frame.structure, scorer).map_err(|error| error.to_string());
        let has_forces = labels.add(frame, scorer, &columns.map_err(AddError::Frame)?, None);
        if let Some(planes) = planes.as_deref_mut().filter(|_| matches!(has_forces, Ok(true))) {
            planes.add(&scorer.elements, scorer.features(), &scorer.grades.gamma);
        }
        has_forces.map(drop).map_err(AddError::Command)
    };
    let is_complete = each_frame(input, scorer, stop, add)?;
    if !is_complete { Ok(None) } else { labels.report(input).map(Some) }
}

/// Reads training data: which compositions they have, and the errors on those with labels. `None` if it was stopped.
///
/// # Errors
/// A structure that cannot be read or graded, with its line.
pub fn training(
    inputs: &[PathBuf],
    scorer: &mut Scorer,
    mut training: TrainingCompositions,
    stop: &CancellationToken,
) -> Result<Option<TrainingCompositions>, CommandError> {
    let mut labels = ScoreLabels::new(Vec::new(), None, false)?;
    for input in inputs {
        let add = |scorer: &Scorer, frame: &Frame| {
            training.add(&frame.structure, scorer.neighbours());
            labels.add(frame, scorer, &[], None).map(drop).map_err(AddError::Command)
        };
        if !each_frame(input, scorer, stop, add)? {
            return Ok(None);
        }
        labels.warn(input);
    }
    Ok(Some(training.finish(labels.training_errors())))
}

/// Why a frame was not added.
enum AddError {
    /// What is wrong with the frame.
    Frame(String),
    Command(CommandError),
}

/// Grades each frame of a file and gives it to `add`. Returns whether it came to the end; otherwise it was stopped.
fn each_frame(
    input: &Path,
    scorer: &mut Scorer,
    stop: &CancellationToken,
    mut add: impl FnMut(&Scorer, &Frame) -> Result<(), AddError>,
) -> Result<bool, CommandError> {
    let mut frames = XyzReader::open(input).map_err(CommandError::input)?;
    let bar = Bar::new(frames.length, BAR);
    let mut count = 0_u64;
    while let Some(frame) = frames.next() {
        if stop.is_cancelled() {
            return Ok(false);
        }
        let frame = frame.map_err(CommandError::input)?;
        let at = |error: &dyn std::fmt::Display| {
            CommandError::Input(format!("{}:{}: {error}", input.display(), frame.line))
        };
        scorer.score(&frame.structure, false).map_err(|error| at(&error))?;
        add(scorer, &frame).map_err(|error| match error {
            AddError::Frame(error) => at(&error),
            AddError::Command(error) => error,
        })?;
        count += 1;
        bar.set(frames.position(), || output::count(count, "frame"));
    }
    if count == 0 {
        return Err(CommandError::input(FileError::Empty(input.to_owned())));
    }
    Ok(true)
}
