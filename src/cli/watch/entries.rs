//! Walks, label jobs and decisions as entries of the panes, and their quantities for filters.

use atoms::Species;
use monitor::label_progress::LabelUnderWay;
use store::{DecidedCandidate, JobState, QueueEntry, RecentDecision, WalkStatus, unix_milliseconds};
use wire::WalkConditions;
use wire::conditions::VariedConditions;

use super::pane::{PaneEntry, Tone};
use crate::cli::status::page::{cut, cut_middle};
use crate::cli::status::walks;
use crate::filter::{self, StructureFilter, StructureProperties};
use crate::output::decimals;
use crate::wording::label_progress;

/// Columns of the queue: `>` marks numbers, trailing blanks reserve width.
pub const JOBS: [&str; 8] =
    ["candidate         ", "state   ", ">prio", ">atoms", "formula", ">γ_max", ">γ₀_max", ">tries"];

/// Columns of the decisions.
pub const DECISIONS: [&str; 9] = [
    ">number",
    "what             ",
    ">walk",
    "structure",
    ">   step",
    ">T (K)",
    ">V/V₀",
    ">γ_max",
    ">γ₀_max",
];

/// Quantities that are not available in a pane: of walks, of label jobs, of decisions.
pub const UNKNOWN_QUANTITIES: [&[&str]; 3] = [
    &[
        "gamma_nbr",
        "mixture_version",
        "atoms",
        "energy",
        "energy_per_atom",
        "max_force",
        "fragments",
        "retry_adjustment",
        "element",
    ],
    &["mixture_version", "energy", "energy_per_atom", "max_force", "fragments", "retry_adjustment"],
    &["energy", "energy_per_atom", "max_force", "fragments", "retry_adjustment"],
];

/// The entries of walks that match the filter. `run_active`: whether an orchestrator runs.
pub fn walk_entries(
    walks: &[WalkStatus],
    run_active: bool,
    filter: Option<&StructureFilter>,
) -> Vec<PaneEntry> {
    let matches = |walk: &&WalkStatus| filter.is_none_or(|filter| filter.matches(&facts_of_walk(walk)));
    let tone = |walk: &WalkStatus| match walk.state.as_str() {
        _ if walk.paused => Tone::Attention,
        "running" if run_active => Tone::Active,
        "running" => Tone::Plain,
        "waiting" => Tone::Plain,
        "trapped" | "diverged" | "invalid_start" => Tone::Attention,
        _ => Tone::Ended,
    };
    let varied = VariedConditions::among(walks.iter().filter_map(|walk| walk.conditions.as_ref()));
    let width = walks::width_of_names(walks);
    let entry = |walk: &WalkStatus| PaneEntry {
        key: walk.walk.to_string(),
        columns: walks::line(walk, &varied, run_active, width),
        tone: tone(walk),
        candidate: None,
    };
    walks.iter().filter(matches).map(entry).collect()
}

/// The entries of label jobs that match the filter. `running`: labels under way, which show their time in place of their state.
pub fn job_entries(
    jobs: &[QueueEntry],
    walks: &[WalkStatus],
    running: &[LabelUnderWay],
    filter: Option<&StructureFilter>,
) -> Vec<PaneEntry> {
    let now = unix_milliseconds();
    let matches = |job: &&QueueEntry| {
        let species = filter::species(&job.formula);
        filter.is_none_or(|filter| filter.matches(&facts_of_job(job, &species, walks)))
    };
    let tone = |state: JobState| match state {
        JobState::Leased | JobState::Labelled => Tone::Active,
        JobState::Queued => Tone::Plain,
        JobState::Failed => Tone::Attention,
        JobState::Dropped | JobState::Superseded => Tone::Ended,
    };
    let entry = |job: &QueueEntry| PaneEntry {
        key: job.job.to_string(),
        columns: vec![
            short_candidate(&job.candidate),
            state_of_job(job, running, now),
            job.priority.to_string(),
            job.atoms.to_string(),
            cut(&job.formula, 9),
            decimals(job.selector_gamma, 2),
            decimals(job.original_gamma, 2),
            job.attempts.to_string(),
        ],
        tone: tone(job.state),
        candidate: Some(job.candidate.clone()),
    };
    jobs.iter().filter(matches).map(entry).collect()
}

/// The entries of decisions that match the filter.
pub fn decision_entries<'a>(
    decisions: impl Iterator<Item = &'a RecentDecision>,
    walks: &[WalkStatus],
    filter: Option<&StructureFilter>,
) -> Vec<PaneEntry> {
    let matches = |decision: &&RecentDecision| {
        let formula = decision.candidate.as_ref().map_or("", |found| &found.formula);
        let species = filter::species(formula);
        filter.is_none_or(|filter| filter.matches(&facts_of_decision(decision, &species, walks)))
    };
    let width = walks::width_of_names(walks);
    decisions.filter(matches).map(|decision| decision_entry(decision, width)).collect()
}

