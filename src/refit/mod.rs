//! A refit: trains a new version of the potential from the labels of a campaign, builds its mixture, judges it, and registers or
//! refuses it.
//!
//! Each step leaves files in a directory of the refit, and is skipped if they are there. A refit that was killed continues from them, to
//! the same bytes.

mod command;
mod cost;
mod failure;
mod judge;
mod mixture;
mod native;
pub mod process;
pub mod schedule;
pub mod settings;
mod training_set;

use std::collections::HashSet;
use std::fs::{self, File, TryLockError};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use atoms::extxyz::write_frame;
use monitor::refit_progress::{LABEL_SET, NO_LABELS};
use monitor::refit_record::recorded_before;
use potentials::grace::{GraceModel, Threads};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use store::{Store, StoreError, VersionFiles, VersionRecord, VersionState, unix_milliseconds};
use tokio_util::sync::CancellationToken;
use upfit::{EnergyDeviations, EnergyZero};

pub use self::command::end_marked_when_alone;
use self::cost::{CostMeter, RefitCost};
use self::failure::RefitFailure;
use self::judge::{ComparisonFigures, DataSets, EvaluationContext, SetFigures, load_version, refusal};
use self::native::{NativeTraining, TrainingReport};
use self::settings::{RefitSettings, RefitterConfig, TestSet};
use self::training_set::{FrozenSet, LabelChoice, LabelFile, LabelFiles, kept};
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::config::{Config, ControlFrames, NativeRefit, RefitMethod};
use crate::exit_status::CommandError;
use crate::file_hash::{hash, verify_hash};
use crate::output::log_and_warn;
use crate::structure_files::StructureReadingArgs;

/// Folder of the campaign's directory for refits.
const FOLDER: &str = "refit";
/// The file that a refit locks.
const LOCK: &str = "refit.lock";
/// The new model and its mixture.
const MODEL: &str = command::MODEL;
const MIXTURE: &str = "mixture.npz";
/// The errors of the version and of those before it.
const ERRORS: &str = "errors.json";
/// Begin of the names of files of models that are trained for comparison.
const COMPARISON: &str = "comparison-";
/// The file with a hash of test sets and structures for comparison, which the errors belong to.
const JUDGED_WITH: &str = "judged_with";
/// Name of the comparison with control frames.
const CONTROL: &str = "control";

/// How a refit ended.
#[derive(Debug)]
pub enum RefitOutcome {
    /// With a new version.
    Registered(VersionRecord),
    /// With a version that was refused; the record has the reason.
    Refused(VersionRecord),
    /// It was asked to stop. The same refit continues later.
    Stopped,
}

/// A training, as it is recorded with the version.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct TrainingRecord {
    /// Structures trained on, those of the replay data among them; `None` if a program trained.
    structures: Option<u64>,
    validation: Option<u64>,
    epochs: Option<u64>,
    /// How calmwalk moved the zero of the energies, and how energies differ from the model's after that.
    #[serde(default)]
    energy_zero: Option<EnergyZero>,
    #[serde(default)]
    energy_spread: Option<EnergyDeviations>,
}

/// A refit under way.
struct Refit<'a> {
    config: &'a RefitterConfig,
    store: &'a Store,
    directory: PathBuf,
    set: FrozenSet,
    labels: LabelFiles,
    stop: &'a CancellationToken,
    meter: &'a CostMeter,
    report: &'a (dyn Fn(String) + Sync),
}

