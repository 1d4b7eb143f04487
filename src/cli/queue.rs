//! `calmwalk queue`

mod completion;
mod files;

use std::io::{self, Write};
use std::path::PathBuf;

use monitor::label_cost::SECONDS_PER_HOUR;
use store::{Attempt, JobDetails, JobState, Location, QueueEntry, Store, WalkVersions, unix_milliseconds};

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{TextTable, count, decimals, print, print_json};
use crate::wording;
use crate::wording::cost::{core_time, wall_time};

/// List, show, drop, retry or prioritise structures in the label queue
///
/// ID is the id of a candidate or a unique prefix of it; its campaign part can be omitted.
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub struct QueueArgs {
    #[command(flatten)]
    location: CampaignArgs,
    #[command(subcommand)]
    action: QueueCommand,
    /// Print JSON
    #[arg(long, global = true)]
    json: bool,
    /// With drop, retry and prioritise: print which jobs would change without changing them
    #[arg(long, global = true)]
    dry_run: bool,
}

#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub enum QueueCommand {
    /// List label jobs: running jobs first, then queued ones in the order in which labellers take them, then the rest
    List(QueueListArgs),
    /// Show a label job with its attempts and the logs of failed ones
    Show {
        /// Id of the candidate
        id: String,
        /// Also show the logs of attempts that made a label
        #[arg(long)]
        all: bool,
    },
    /// Write the archived calculation directories of a candidate to files (label.keep_directories selects what is archived)
    Files {
        /// Id of the candidate
        id: String,
        /// Directory for the files CANDIDATE-ATTEMPT.tar.zst, one per attempt; created if it does not exist
        #[arg(long, short, value_name = "DIR", default_value = ".")]
        output: PathBuf,
    },
    /// Show which labels complete: the model that the campaign has learned, and how reliable it is
    Completion,
    /// Remove queued structures from the queue and from exports (to remove existing labels, use calmwalk exclude)
    Drop {
        /// Ids of the candidates
        #[arg(value_name = "ID", required = true)]
        ids: Vec<String>,
    },
    /// Queue failed or dropped structures again
    Retry {
        /// Ids of the candidates
        #[arg(value_name = "ID", required = true)]
        ids: Vec<String>,
    },
    /// Change the priority of a queued structure
    Prioritise {
        /// Id of the candidate
        id: String,
        /// Higher values are labelled first. Structures of biased walks start with 10, frames of control walks with 0
        #[arg(allow_negative_numbers = true)]
        priority: i32,
    },
}

#[derive(Clone, Debug, PartialEq, clap::Args)]
pub struct QueueListArgs {
    /// List only jobs in this state: queued, leased, labelled, failed, dropped or superseded [default: all]
    #[arg(long, value_parser = parse_state)]
    state: Option<JobState>,
    /// Maximum number of jobs to list
    #[arg(long, default_value_t = 50)]
    limit: u32,
    /// Number of jobs to skip
    #[arg(long, default_value_t = 0)]
    offset: u32,
}

fn parse_state(name: &str) -> Result<JobState, String> {
    JobState::named(name)
        .ok_or_else(|| format!("expected one of {}", JobState::ALL.map(JobState::name).join(", ")))
}