/// `width`: that of names of seed structures.
fn decision_entry(decision: &RecentDecision, width: usize) -> PaneEntry {
    let RecentDecision { sequence, kind, walk, detail, candidate, .. } = decision;
    let found = candidate.as_ref();
    let number = |of: fn(&DecidedCandidate) -> Option<f64>, digits| match found {
        Some(found) => decimals(of(found), digits),
        None => String::new(),
    };
    let what = match (found.and_then(|found| found.reason.as_deref()), detail["end"].as_str()) {
        (Some(reason), _) => format!("{kind}: {}", reason.replace('_', " ")),
        (None, Some(end)) => format!("{kind}: {}", end.replace('_', " ")),
        (None, None) => kind.clone(),
    };
    let name = found.map(|found| found.seed_structure.as_str()).or_else(|| detail["seed_structure"].as_str());
    let step = found.map(|found| found.step).or_else(|| detail["step"].as_u64());
    PaneEntry {
        key: sequence.to_string(),
        columns: vec![
            sequence.to_string(),
            what,
            walk.map_or(String::new(), |walk| walk.to_string()),
            cut_middle(name.unwrap_or_default(), width),
            step.map_or(String::new(), |step| step.to_string()),
            number(|found| found.temperature, 0),
            number(|found| found.relative_volume, 3),
            number(|found| found.selector_gamma, 2),
            number(|found| found.original_gamma, 2),
        ],
        tone: match kind.as_str() {
            "accepted" => Tone::Active,
            "declined" | "control" => Tone::Plain,
            _ => Tone::Ended,
        },
        candidate: found.map(|found| found.candidate.clone()),
    }
}

/// The id of a candidate without the campaign part, which is the same for all.
pub fn without_campaign(candidate: &str) -> &str {
    candidate.split_once('-').map_or(candidate, |(_, rest)| rest)
}

fn state_of_job(job: &QueueEntry, running: &[LabelUnderWay], now: i64) -> String {
    let progress =
        running.iter().find(|progress| progress.label.job == job.job && job.state == JobState::Leased);
    progress.map_or_else(|| job.state.to_string(), |progress| label_progress::short(progress, now))
}

/// Walk, segment and step of a candidate, with eight digits of its hash.
fn short_candidate(candidate: &str) -> String {
    let rest = without_campaign(candidate);
    rest.rsplit_once('-')
        .map_or(rest.to_owned(), |(place, hash)| format!("{place}-{}", hash.get(..8).unwrap_or(hash)))
}

fn facts_of_walk(walk: &WalkStatus) -> StructureProperties<'_> {
    StructureProperties {
        gamma: walk.gamma_max_original,
        gamma_current: walk.gamma_max,
        relative_volume: walk.relative_volume,
        kinetic_temperature: walk.temperature,
        conditions: walk.conditions.as_ref(),
        walk: Some(walk.walk),
        step: Some(walk.step),
        origin: &walk.origin,
        seed_structure: Some(&walk.seed_structure),
        ..StructureProperties::default()
    }
}

/// Walks are numbered from 0 and listed in order.
fn conditions_of(walks: &[WalkStatus], walk: u32) -> Option<&WalkConditions> {
    walks.get(walk as usize)?.conditions.as_ref()
}

fn facts_of_job<'a>(
    job: &'a QueueEntry,
    species: &'a [Species],
    walks: &'a [WalkStatus],
) -> StructureProperties<'a> {
    StructureProperties {
        gamma: job.original_gamma,
        gamma_current: job.selector_gamma,
        gamma_nbr: job.original_gamma_nbr,
        relative_volume: job.relative_volume,
        kinetic_temperature: job.temperature,
        conditions: conditions_of(walks, job.walk),
        walk: Some(job.walk),
        step: Some(job.step),
        species,
        origin: &job.origin,
        seed_structure: Some(&job.seed_structure),
        ..StructureProperties::default()
    }
}

fn facts_of_decision<'a>(
    decision: &'a RecentDecision,
    species: &'a [Species],
    walks: &'a [WalkStatus],
) -> StructureProperties<'a> {
    let of_walk = StructureProperties {
        walk: decision.walk,
        conditions: decision.walk.and_then(|walk| conditions_of(walks, walk)),
        mixture_version: Some(decision.mixture_version),
        ..StructureProperties::default()
    };
    let Some(found) = &decision.candidate else { return of_walk };
    StructureProperties {
        gamma: found.original_gamma,
        gamma_current: found.selector_gamma,
        gamma_nbr: found.original_gamma_nbr,
        relative_volume: found.relative_volume,
        kinetic_temperature: found.temperature,
        step: Some(found.step),
        species,
        origin: found.origin.name(),
        seed_structure: Some(&found.seed_structure),
        ..of_walk
    }
}