/// Runs a refit, or continues the one that was interrupted. `report` is told about the progress, a line at a time.
///
/// # Errors
/// A file of the configuration that has changed, the database, a full disk. What cannot become a version for other reasons is refused.
async fn run(
    config: &RefitterConfig,
    store: &Store,
    stop: &CancellationToken,
    report: &(dyn Fn(String) + Sync),
) -> Result<RefitOutcome, CommandError> {
    check_files(config)?;
    let _lock = lock(&config.directory)?;
    let versions = store.versions().await?;
    if let Some(ended) = ended_before(config, store, &versions).await? {
        return Ok(ended);
    }
    let number = VersionRecord::next_number(&versions);
    let protocol = store.protocol_in_force().await?.map_or_else(String::new, |found| found.hash.to_string());
    let directory = prepare_directory(&config.directory, number, &protocol)?;
    remove_stale_errors(&directory, &config.settings)?;
    let meter = CostMeter::new(&directory);
    let set = kept::<_, CommandError>(directory.join("set.json"), async || {
        // In this order: a structure that is accepted in between counts for the next refit.
        let accepted = store.accepted_structures().await?;
        let last_decision = store.newest_mixture().await?.decision;
        Ok(Some(FrozenSet { number, protocol, last_decision, accepted }))
    });
    let Some(set) = set.await? else { return Ok(RefitOutcome::Stopped) };
    let labels = kept(directory.join("labels.json"), async || {
        training_set::write(store, (&directory, &set), config.label_split(), LabelChoice::OfSet, stop).await
    });
    let Some(labels) = labels.await? else { return Ok(RefitOutcome::Stopped) };
    let report_numbered = |line: String| {
        // So that a process that is killed leaves what it has cost.
        if let Err(error) = meter.save() {
            log_and_warn(format_args!("refit {number}: {error}"));
        }
        report(format!("refit {number}: {line}"));
    };
    let refit =
        Refit { config, store, directory, set, labels, stop, meter: &meter, report: &report_numbered };
    let judged = refit.train_and_judge().await;
    meter.save()?;
    let (reason, figures) = match judged {
        Ok(None) => return Ok(RefitOutcome::Stopped),
        Ok(Some(judged)) => judged,
        Err(RefitFailure::Refused(reason)) => {
            // A file that changed meanwhile is no reason to refuse a version.
            check_files(config)?;
            (Some(reason), Value::Null)
        }
        Err(RefitFailure::Failed(error)) => return Err(error),
    };
    refit.record(reason, figures).await
}

/// Makes this the only refit in the directory of a campaign while the file is open.
fn lock(campaign: &Path) -> Result<File, CommandError> {
    let path = campaign.join(LOCK);
    let file = File::create(&path).map_err(|error| cannot_write(&path, error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(CommandError::Failed(format!(
            "another refit of the campaign in {} is running: wait for its end",
            campaign.display()
        ))),
        Err(TryLockError::Error(error)) => Err(cannot_write(&path, error)),
    }
}

/// How this refit ended, if an earlier process of it recorded that and was killed then.
async fn ended_before(
    config: &RefitterConfig,
    store: &Store,
    versions: &[VersionRecord],
) -> Result<Option<RefitOutcome>, CommandError> {
    let directory = |number: u32| config.directory.join(FOLDER).join(number.to_string());
    let is_left = |number| directory(number).exists();
    let of_labels = (store, &config.label_split());
    let Some(record) = recorded_before(of_labels, versions, config.parent_version, is_left).await? else {
        return Ok(None);
    };
    let _ = fs::remove_dir_all(directory(record.number));
    Ok(Some(match record.state {
        VersionState::Registered => RefitOutcome::Registered(record),
        VersionState::Refused => RefitOutcome::Refused(record),
    }))
}

/// Fails if a file has another content than when the campaign began, or this refit.
fn check_files(config: &RefitterConfig) -> Result<(), CommandError> {
    let RefitterConfig { parent_model, first_model, parent_mixture, settings, .. } = config;
    let sets = settings.test_sets.iter().chain(&settings.comparisons).map(|set| &set.file);
    let mut files =
        [parent_model, first_model, parent_mixture].into_iter().chain(&settings.replay).chain(sets);
    files.try_for_each(|file| verify_hash(&file.path, &file.hash))
}

/// The directory of a refit. Those of earlier ones, and of labels of another protocol, are removed.
fn prepare_directory(campaign: &Path, number: u32, protocol: &str) -> Result<PathBuf, CommandError> {
    let all = campaign.join(FOLDER);
    let directory = all.join(number.to_string());
    let before: Option<FrozenSet> =
        fs::read(directory.join("set.json")).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok());
    if before.is_some_and(|before| before.protocol != protocol) {
        log_and_warn(format_args!("refit {number}: starts again, because the label protocol has changed"));
        fs::remove_dir_all(&directory).map_err(|error| cannot_write(&directory, error))?;
    }
    fs::create_dir_all(&directory).map_err(|error| cannot_write(&directory, error))?;
    for entry in fs::read_dir(&all).map_err(CommandError::failed)? {
        let path = entry.map_err(CommandError::failed)?.path();
        if path != directory {
            fs::remove_dir_all(&path).map_err(|error| cannot_write(&path, error))?;
        }
    }
    Ok(directory)
}

