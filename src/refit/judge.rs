//! The errors of a new version, of its parent and of version 0, and whether the version is registered.

use std::path::{Path, PathBuf};

use potentials::grace::{GraceError, GraceModel, Precision, RadialPath, Threads};
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;
use upfit::{LabelledFrame, SetErrors, UpfitError, errors_of, zero_of_labels};

use super::failure::RefitFailure;
use super::settings::{RefitSettings, RefitterConfig};
use super::training_set::{LabelFile, LabelFiles};
use crate::exit_status::CommandError;
use crate::labelled_frames::{command_error, read_without_warning};
use crate::process_config::HashedFile;
use crate::structure_files::StructureReadingArgs;

/// What a data set is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SetKind {
    /// Named in the configuration; decides nothing.
    Test,
    /// Labels of seed structures that no version is trained on.
    HeldOut,
    /// The replay data.
    Replay,
    /// Labels that came after the training set was fixed.
    Since,
}

/// The errors of models on a data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SetFigures {
    /// Its name.
    pub name: String,
    /// What it is for.
    pub kind: SetKind,
    /// Number of structures.
    pub structures: u64,
    /// Version 0.
    pub first: SetErrors,
    /// The parent of the version.
    pub parent: SetErrors,
    /// The version.
    pub version: SetErrors,
}

/// A model that was trained for comparison.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ComparisonFigures {
    /// Its name.
    pub name: String,
    /// Number of structures that it was trained with in place of the campaign's.
    pub structures: u64,
    /// Its errors, by data set.
    pub sets: Vec<ComparedSet>,
}

/// The errors of such a model on a data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ComparedSet {
    /// Name of the data set.
    pub name: String,
    /// The errors.
    pub errors: SetErrors,
}

/// A data set with its frames.
struct DataSet {
    name: String,
    kind: SetKind,
    frames: Vec<LabelledFrame>,
}

/// The data sets that versions are judged by.
pub struct DataSets {
    /// None of them is empty.
    sets: Vec<DataSet>,
    /// The labels of the campaign that the version is trained on.
    trained_on: Vec<LabelledFrame>,
}

/// What models are evaluated with.
pub struct EvaluationContext<'a> {
    /// The threads.
    pub threads: Threads,
    /// Ends an evaluation.
    pub stop: &'a CancellationToken,
}

impl DataSets {
    /// Reads the test sets, and what there is of held-out labels, replay data and later labels. `None` after a cancellation of `stop`.
    ///
    /// # Errors
    /// Refused: labels of the campaign that are broken. Failed: the same of files of the configuration.
    pub fn read(
        settings: &RefitSettings,
        directory: &Path,
        [frozen, since]: [&LabelFiles; 2],
        stop: &CancellationToken,
    ) -> Result<Option<Self>, RefitFailure> {
        let read = |paths: &[PathBuf]| -> Result<Vec<LabelledFrame>, CommandError> {
            let found = read_without_warning(&StructureReadingArgs::default().files(paths)?, stop)?;
            Ok(found.map(|((frames, _), _)| frames).unwrap_or_default())
        };
        let mut sets = Vec::new();
        let mut add = |name: &str, kind, paths: &[PathBuf]| -> Result<(), RefitFailure> {
            let frames = match kind {
                SetKind::Test | SetKind::Replay => read(paths)?,
                SetKind::HeldOut | SetKind::Since => read(paths).map_err(RefitFailure::of_input)?,
            };
            if !frames.is_empty() {
                sets.push(DataSet { name: name.to_owned(), kind, frames });
            }
            Ok(())
        };
        for set in &settings.test_sets {
            add(&set.name, SetKind::Test, std::slice::from_ref(&set.file.path))?;
        }
        if let Some(path) = frozen.path(directory, LabelFile::HeldOut) {
            add("held_out", SetKind::HeldOut, &[path])?;
        }
        let replay: Vec<_> = settings.replay.iter().map(|file| file.path.clone()).collect();
        add("replay", SetKind::Replay, &replay)?;
        if let Some(path) = since.path(directory, LabelFile::Since) {
            add("since", SetKind::Since, &[path])?;
        }
        let training: Vec<_> = frozen.path(directory, LabelFile::Training).into_iter().collect();
        let trained_on = read(&training).map_err(RefitFailure::of_input)?;
        // What was read until a cancellation is not all.
        Ok((!stop.is_cancelled()).then_some(Self { sets, trained_on }))
    }

