//! Runs a walk of a campaign again, from the record of its assignments. Changes nothing.

mod end;
mod parts;

use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;

use atoms::Structure;
use calm::Mixture;
use orchestrator::selector::VERSION;
use potentials::grace::Threads;
use serde_json::Value;
use store::{AssignmentRecord, LoggedDecision, Store, StoredCandidate, WalkRecord};
use wire::messages::{Assignment, AssignmentReport, Outcome, PathPosition, WalkProgress};
use wire::{Candidate, CandidateBlock, Origin, WalkId};
use workers::walk::{StepView, WalkContext, advance_observed};

use crate::atomic_file::refuse_to_replace;
use crate::campaign;
use crate::config::Config;
use crate::exit_status::CommandError;
use crate::replay::{self, MixtureStream, RelocatedFilesArgs};
use crate::runtime::cores;
use crate::versions::VersionOnDisk;
pub use parts::made_parts;

/// Last step of parts, which end where their records say.
const NEVER: u64 = i64::MAX as u64;

/// What came out of it.
#[derive(Clone, Copy, Debug, Default)]
pub struct RerunSummary {
    /// Candidates and control frames of the walk, all of which have the recorded bits.
    pub candidates: u64,
    /// Where the walk is.
    pub end: PathPosition,
    /// It was stopped before.
    pub interrupted: bool,
}

/// Runs a walk again up to its last report. Calls `on_step` at its start and after each of its steps, and stops early when `stopping`
/// returns true. `output` is a file that will be written.
///
/// # Errors
/// An output that would replace a file of the campaign, a walk without a record, files that have changed or moved, and a step that is not that of the record: a candidate with other bits, or
/// at another step.
pub async fn rerun(
    store: &Store,
    walk: WalkId,
    moved: &RelocatedFilesArgs,
    output: Option<&Path>,
    stopping: &impl Fn() -> bool,
    on_step: impl FnMut(&mut StepView<'_, '_>),
) -> Result<RerunSummary, CommandError> {
    let record = find_walk(store, walk).await?;
    let parts = made_parts(store.assignments(walk).await?);
    if parts.is_empty() {
        return Err(CommandError::Input(without_record(&record)));
    }
    let copies = tempfile::tempdir().map_err(CommandError::failed)?;
    let begin = taken_up(store, record.conditions.version).await?;
    let config = configuration(store, begin.as_ref(), copies.path(), moved).await?;
    if let Some(output) = output {
        refuse_files_of_campaign(store, output).await?;
    }
    let (model, artifact, _) = campaign::load_for_grades(&config, Path::new("(the campaign)"))?;
    let mut settings = campaign::walk_settings(&config);
    // These may have changed since, but change no step.
    (settings.trace_interval, settings.trajectory_interval) = (0, 0);
    settings.guard.max_temperature = f64::INFINITY;
    let threads = Threads::new(cores() as usize).map_err(CommandError::failed)?;
    let (settings, original) = (Arc::new(settings), Arc::new(artifact.mixture.clone()));
    let context = WalkContext { model: model.shared(), threads, settings, original };
    let mixtures = MixtureStream::open(store, &artifact, begin.as_ref()).await?;
    let assignment = first_assignment(store, &record).await?;
    Rerun { store, record, context, mixtures, assignment, on_step }.run(&parts, stopping).await
}

/// Refuses an output that would replace a file of the campaign.
pub async fn refuse_files_of_campaign(store: &Store, output: &Path) -> Result<(), CommandError> {
    let config = replay::recorded_configuration(&store.campaign().await?)?;
    let mut files = Vec::new();
    texts(&serde_json::to_value(config).map_err(CommandError::failed)?, &mut files);
    texts(&store.grade_files().await?, &mut files);
    refuse_to_replace(output, files.iter().map(|file| (Path::new(file), "a file of the campaign")))
}

/// All texts in it, among them the names of files.
fn texts(value: &Value, found: &mut Vec<String>) {
    match value {
        Value::String(text) => found.push(text.clone()),
        Value::Array(all) => all.iter().for_each(|value| texts(value, found)),
        Value::Object(all) => all.values().for_each(|value| texts(value, found)),
        _ => {}
    }
}