/// Removes what an interrupted refit has found with other test sets or structures for comparison, which may change.
fn remove_stale_errors(directory: &Path, settings: &RefitSettings) -> Result<(), CommandError> {
    let now =
        serde_json::to_string(&(&settings.test_sets, &settings.comparisons)).map_err(CommandError::failed)?;
    let now = blake3::hash(now.as_bytes()).to_string();
    let record = directory.join(JUDGED_WITH);
    match fs::read_to_string(&record) {
        Ok(before) if before == now => return Ok(()),
        Err(error) if error.kind() != ErrorKind::NotFound => return Err(cannot_read(&record, error)),
        _ => {}
    }
    for entry in fs::read_dir(directory).map_err(CommandError::failed)? {
        let path = entry.map_err(CommandError::failed)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name == ERRORS || name.starts_with(COMPARISON) {
            fs::remove_file(&path).map_err(|error| cannot_write(&path, error))?;
        }
    }
    let mut file = AtomicFile::create(&record)?;
    file.write_all(now.as_bytes()).map_err(|error| cannot_write(&record, error))?;
    file.finish()
}

fn cannot_read(path: &Path, error: std::io::Error) -> CommandError {
    CommandError::Failed(format!("cannot read {}: {error}", path.display()))
}

impl Refit<'_> {
    /// Takes all steps until the version can be recorded: why it is refused, if it is, and its figures. `None` if it was stopped. A
    /// version that is refused gets no mixture.
    async fn train_and_judge(&self) -> Result<Option<(Option<String>, Value)>, RefitFailure> {
        let Some(labels) = self.labels.path(&self.directory, LabelFile::Training) else {
            return Err(RefitFailure::refused(NO_LABELS));
        };
        let training = kept(self.directory.join("training.json"), || self.train(&labels));
        let Some(training) = training.await? else { return Ok(None) };
        let version = load_version(self.config, &self.path(MODEL))?;
        let Some(sets) = self.data_sets().await? else { return Ok(None) };
        let Some(figures) = self.judge(&sets, &version).await? else { return Ok(None) };
        let mut reason = refusal(&self.config.settings, &figures);
        if reason.is_none() {
            match self.build_mixture(&labels).await {
                Ok(true) => {}
                Ok(false) => return Ok(None),
                Err(RefitFailure::Refused(of_mixture)) => reason = Some(of_mixture),
                Err(failed) => return Err(failed),
            }
        }
        let figures = |comparisons: Vec<ComparisonFigures>| json!({ "sets": figures, "comparisons": comparisons, "training": training });
        if reason.is_some() {
            return Ok(Some((reason, figures(Vec::new()))));
        }
        self.version_cost().await?;
        let Some(comparisons) = self.compare_all(&sets).await? else { return Ok(None) };
        Ok(Some((None, figures(comparisons))))
    }

    /// The cost when this is first asked for: that of the version, without the models that are trained for comparison.
    async fn version_cost(&self) -> Result<RefitCost, CommandError> {
        let cost =
            kept(self.path("version_cost.json"), async || Ok::<_, CommandError>(Some(self.meter.now())));
        Ok(cost.await?.unwrap_or_default())
    }

    /// The data sets to judge with. `None` if it was stopped.
    async fn data_sets(&self) -> Result<Option<DataSets>, RefitFailure> {
        let since = kept(self.directory.join("since.json"), async || {
            let (set, split) = ((&*self.directory, &self.set), self.config.label_split());
            training_set::write(self.store, set, split, LabelChoice::Since(&self.labels), self.stop).await
        });
        let Some(since) = since.await? else { return Ok(None) };
        DataSets::read(&self.config.settings, &self.directory, [&self.labels, &since], self.stop)
    }

    /// The errors of the version and of those before it. `None` if it was stopped.
    async fn judge(
        &self,
        sets: &DataSets,
        version: &GraceModel,
    ) -> Result<Option<Vec<SetFigures>>, RefitFailure> {
        kept(self.path(ERRORS), async || {
            (self.report)("judging".to_owned());
            let evaluation = self.evaluation()?;
            tokio::task::block_in_place(|| sets.errors(self.config, version, &evaluation))
        })
        .await
    }

    fn evaluation(&self) -> Result<EvaluationContext<'_>, CommandError> {
        let threads = Threads::new(self.config.settings.threads()).map_err(CommandError::failed)?;
        Ok(EvaluationContext { threads, stop: self.stop })
    }

    /// The errors of the models that are trained for comparison; one that cannot be trained is left out. `None` if it was stopped.
    async fn compare_all(&self, sets: &DataSets) -> Result<Option<Vec<ComparisonFigures>>, RefitFailure> {
        let RefitMethod::Native(native) = &self.config.settings.method else { return Ok(Some(Vec::new())) };
        let mut comparisons = Vec::new();
        for (name, file) in self.comparisons()? {
            match self.compare(native, sets, &name, &file).await {
                Ok(Some(found)) => comparisons.push(found),
                Ok(None) => return Ok(None),
                Err(RefitFailure::Refused(reason)) => {
                    let number = self.set.number;
                    log_and_warn(format_args!("refit {number}: no comparison with {name}: {reason}"));
                }
                Err(failed) => return Err(failed),
            }
        }
        Ok(Some(comparisons))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// Trains the model.
    async fn train(&self, labels: &Path) -> Result<Option<TrainingRecord>, RefitFailure> {
        match &self.config.settings.method {
            RefitMethod::Native(native) => self.train_natively(native, "training", labels, self.path(MODEL)),
            RefitMethod::Command(command) => {
                (self.report)(format!("training: {}", command.program.join(" ")));
                let held_out = self.labels.path(&self.directory, LabelFile::HeldOut);
                let files = (labels, held_out.as_deref());
                let ended = command::run(command, self.config, &self.directory, files, self.stop).await?;
                Ok(ended.map(|()| TrainingRecord::default()))
            }
        }
    }

    fn train_natively(
        &self,
        native: &NativeRefit,
        what: &str,
        labels: &Path,
        output: PathBuf,
    ) -> Result<Option<TrainingRecord>, RefitFailure> {
        let begin = (self.config.begin(), format!("version {}", self.config.begin_version()));
        let training = NativeTraining { begin, labels, output };
        let settings = (&self.config.settings, native);
        let progress = |line: String| (self.report)(format!("{what}: {line}"));
        let number = self.set.number;
        let warning = |text: String| log_and_warn(format_args!("refit {number}: {what}: {text}"));
        let report = TrainingReport { progress: &progress, warning: &warning };
        let seed = self.config.rng_seed;
        let trained = tokio::task::block_in_place(|| training.run(settings, seed, self.stop, report))?;
        Ok(trained.map(|summary| TrainingRecord {
            structures: Some(summary.structures),
            validation: Some(summary.validation),
            epochs: Some(summary.epochs),
            energy_zero: Some(summary.zero),
            energy_spread: Some(summary.spread),
        }))
    }

    /// Builds the mixture. Returns whether it is there.
    async fn build_mixture(&self, labels: &Path) -> Result<bool, RefitFailure> {
        let output = self.path(MIXTURE);
        if output.exists() {
            return Ok(true);
        }
        (self.report)("building the mixture".to_owned());
        let trained_on: HashSet<i64> = self.labels.trained_on.iter().copied().collect();
        let files = (&*self.path(MODEL), labels, &*output);
        let built = mixture::build(self.config, self.store, files, &trained_on, self.stop).await?;
        Ok(built.is_some())
    }

    /// Files to train with in place of the campaign's labels, by name.
    fn comparisons(&self) -> Result<Vec<(String, PathBuf)>, CommandError> {
        let settings = &self.config.settings;
        let control = match settings.control_frames {
            ControlFrames::Compare => self.labels.path(&self.directory, LabelFile::Control),
            ControlFrames::Train => None,
        };
        let mut all: Vec<_> = control.map(|path| (CONTROL.to_owned(), path)).into_iter().collect();
        for TestSet { name, file } in &settings.comparisons {
            all.push((name.clone(), self.first_frames(name, &file.path)?));
        }
        Ok(all)
    }

    /// As many frames of a file as the training set has labels, in a file of their own.
    fn first_frames(&self, name: &str, file: &Path) -> Result<PathBuf, CommandError> {
        let path = self.path(&format!("{COMPARISON}{name}.extxyz"));
        if path.exists() {
            return Ok(path);
        }
        let files = StructureReadingArgs::default().files(&[file.to_owned()])?;
        let mut reader = files.reader(Default::default());
        let mut out = AtomicFile::create(&path)?;
        for _ in 0..self.labels.count(LabelFile::Training) {
            let Some((frame, _)) = reader.next()? else { break };
            write_frame(&mut out, &frame).map_err(|error| cannot_write(&path, error))?;
        }
        out.finish()?;
        Ok(path)
    }

    /// Trains a model with other structures, and computes its errors.
    async fn compare(
        &self,
        native: &NativeRefit,
        sets: &DataSets,
        name: &str,
        labels: &Path,
    ) -> Result<Option<ComparisonFigures>, RefitFailure> {
        kept(self.path(&format!("{COMPARISON}{name}.json")), async || {
            let model = self.path(&format!("{COMPARISON}{name}.npz"));
            let what = format!("comparison with {name}");
            let Some(_) = self.train_natively(native, &what, labels, model.clone())? else { return Ok(None) };
            let structures = count_frames(labels)?;
            let precision = self.config.precision;
            let evaluation = self.evaluation()?;
            let errors = || sets.errors_of_file(precision, &model, &evaluation);
            let Some(sets) = tokio::task::block_in_place(errors)? else { return Ok(None) };
            Ok(Some(ComparisonFigures { name: name.to_owned(), structures, sets }))
        })
        .await
    }

    /// Registers the version, or records why it is refused.
    async fn record(self, reason: Option<String>, figures: Value) -> Result<RefitOutcome, CommandError> {
        let is_refused = reason.is_some();
        let files = if is_refused { None } else { Some(self.read_files()?) };
        let of_file = |name| match is_refused {
            true => Ok(String::new()),
            false => hash(&self.path(name)).map_err(CommandError::failed),
        };
        let cost = self.version_cost().await?;
        let record = VersionRecord {
            number: self.set.number,
            parent: self.config.parent_version,
            state: if is_refused { VersionState::Refused } else { VersionState::Registered },
            // The directory is removed, and the record must not depend on where the campaign is.
            reason: with_file_names_only(&reason.unwrap_or_default(), &self.directory),
            method: self.config.settings.method.name().to_owned(),
            structures: self.set.accepted,
            last_decision: self.set.last_decision,
            labels: self.labels.count(LabelFile::Training),
            model_hash: of_file(MODEL)?,
            mixture_hash: of_file(MIXTURE)?,
            figures: with_label_set(figures, &self.labels.label_set),
            seconds: cost.seconds,
            core_hours: cost.core_seconds / 3600.0,
            time: unix_milliseconds(),
        };
        self.store.add_version(&record, files.as_ref()).await?;
        (self.report)(match is_refused {
            true => format!("refused: {}", record.reason),
            false => format!("registered version {}", record.number),
        });
        // The next refit removes it otherwise.
        let _ = fs::remove_dir_all(&self.directory);
        Ok(if is_refused { RefitOutcome::Refused(record) } else { RefitOutcome::Registered(record) })
    }

    fn read_files(&self) -> Result<VersionFiles, CommandError> {
        let read = |name: &str| {
            let path = self.path(name);
            fs::read(&path).map_err(|error| cannot_read(&path, error))
        };
        Ok(VersionFiles { model: read(MODEL)?, mixture: read(MIXTURE)? })
    }
}