impl QueueArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let location = &self.location.get()?;
        match &self.action {
            QueueCommand::List(list) => {
                let (jobs, versions) = block_on(read_list(location, list))??;
                if self.json {
                    print_json(&jobs)?
                } else {
                    print(|out| write_list(out, &jobs, &versions, list))?
                }
            }
            QueueCommand::Show { id, all } => {
                let details = block_on(read_details(location, id))??;
                if self.json {
                    print_json(&details)?
                } else {
                    print(|out| write_details(out, &details, *all))?
                }
            }
            QueueCommand::Files { id, output } => {
                let written = block_on(files::write(location, id, output))??;
                if self.json { print_json(&written)? } else { print(|out| write_files(out, &written))? }
            }
            QueueCommand::Completion => {
                let found = block_on(completion::read(location))??;
                if self.json {
                    print_json(&found)?
                } else {
                    print(|out| completion::write(out, found.as_ref()))?
                }
            }
            action => self.change(location, action)?,
        }
        Ok(ExitStatus::Done)
    }

    /// Changes one job after the other, and prints the new state of each.
    fn change(&self, location: &Location, action: &QueueCommand) -> Result<(), CommandError> {
        let mut changed = Vec::new();
        let result = match self.dry_run {
            true => block_on(find_jobs(location, action, &mut changed))?,
            false => block_on(change(location, action, &mut changed))?,
        };
        if self.json {
            print_json(&changed)?;
        } else {
            let text = |job: &QueueEntry| match self.dry_run {
                true => format!(
                    "{} is {}, priority {}; nothing was changed",
                    job.candidate, job.state, job.priority
                ),
                false => message(action, job),
            };
            print(|out| changed.iter().try_for_each(|job| writeln!(out, "{}", text(job))))?;
        }
        result
    }
}

async fn read_list(
    location: &Location,
    list: &QueueListArgs,
) -> Result<(Vec<QueueEntry>, WalkVersions), CommandError> {
    let store = Store::open_read_only(location).await?;
    let jobs = store.queue_list(list.state, list.limit, list.offset).await?;
    Ok((jobs, store.walk_versions().await?))
}

async fn read_details(location: &Location, id: &str) -> Result<JobDetails, CommandError> {
    let store = Store::open_read_only(location).await?;
    Ok(store.queue_show(id).await?)
}

/// Finds the jobs that `action` would change.
async fn find_jobs(
    location: &Location,
    action: &QueueCommand,
    found: &mut Vec<QueueEntry>,
) -> Result<(), CommandError> {
    let store = Store::open_read_only(location).await?;
    let ids = match action {
        QueueCommand::Drop { ids } | QueueCommand::Retry { ids } => ids.as_slice(),
        QueueCommand::Prioritise { id, .. } => std::slice::from_ref(id),
        _ => &[],
    };
    for id in ids {
        let job = store.queue_show(id).await?.job;
        let fits = match action {
            QueueCommand::Retry { .. } => matches!(job.state, JobState::Failed | JobState::Dropped),
            _ => !matches!(job.state, JobState::Labelled | JobState::Superseded),
        };
        if !fits {
            return Err(CommandError::Input(format!("{} is {}", job.candidate, job.state)));
        }
        found.push(job);
    }
    store.close().await;
    Ok(())
}

/// Changes the jobs that `action` names. Appends their new states to `changed`, also those before a failure.
pub async fn change(
    location: &Location,
    action: &QueueCommand,
    changed: &mut Vec<QueueEntry>,
) -> Result<(), CommandError> {
    let store = Store::open(location).await?;
    let ids = match action {
        QueueCommand::Drop { ids } | QueueCommand::Retry { ids } => ids.as_slice(),
        QueueCommand::Show { id, .. } | QueueCommand::Prioritise { id, .. } => std::slice::from_ref(id),
        QueueCommand::List(_) | QueueCommand::Files { .. } | QueueCommand::Completion => &[],
    };
    for id in ids {
        let now = unix_milliseconds();
        let candidate = match action {
            QueueCommand::Drop { .. } => store.drop_job(id, now).await?,
            QueueCommand::Retry { .. } => store.retry_job(id, now).await?,
            QueueCommand::Prioritise { priority, .. } => store.prioritise_job(id, *priority, now).await?,
            QueueCommand::List(_)
            | QueueCommand::Show { .. }
            | QueueCommand::Files { .. }
            | QueueCommand::Completion => id.clone(),
        };
        changed.push(store.queue_show(&candidate).await?.job);
    }
    store.close().await;
    Ok(())
}

/// The message for a changed job.
pub fn message(action: &QueueCommand, job: &QueueEntry) -> String {
    let QueueEntry { candidate, state, priority, .. } = job;
    match action {
        QueueCommand::Drop { .. } => format!("{candidate} is dropped: it will not be labelled or exported"),
        QueueCommand::Prioritise { .. } => format!("{candidate} now has priority {priority}"),
        _ => format!("{candidate} is {state} again"),
    }
}

