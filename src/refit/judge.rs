//! The errors of a new version, of its parent and of version 0, and whether the version is registered.

use std::path::{Path, PathBuf};

use potentials::grace::{GraceModel, Precision, RadialPath, Threads};
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;
use upfit::{LabelledFrame, SetErrors, errors_of};

use super::settings::{RefitSettings, RefitterConfig};
use super::training_set::{LabelFile, LabelFiles};
use crate::exit_status::CommandError;
use crate::labelled_frames::{command_error, read_frames};
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
    Seed,
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
pub struct DataSets(Vec<DataSet>);

impl DataSets {
    /// Reads the test sets, and what there is of held-out labels, replay data and later labels. `None` after a cancellation of `stop`.
    ///
    /// # Errors
    /// A file that cannot be read, labels that are broken.
    pub fn read(
        settings: &RefitSettings,
        directory: &Path,
        [frozen, since]: [&LabelFiles; 2],
        stop: &CancellationToken,
    ) -> Result<Option<Self>, CommandError> {
        let (mut sets, mut is_stopped) = (Vec::new(), false);
        let mut add = |name: &str, kind, paths: &[PathBuf]| -> Result<(), CommandError> {
            match read_frames(&StructureReadingArgs::default().files(paths)?, true, stop)? {
                Some((frames, _)) => sets.push(DataSet { name: name.to_owned(), kind, frames }),
                None => is_stopped = true,
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
        add("seed", SetKind::Seed, &replay)?;
        if let Some(path) = since.path(directory, LabelFile::Since) {
            add("since", SetKind::Since, &[path])?;
        }
        Ok((!is_stopped).then_some(Self(sets)))
    }

    /// The errors of the models of version 0, the parent and the new version. `None` after a cancellation of `stop`.
    ///
    /// # Errors
    /// A structure that a model cannot evaluate, errors that are not finite.
    pub fn errors(
        &self,
        config: &RefitterConfig,
        version: &Path,
        stop: &CancellationToken,
    ) -> Result<Option<Vec<SetFigures>>, CommandError> {
        let load = |path: &Path| load(path, config.precision);
        let [first, parent, version] =
            [&*config.first_model.path, &*config.parent_model.path, version].map(load);
        let (first, parent, version) = (first?, parent?, version?);
        check_compatible(&parent, &version)?;
        let threads = Threads::new(config.settings.threads()).map_err(CommandError::failed)?;
        let of_set = |set: &DataSet| -> Result<Option<SetFigures>, CommandError> {
            let [first, parent, version] = [&first, &parent, &version].map(|model| {
                errors_of(model, &set.frames, &threads, &|| stop.is_cancelled()).map_err(command_error)
            });
            let (Some(first), Some(parent), Some(version)) = (first?, parent?, version?) else {
                return Ok(None);
            };
            let structures = set.frames.len() as u64;
            Ok(Some(SetFigures {
                name: set.name.clone(),
                kind: set.kind,
                structures,
                first,
                parent,
                version,
            }))
        };
        self.0.iter().map(of_set).collect()
    }

    /// The errors of another model. `None` after a cancellation of `stop`.
    ///
    /// # Errors
    /// A structure that it cannot evaluate, errors that are not finite.
    pub fn errors_of_model(
        &self,
        config: &RefitterConfig,
        model: &Path,
        stop: &CancellationToken,
    ) -> Result<Option<Vec<ComparedSet>>, CommandError> {
        let model = load(model, config.precision)?;
        let threads = Threads::new(config.settings.threads()).map_err(CommandError::failed)?;
        let of_set = |set: &DataSet| {
            let errors = errors_of(&model, &set.frames, &threads, &|| stop.is_cancelled());
            let errors = errors.map_err(command_error)?;
            Ok(errors.map(|errors| ComparedSet { name: set.name.clone(), errors }))
        };
        self.0.iter().map(of_set).collect()
    }
}

fn load(path: &Path, precision: Precision) -> Result<GraceModel, CommandError> {
    GraceModel::load_in(path, precision, RadialPath::default()).map_err(CommandError::input)
}

/// Walks of all versions have the same elements and limits on distances.
fn check_compatible(parent: &GraceModel, version: &GraceModel) -> Result<(), CommandError> {
    let n = parent.elements().len();
    let wrong = |what: &str| {
        Err(CommandError::Input(format!("the new model has other {what} than that of its parent")))
    };
    if parent.elements() != version.elements() {
        return wrong("elements");
    }
    let differ = |k: &usize| parent.pair_cutoff(k / n, k % n) != version.pair_cutoff(k / n, k % n);
    if (0..n * n).any(|k| differ(&k)) {
        return wrong("cutoffs");
    }
    Ok(())
}

/// Why a version with these errors is refused, if it is.
pub fn refusal(settings: &RefitSettings, sets: &[SetFigures]) -> Option<String> {
    sets.iter().find_map(|set| {
        let version = set.version.force_mae;
        let rule = match set.kind {
            SetKind::Seed => Some((
                "the replay data",
                set.first.force_mae,
                "version 0",
                settings.max_seed_error_ratio,
                "max_seed_error_ratio",
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
            max_seed_error_ratio: 3.0,
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
            refused(SetKind::Seed, [0.1, 0.9, 0.3]),
            None,
            "a third of the limit is that of version 0"
        );
        let forgot = refused(SetKind::Seed, [0.1, 0.9, 0.31]).unwrap();
        let expected = "the force MAE on the replay data is 0.3100 eV/Å, 3.10 times that of version 0 (0.1000 eV/Å): expected at most 3 \
                        times (refit.max_seed_error_ratio)";
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