    /// The errors of the models of version 0, the parent and the new version. `None` after a cancellation.
    ///
    /// # Errors
    /// Refused: a structure that the new model cannot evaluate, or with errors that are not finite. Failed: the same of the others.
    pub fn errors(
        &self,
        config: &RefitterConfig,
        version: &GraceModel,
        evaluation: &EvaluationContext<'_>,
    ) -> Result<Option<Vec<SetFigures>>, RefitFailure> {
        let known = |file: &HashedFile| -> Result<Option<Vec<SetErrors>>, CommandError> {
            let model = load(&file.path, config.precision).map_err(CommandError::input)?;
            self.errors_of(&model, evaluation).map_err(command_error)
        };
        let RefitterConfig { first_model, parent_model, .. } = config;
        let Some(of_first) = known(first_model)? else { return Ok(None) };
        let of_parent = match first_model.hash == parent_model.hash {
            true => Some(of_first.clone()),
            false => known(parent_model)?,
        };
        let of_version = self.errors_of(version, evaluation).map_err(RefitFailure::of_training)?;
        let (Some(of_parent), Some(of_version)) = (of_parent, of_version) else { return Ok(None) };
        let errors = of_first.into_iter().zip(of_parent).zip(of_version);
        let figures = self.sets.iter().zip(errors).map(|(set, ((first, parent), version))| SetFigures {
            name: set.name.clone(),
            kind: set.kind,
            structures: set.frames.len() as u64,
            first,
            parent,
            version,
        });
        Ok(Some(figures.collect()))
    }

    /// The errors of another model. `None` after a cancellation.
    ///
    /// # Errors
    /// Refused: a model that cannot be read, a structure that it cannot evaluate, errors that are not finite.
    pub fn errors_of_file(
        &self,
        precision: Precision,
        model: &Path,
        evaluation: &EvaluationContext<'_>,
    ) -> Result<Option<Vec<ComparedSet>>, RefitFailure> {
        let model = load(model, precision).map_err(RefitFailure::of_model)?;
        let found = self.errors_of(&model, evaluation).map_err(RefitFailure::of_training)?;
        let named = |(set, errors): (&DataSet, SetErrors)| ComparedSet { name: set.name.clone(), errors };
        Ok(found.map(|errors| self.sets.iter().zip(errors).map(named).collect()))
    }

    /// The errors of a model on each set. Its energies have the zero that a training with the same data gives them: labels of another
    /// program say nothing about the zero of a model that was not trained on them.
    fn errors_of(
        &self,
        model: &GraceModel,
        EvaluationContext { threads, stop }: &EvaluationContext<'_>,
    ) -> Result<Option<Vec<SetErrors>>, UpfitError> {
        let is_stopped = || stop.is_cancelled();
        let replay = self.sets.iter().filter(|set| set.kind == SetKind::Replay).map(|set| &set.frames[..]);
        let trained_on: Vec<_> = replay.chain([&self.trained_on[..]]).collect();
        let zero = zero_of_labels(model, &trained_on, threads, &is_stopped)?;
        let Some(zero) = zero else { return Ok(None) };
        let mut found = Vec::new();
        for set in &self.sets {
            let errors = errors_of(model, &set.frames, &zero, threads, &is_stopped)?;
            let Some(errors) = errors else { return Ok(None) };
            found.push(errors);
        }
        Ok(Some(found))
    }
}

fn load(path: &Path, precision: Precision) -> Result<GraceModel, GraceError> {
    GraceModel::load_in(path, precision, RadialPath::default())
}