/// The state of a job; with "relabelling" if it already has a label that another one will replace, with "excluded" if that label
/// is excluded.
fn state_of(job: &QueueEntry) -> String {
    let excluded = if job.excluded.is_some() { ", excluded" } else { "" };
    match (&job.relabel, job.state) {
        (Some(_), JobState::Queued | JobState::Leased) => format!("{}, relabelling{excluded}", job.state),
        _ => format!("{}{excluded}", job.state),
    }
}

/// The version of the potential that found a structure is shown if there are several: their grades cannot be compared.
fn write_list(
    out: &mut dyn Write,
    jobs: &[QueueEntry],
    versions: &WalkVersions,
    list: &QueueListArgs,
) -> io::Result<()> {
    if jobs.is_empty() {
        let state = list.state.map_or(String::new(), |state| format!("{state} "));
        return match list.offset {
            0 => writeln!(out, "no {state}jobs"),
            offset => writeln!(out, "no {state}jobs after the first {offset}"),
        };
    }
    let mut titles = vec![
        "id",
        "state",
        ">priority",
        ">atoms",
        "formula",
        ">γ_max",
        ">γ₀_max",
        ">attempts",
        ">failed",
        "protocol",
    ];
    let have_values = jobs.iter().any(|job| job.value.is_some());
    titles.extend(have_values.then_some(">value"));
    titles.extend((!versions.is_single()).then_some(">version"));
    let mut table = TextTable::new(&titles);
    for job in jobs {
        let mut row = vec![
            job.candidate.clone(),
            state_of(job),
            job.priority.to_string(),
            job.atoms.to_string(),
            job.formula.clone(),
            decimals(job.selector_gamma, 2),
            decimals(job.original_gamma, 2),
            job.attempts.to_string(),
            job.failures.to_string(),
            job.protocol.clone(),
        ];
        row.extend(have_values.then(|| wording::labels::value(job.value)));
        row.extend((!versions.is_single()).then(|| versions.of_candidate(&job.candidate).to_string()));
        table.push(row);
    }
    table.write(out)?;
    if jobs.len() as u64 == u64::from(list.limit) {
        let next = u64::from(list.offset) + u64::from(list.limit);
        writeln!(out, "… there may be more: continue with --offset {next}, or raise --limit")?;
    }
    Ok(())
}

fn write_details(out: &mut dyn Write, details: &JobDetails, all: bool) -> io::Result<()> {
    let QueueEntry {
        job,
        candidate,
        protocol,
        state,
        priority,
        holder,
        expires,
        atoms,
        formula,
        selector_gamma,
        original_gamma,
        relabel,
        value,
        value_factors,
        excluded,
        ..
    } = &details.job;
    writeln!(out, "{candidate}")?;
    writeln!(out, "  job       {job}, protocol '{protocol}'")?;
    writeln!(out, "  state     {state}, priority {priority}")?;
    if let Some(value) = wording::labels::value_with_factors(*value, value_factors.as_ref()) {
        writeln!(out, "  value     {value}")?;
    }
    if let Some(reason) = relabel {
        writeln!(out, "  relabel   requested: {reason}")?;
    }
    if let Some(reason) = excluded {
        writeln!(out, "  excluded  from exports and statistics: {reason}")?;
    }
    if let (Some(holder), Some(expires)) = (holder, expires) {
        let left = (expires - unix_milliseconds()) / 1000;
        writeln!(out, "  leased by {holder}, lease expires in {left} s")?;
    }
    writeln!(out, "  atoms     {atoms}, {formula}")?;
    let [current, original] = [*selector_gamma, *original_gamma].map(|gamma| decimals(gamma, 3));
    writeln!(out, "  γ_max     {current} at the decision; γ₀_max {original} (original mixture)")?;
    for ((status, energy), adjustments) in details.energies.iter().zip(&details.retry_adjustments) {
        let status = format!("{status:?}").to_lowercase();
        let per_atom = energy / f64::from(*atoms);
        let adjustments = wording::labels::retry_adjustments(adjustments);
        let adjustments = adjustments.map_or(String::new(), |text| format!(", {text}"));
        writeln!(out, "  {status:<9} energy {energy:.6} eV, {per_atom:.6} eV/atom{adjustments}")?;
    }
    writeln!(
        out,
        "  attempts  {}, {} failed since it was last queued",
        details.job.attempts, details.job.failures
    )?;
    details.attempts_made.iter().try_for_each(|attempt| write_attempt(out, attempt, all))
}

