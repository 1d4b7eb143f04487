//! What labelled structures say, for `calmwalk calm validate --labelled`: the same as `calm score` says of them.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::extxyz::Frame;
use calm::Mixture;
use tokio_util::sync::CancellationToken;

use super::other_scores::{OtherScoreError, OtherScores};
use super::score_labels::ScoreLabels;
use super::scorer::Scorer;
use crate::calm_validation::labelled::{ComparedMixture, ComparedModel, LabelledReport, LabelledSet};
use crate::calm_validation::{FeaturePlanes, TrainingCompositions};
use crate::cli::CommandError;
use crate::feature_variant::FeatureModel;
use crate::left_out::LeftOutStructures;
use crate::output::{self, Bar};
use crate::structure_files::{FileLine, StructureFiles};

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
    files: &StructureFiles,
    (scorer, others): (&mut Scorer, &mut OtherScores),
    comparison: &LabelledComparison<'_>,
    planes: &mut FeaturePlanes,
    stop: &CancellationToken,
) -> Result<Option<LabelledSet>, CommandError> {
    let Some(report) = report(files, scorer, others, Some(planes), stop)? else { return Ok(None) };
    // Other scores could leave atoms out.
    let graded =
        |by: &NamedMixture| self::report(files, &mut by.scorer(), &mut OtherScores::none(), None, stop);
    let (mut mixtures, mut models) = (Vec::new(), Vec::new());
    for by in comparison.mixtures {
        let Some(report) = graded(by)? else { return Ok(None) };
        mixtures.push(ComparedMixture::new(by.file.display().to_string(), &by.mixture, &report));
    }
    for by in comparison.models {
        let Some(report) = graded(by)? else { return Ok(None) };
        models.extend(ComparedModel::new(by.file.display().to_string(), &report));
    }
    Ok(Some(LabelledSet { file: name(files).display().to_string(), report, mixtures, models }))
}

/// Grades the structures of a file and compares the scores with their labels. Also adds the atoms of those with force labels to `planes`, if
/// they are given. `None` if it was stopped.
///
/// # Errors
/// A structure that cannot be read, with its line; a file without labels, or without a structure that can be graded.
fn report(
    files: &StructureFiles,
    scorer: &mut Scorer,
    others: &mut OtherScores,
    mut planes: Option<&mut FeaturePlanes>,
    stop: &CancellationToken,
) -> Result<Option<LabelledReport>, CommandError> {
    let mut labels = ScoreLabels::new(others.score_columns(), None, false)?;
    let add = |scorer: &Scorer, frame: &Frame| {
        let columns = others.columns(&frame.structure, scorer);
        let has_forces = labels.add(frame, scorer, &columns.map_err(AddError::Scores)?, None);
        if let Some(planes) = planes.as_deref_mut().filter(|_| matches!(has_forces, Ok(true))) {
            planes.add(&scorer.elements, scorer.features(), &scorer.grades.gamma);
        }
        has_forces.map(drop).map_err(AddError::Command)
    };
    let is_complete = each_frame(files, scorer, stop, add)?;
    if !is_complete { Ok(None) } else { labels.report(name(files)).map(Some) }
}

/// The path of a single file.
fn name(files: &StructureFiles) -> &Path {
    files.paths().next().unwrap_or(Path::new(""))
}

/// Reads training data: which compositions they have, and the errors on those with labels. `None` if it was stopped.
///
/// # Errors
/// A structure that cannot be read, with its line; a file without a structure that can be graded.
pub fn training(
    inputs: &[StructureFiles],
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
        labels.warn(name(input));
    }
    Ok(Some(training.finish(labels.training_errors())))
}

/// Why a frame was not added.
enum AddError {
    Scores(OtherScoreError),
    Command(CommandError),
}

/// Grades each frame of a file and gives it to `add`. Warns of frames that cannot be graded, and leaves them out. Returns whether it came
/// to the end; otherwise it was stopped.
fn each_frame(
    files: &StructureFiles,
    scorer: &mut Scorer,
    stop: &CancellationToken,
    mut add: impl FnMut(&Scorer, &Frame) -> Result<(), AddError>,
) -> Result<bool, CommandError> {
    let (bytes, mut left_out) = (Arc::new(AtomicU64::new(0)), LeftOutStructures::default());
    let mut frames = files.reader(Arc::clone(&bytes));
    let bar = Bar::new(Some(files.total_bytes()?).filter(|length| *length > 0), BAR);
    let mut count = 0_u64;
    while let Some((frame, file)) = frames.next()? {
        if stop.is_cancelled() {
            return Ok(false);
        }
        let place = FileLine { file: file.path, line: frame.line };
        let graded = scorer.score(&frame.structure, false).map_err(|error| AddError::Scores(error.into()));
        match graded.and_then(|()| add(scorer, &frame)) {
            Ok(()) => count += 1,
            Err(AddError::Scores(error)) if error.is_of_structure() => left_out.add(place, error),
            Err(AddError::Scores(error)) => return Err(place.wrong(error)),
            Err(AddError::Command(error)) => return Err(error),
        }
        bar.set(bytes.load(Ordering::Relaxed), || output::count(count, "frame"));
    }
    drop(bar);
    left_out.warn(count)?;
    Ok(true)
}