/// The figures with what tells whether labels are new since. The next attempt needs it of refused ones too.
fn with_label_set(figures: Value, label_set: &str) -> Value {
    let mut figures = if figures.is_object() { figures } else { json!({}) };
    figures[LABEL_SET] = label_set.into();
    figures
}

/// The figures of a refit that crashes: the labels that it was to train on. If it crashed before it wrote them down, those that there
/// are now, so that later ones are news.
pub async fn figures_of_crashed(
    (store, config): (&Store, &Config),
    campaign: &Path,
    number: u32,
) -> Result<Value, StoreError> {
    let path = campaign.join(FOLDER).join(number.to_string()).join("labels.json");
    let labels = fs::read(path).ok().and_then(|bytes| serde_json::from_slice::<LabelFiles>(&bytes).ok());
    let label_set = match labels {
        Some(labels) => labels.label_set,
        None => schedule::rules(config).split.label_set(store).await?.unwrap_or_default().0,
    };
    Ok(with_label_set(Value::Null, &label_set))
}

/// A message that names the files of this directory by their names.
fn with_file_names_only(message: &str, directory: &Path) -> String {
    message.replace(&format!("{}/", directory.display()), "")
}

/// Number of structures in a file.
fn count_frames(path: &Path) -> Result<u64, CommandError> {
    let mut reader = StructureReadingArgs::default().files(&[path.to_owned()])?.reader(Default::default());
    let mut number = 0;
    while reader.next()?.is_some() {
        number += 1;
    }
    Ok(number)
}