/// The configuration with which the campaign began, with the files of the version of the potential that a decision took up.
async fn configuration(
    store: &Store,
    begin: Option<&LoggedDecision>,
    copies: &Path,
    moved: &RelocatedFilesArgs,
) -> Result<Config, CommandError> {
    let campaign = store.campaign().await?;
    let mut config = replay::recorded_configuration(&campaign)?;
    config.calm.training_frames = None;
    if let Some(decision) = begin {
        return Ok(VersionOnDisk::taken_up_by(store, decision, copies).await?.applied_to(&config));
    }
    replay::find_files(&mut config, &replay::resolved(&campaign)?, &store.grade_files().await?, moved)?;
    Ok(config)
}

/// The structure where a walk starts.
pub async fn seed_structure(store: &Store, record: &WalkRecord) -> Result<Structure, CommandError> {
    let found = store.seed_structure(record.seed_structure).await?;
    found.map(|seed| seed.structure).ok_or_else(|| {
        CommandError::Failed(format!(
            "the seed structure of walk {} is missing: the database is damaged; restore the campaign from a backup",
            record.walk
        ))
    })
}

/// The walk before its first step.
async fn first_assignment(store: &Store, record: &WalkRecord) -> Result<Assignment, CommandError> {
    let seed_structure = seed_structure(store, record).await?;
    Ok(Assignment {
        campaign: store.campaign().await?.id,
        walk: record.walk,
        number: 0,
        origin: record.origin,
        random_walk: record.partner.unwrap_or(record.walk),
        seed_structure,
        conditions: record.conditions.clone(),
        checkpoint: None,
        verdict: None,
        last_step: NEVER,
        frame_steps: Vec::new(),
        threshold_factor: 1.0,
    })
}

/// A walk that is run again.
struct Rerun<'a, F> {
    store: &'a Store,
    record: WalkRecord,
    context: WalkContext,
    mixtures: MixtureStream<'a>,
    /// The next part, once its record has been applied to it.
    assignment: Assignment,
    on_step: F,
}

impl<F: FnMut(&mut StepView<'_, '_>)> Rerun<'_, F> {
    async fn run(
        mut self,
        parts: &[AssignmentRecord],
        stopping: &impl Fn() -> bool,
    ) -> Result<RerunSummary, CommandError> {
        let mut summary = RerunSummary::default();
        for (number, part) in parts.iter().enumerate() {
            let mixture = self.mixtures.advance_to(part.start.mixture_version, |_| ()).await?;
            let expected = self.candidate_at_end_of(part).await?;
            let report = self.advance(part, expected.as_ref(), mixture, stopping)?;
            summary.end = report.progress.position();
            if stopping() {
                summary.interrupted = true;
                break;
            }
            if let Some(difference) = difference(part, &report, expected.as_ref()) {
                return Err(self.not_reproduced(&difference));
            }
            summary.candidates += u64::from(expected.is_some());
            let is_last = number + 1 == parts.len();
            if let Some(difference) = end::difference(&self.record, &report).filter(|_| is_last) {
                return Err(self.not_reproduced(&difference));
            }
            self.assignment.checkpoint = Some(report.checkpoint);
        }
        Ok(summary)
    }

    /// The recorded candidate, or control frame, with which a part ended.
    async fn candidate_at_end_of(
        &self,
        part: &AssignmentRecord,
    ) -> Result<Option<StoredCandidate>, CommandError> {
        let AssignmentRecord { walk, start, end, .. } = part;
        if start.position == *end {
            return Ok(None);
        }
        Ok(self.store.candidate_at(*walk, end.segment, end.step).await?)
    }

    /// Runs a part up to the place where it ended.
    fn advance(
        &mut self,
        part: &AssignmentRecord,
        expected: Option<&StoredCandidate>,
        mixture: Arc<Mixture>,
        stopping: &impl Fn() -> bool,
    ) -> Result<AssignmentReport<Candidate>, CommandError> {
        let is_frame = self.assignment.origin == Origin::Control && expected.is_some();
        self.assignment.number = part.number;
        self.assignment.verdict.clone_from(&part.start.verdict);
        self.assignment.threshold_factor = part.start.threshold_factor;
        self.assignment.frame_steps = if is_frame { vec![part.end.step] } else { Vec::new() };
        let reached = Cell::new(part.start.position);
        let stops = || reached.get() >= part.end || stopping();
        let on_progress = |progress: WalkProgress| reached.set(progress.position());
        advance_observed(&self.context, &self.assignment, mixture, stops, on_progress, &mut self.on_step)
            .map_err(CommandError::failed)
    }

    fn not_reproduced(&self, difference: &str) -> CommandError {
        CommandError::Failed(format!(
            "walk {} is not reproduced: {difference}{}",
            self.assignment.walk,
            self.mixtures.other_processor_note()
        ))
    }
}