/// Reads a new model. Walks of all versions have the same elements and cutoffs.
///
/// # Errors
/// Refused: a file that is no model, a model with others. Failed: the parent's file.
pub fn load_version(config: &RefitterConfig, path: &Path) -> Result<GraceModel, RefitFailure> {
    let unreadable = |error: GraceError| match RefitFailure::of_model(error) {
        RefitFailure::Refused(reason) => {
            RefitFailure::Refused(format!("the new model cannot be read: {reason}"))
        }
        failed @ RefitFailure::Failed(_) => failed,
    };
    let version = load(path, config.precision).map_err(unreadable)?;
    let parent = load(&config.parent_model.path, config.precision).map_err(CommandError::input)?;
    let wrong = |what: &str| {
        Err(RefitFailure::Refused(format!("the new model has other {what} than that of its parent")))
    };
    if parent.elements() != version.elements() {
        return wrong("elements");
    }
    let n = parent.elements().len();
    let differ = |k: &usize| parent.pair_cutoff(k / n, k % n) != version.pair_cutoff(k / n, k % n);
    if (0..n * n).any(|k| differ(&k)) {
        return wrong("cutoffs");
    }
    Ok(version)
}

/// Why a version with these errors is refused, if it is.
pub fn refusal(settings: &RefitSettings, sets: &[SetFigures]) -> Option<String> {
    // What it has forgotten before what it has not learned.
    let of_kind = |kind| sets.iter().filter(move |set| set.kind == kind);
    of_kind(SetKind::Replay).chain(of_kind(SetKind::HeldOut)).find_map(|set| {
        let version = set.version.force_mae;
        let rule = match set.kind {
            SetKind::Replay => Some((
                "the replay data",
                set.first.force_mae,
                "version 0",
                settings.max_replay_error_ratio,
                "max_replay_error_ratio",
            )),
            SetKind::HeldOut => Some((
                "the held-out labels",
                set.parent.force_mae,
                "its parent",
                settings.max_held_out_error_ratio,
                "max_held_out_error_ratio",
            )),
            SetKind::Test | SetKind::Since => None,
        };
        let (data, reference, whose, limit, key) = rule?;
        // Not a number is refused too.
        let fits = version <= limit * reference;
        (!fits).then(|| {
            format!(
                "the force MAE on {data} is {version:.4} eV/Å, {:.2} times that of {whose} ({reference:.4} eV/Å): expected at most {limit} \
                 times (refit.{key})",
                version / reference
            )
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{ControlFrames, RefitMethod, RefitStart};

    fn errors(force_mae: f64) -> SetErrors {
        SetErrors {
            structures: 3,
            loss: 0.0,
            energy_mae: 0.0,
            energy_rmse: 0.0,
            force_mae,
            force_rmse: force_mae,
            stress_mae: None,
            stress_rmse: None,
        }
    }

    fn set(kind: SetKind, [first, parent, version]: [f64; 3]) -> SetFigures {
        let [first, parent, version] = [first, parent, version].map(errors);
        SetFigures { name: "x".into(), kind, structures: 3, first, parent, version }
    }

    fn settings() -> RefitSettings {
        RefitSettings {
            replay: Vec::new(),
            replay_weight: 1.0,
            method: RefitMethod::default(),
            held_out: 0.1,
            max_replay_error_ratio: 3.0,
            max_held_out_error_ratio: 1.0,
            threads: 1,
            start: RefitStart::default(),
            control_frames: ControlFrames::default(),
            test_sets: Vec::new(),
            comparisons: Vec::new(),
        }
    }

    #[test]
    fn versions_are_refused_that_forget_or_do_not_improve() {
        let refused = |kind, errors| refusal(&settings(), &[set(kind, errors)]);
        assert_eq!(
            refused(SetKind::Replay, [0.1, 0.9, 0.3]),
            None,
            "a third of the limit is that of version 0"
        );
        let forgot = refused(SetKind::Replay, [0.1, 0.9, 0.31]).unwrap();
        let expected = "the force MAE on the replay data is 0.3100 eV/Å, 3.10 times that of version 0 (0.1000 eV/Å): expected at most 3 \
                        times (refit.max_replay_error_ratio)";
        assert_eq!(forgot, expected);
        assert_eq!(refused(SetKind::HeldOut, [0.1, 0.3, 0.3]), None);
        let worse = refused(SetKind::HeldOut, [0.9, 0.3, 0.31]).unwrap();
        assert!(worse.contains("1.03 times that of its parent"), "{worse}");
        assert!(refused(SetKind::HeldOut, [0.9, 0.3, f64::NAN]).is_some());
        for kind in [SetKind::Test, SetKind::Since] {
            assert_eq!(refused(kind, [0.1, 0.1, 9.0]), None, "for display only");
        }
    }
}