fn write_files(out: &mut dyn Write, written: &[(PathBuf, String)]) -> io::Result<()> {
    if written.is_empty() {
        writeln!(out, "no calculation directories are archived (see label.keep_directories)")?;
    }
    for (path, left_out) in written {
        writeln!(out, "{}", path.display())?;
        left_out.lines().try_for_each(|line| writeln!(out, "  too large to archive: {line}"))?;
    }
    Ok(())
}

fn write_attempt(out: &mut dyn Write, attempt: &Attempt, all: bool) -> io::Result<()> {
    let Attempt {
        attempt: number,
        holder,
        calculation,
        started,
        ended,
        outcome,
        class,
        log,
        made,
        core_seconds,
    } = attempt;
    let outcome = outcome.as_deref().unwrap_or("running");
    let lasted = ended.map(|ended| (ended - started) as f64 / 1000.0);
    let lasted = lasted.map_or(String::new(), |seconds| format!(" after {}", wall_time(seconds)));
    let class = class.as_ref().map_or(String::new(), |class| format!(" ({})", class.replace('_', " ")));
    writeln!(out, "    {number}: {outcome}{class}{lasted}, by {holder}")?;
    if let Some(calculation) = calculation {
        writeln!(out, "       calculation {calculation}")?;
    }
    if let (Some(seconds), Some(cores)) = (core_seconds, made.cores) {
        writeln!(out, "       cost {} on {}", core_time(seconds / SECONDS_PER_HOUR), count(cores, "core"))?;
    }
    if let Some(remedies) = &made.remedies {
        writeln!(out, "       retry adjustments: {}", remedies.replace(',', ", "))?;
    }
    let difference = made.difference.as_deref().unwrap_or_default();
    difference.lines().try_for_each(|line| writeln!(out, "       {line}"))?;
    let log = log.as_deref().filter(|_| all || !attempt.made_label()).unwrap_or_default();
    log.lines().try_for_each(|line| writeln!(out, "       | {line}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(walk: u32) -> QueueEntry {
        QueueEntry {
            excluded: None,
            job: 1,
            candidate: format!("07070707-{walk}.0.5-0123456789abcdef"),
            protocol: "dft".into(),
            state: JobState::Queued,
            priority: 10,
            holder: None,
            expires: None,
            attempts: 0,
            failures: 0,
            atoms: 54,
            formula: "Mo54".into(),
            selector_gamma: Some(1.4),
            original_gamma: Some(1.5),
            original_gamma_nbr: None,
            origin: "biased".into(),
            seed_structure: "bcc-100".into(),
            walk,
            step: 5,
            temperature: Some(300.0),
            relative_volume: Some(1.0),
            overruled: false,
            relabel: None,
            value: None,
            value_factors: None,
        }
    }

    #[test]
    fn versions_are_listed_if_there_are_several() {
        let text = |versions: [u32; 2]| {
            let versions = WalkVersions::from_walks((0..).zip(versions));
            let list = QueueListArgs { state: None, limit: 50, offset: 0 };
            let mut out = Vec::new();
            write_list(&mut out, &[job(0), job(1)], &versions, &list).unwrap();
            String::from_utf8(out).unwrap()
        };
        let several = text([0, 2]);
        let last: Vec<_> = several.lines().map(|line| line.split_whitespace().last().unwrap()).collect();
        assert_eq!(last, ["version", "0", "2"], "{several}");
        assert!(!text([0, 0]).contains("version"));
    }
}