/// What of a part is not as recorded.
fn difference(
    part: &AssignmentRecord,
    report: &AssignmentReport<Candidate>,
    expected: Option<&StoredCandidate>,
) -> Option<String> {
    let (from, to) = (report.start.as_ref().map(|start| start.position), report.progress.position());
    if from != Some(part.start.position) || to != part.end {
        let begins = from.unwrap_or_default();
        let (started, ended) = (shown(&part.start.position), shown(&part.end));
        let recorded = format!("assignment {} went from {started} to {ended}", part.number);
        return Some(format!("{recorded}, and now goes from {} to {}", shown(&begins), shown(&to)));
    }
    let expected = expected?;
    let name = expected.block.view().id();
    match &report.outcome {
        Outcome::Candidate(found) if found.id != name => {
            Some(format!("the structure of candidate {name} differs"))
        }
        Outcome::Candidate(found) => {
            let found = CandidateBlock::encode(found).without_features();
            let is_same = found.as_bytes() == expected.block.as_bytes();
            (!is_same).then(|| format!("the energy, forces or grades of candidate {name} differ"))
        }
        _ => Some(format!("candidate {name} is not offered")),
    }
}

fn shown(at: &PathPosition) -> String {
    match at.reference_step {
        Some(step) => format!("step {step} of the reference run"),
        None if at.segment == 0 => format!("step {}", at.step),
        None => format!("step {} of segment {}", at.step, at.segment),
    }
}

/// The record of a walk.
pub async fn find_walk(store: &Store, walk: WalkId) -> Result<WalkRecord, CommandError> {
    if let Some(found) = store.load_walk(walk).await? {
        return Ok(found);
    }
    let walks = store.status().await?.walks;
    Err(CommandError::Input(match walks.last() {
        None => format!("the campaign has no walk {walk}: it has none yet"),
        Some(last) => format!("the campaign has no walk {walk}; they are 0 to {}", last.walk),
    }))
}

/// Why a walk has no record of its assignments.
fn without_record(record: &WalkRecord) -> String {
    let WalkRecord { walk, state, reason, checkpoint, .. } = record;
    if checkpoint.is_some() {
        return format!(
            "walk {walk} began under a version of calmwalk that did not record its assignments: it cannot be run again"
        );
    }
    match state.as_str() {
        "waiting" | "running" => format!("walk {walk} has not reported any step yet"),
        _ => format!("walk {walk} made no step: {state} {reason}"),
    }
}

/// The decision that took up a version of the potential; `None` for that of the configuration.
async fn taken_up(store: &Store, version: u32) -> Result<Option<LoggedDecision>, CommandError> {
    if version == 0 {
        return Ok(None);
    }
    let decisions = store.decisions_of_kind(VERSION).await?;
    let is_it = |decision: &LoggedDecision| decision.detail["version"] == version;
    let found = decisions.into_iter().find(is_it);
    found.map(Some).ok_or_else(|| {
        CommandError::Failed(format!(
            "no decision takes up version {version} of the potential: the database is damaged; restore the campaign from a backup"
        ))
    })
}
