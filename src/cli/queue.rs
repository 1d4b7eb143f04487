//! `calmwalk queue`

mod files;

use std::io::{self, Write};
use std::path::PathBuf;

use store::{Attempt, Job, JobDetails, JobState, Location, Store, unix_milliseconds};

use super::{CampaignLocation, ExitStatus, Failure, block_on};
use crate::output::{Table, count, decimals, print, print_json};

/// List, show, drop, retry or prioritise the structures in the label queue
///
/// A structure is named by its candidate's id, or by the beginning of it if no other begins so; the campaign's part of
/// the id may be left out.
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub struct Queue {
    #[command(flatten)]
    location: CampaignLocation,
    #[command(subcommand)]
    action: Action,
    /// Print JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub enum Action {
    /// List jobs in the order in which they would be labelled: those in one state, or all, in work and waiting ones first
    List(List),
    /// Show everything about one, with its attempts and the logs of those that failed
    Show {
        /// Candidate
        id: String,
    },
    /// Write the packed directories of its calculations, as label.keep has them kept
    Files {
        /// Candidate
        id: String,
        /// Directory to write into, a file CANDIDATE-ATTEMPT.tar.zst each; made if it does not exist
        #[arg(long, value_name = "DIR", default_value = ".")]
        into: PathBuf,
    },
    /// Take structures that wait for a label out of the queue and out of exports (calmwalk exclude takes labels out)
    Drop {
        /// Candidates
        #[arg(value_name = "ID", required = true)]
        ids: Vec<String>,
    },
    /// Put failed or dropped structures back into the queue
    Retry {
        /// Candidates
        #[arg(value_name = "ID", required = true)]
        ids: Vec<String>,
    },
    /// Give a structure that waits another priority
    Prioritise {
        /// Candidate
        id: String,
        /// Higher first; structures begin with 10, frames of control walks with 0
        #[arg(allow_negative_numbers = true)]
        priority: i32,
    },
}

#[derive(Clone, Debug, PartialEq, clap::Args)]
pub struct List {
    /// Only those in this state
    #[arg(long, value_parser = parse_state)]
    state: Option<JobState>,
    /// Show at most this many
    #[arg(long, default_value_t = 50)]
    limit: u32,
    /// Leave out this many first
    #[arg(long, default_value_t = 0)]
    offset: u32,
}

fn parse_state(name: &str) -> Result<JobState, String> {
    JobState::named(name)
        .ok_or_else(|| format!("expected one of {}", JobState::ALL.map(JobState::name).join(", ")))
}

impl Queue {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let location = &self.location.get()?;
        match &self.action {
            Action::List(list) => {
                let jobs = block_on(read_list(location, list))??;
                if self.json { print_json(&jobs)? } else { print(|out| write_list(out, &jobs, list))? }
            }
            Action::Show { id } => {
                let details = block_on(read_details(location, id))??;
                if self.json { print_json(&details)? } else { print(|out| write_details(out, &details))? }
            }
            Action::Files { id, into } => {
                let written = block_on(files::write(location, id, into))??;
                if self.json { print_json(&written)? } else { print(|out| write_files(out, &written))? }
            }
            action => self.change(location, action)?,
        }
        Ok(ExitStatus::Done)
    }

    /// Changes one job after the other, and tells of each how it stands then.
    fn change(&self, location: &Location, action: &Action) -> Result<(), Failure> {
        let mut changed = Vec::new();
        let ended = block_on(change(location, action, &mut changed))?;
        if self.json {
            print_json(&changed)?;
        } else {
            print(|out| changed.iter().try_for_each(|job| writeln!(out, "{}", outcome(action, job))))?;
        }
        ended
    }
}

async fn read_list(location: &Location, list: &List) -> Result<Vec<Job>, Failure> {
    let store = Store::open_read_only(location).await?;
    Ok(store.queue_list(list.state, list.limit, list.offset).await?)
}

async fn read_details(location: &Location, id: &str) -> Result<JobDetails, Failure> {
    let store = Store::open_read_only(location).await?;
    Ok(store.queue_show(id).await?)
}

/// Changes what it names; `changed` has the jobs as they stand then, also before a failure.
pub async fn change(location: &Location, action: &Action, changed: &mut Vec<Job>) -> Result<(), Failure> {
    let store = Store::open(location).await?;
    let ids = match action {
        Action::Drop { ids } | Action::Retry { ids } => ids.as_slice(),
        Action::Show { id } | Action::Prioritise { id, .. } => std::slice::from_ref(id),
        Action::List(_) | Action::Files { .. } => &[],
    };
    for id in ids {
        let now = unix_milliseconds();
        let candidate = match action {
            Action::Drop { .. } => store.drop_job(id, now).await?,
            Action::Retry { .. } => store.retry_job(id, now).await?,
            Action::Prioritise { priority, .. } => store.prioritise_job(id, *priority, now).await?,
            Action::List(_) | Action::Show { .. } | Action::Files { .. } => id.clone(),
        };
        changed.push(store.queue_show(&candidate).await?.job);
    }
    store.close().await;
    Ok(())
}

/// What was done, in words.
pub fn outcome(action: &Action, job: &Job) -> String {
    let Job { candidate, state, priority, .. } = job;
    match action {
        Action::Drop { .. } => format!("{candidate} is dropped: it will not be labelled, and not exported"),
        Action::Prioritise { .. } => format!("{candidate} has priority {priority} now"),
        _ => format!("{candidate} is {state} again"),
    }
}

/// Its state, whether there is a label while it waits for another, and whether that is excluded.
fn state_of(job: &Job) -> String {
    let excluded = if job.excluded.is_some() { ", excluded" } else { "" };
    match (&job.relabel, job.state) {
        (Some(_), JobState::Queued | JobState::Leased) => format!("{} again{excluded}", job.state),
        _ => format!("{}{excluded}", job.state),
    }
}

fn write_list(out: &mut dyn Write, jobs: &[Job], list: &List) -> io::Result<()> {
    if jobs.is_empty() {
        let state = list.state.map_or(String::new(), |state| format!(" that are {state}"));
        return writeln!(out, "no jobs{state} beyond the first {}", list.offset);
    }
    let mut table = Table::new(&[
        "id",
        "state",
        ">priority",
        ">atoms",
        "formula",
        ">γ_max",
        ">attempts",
        ">failed",
        "protocol",
    ]);
    for job in jobs {
        table.push(vec![
            job.candidate.clone(),
            state_of(job),
            job.priority.to_string(),
            job.atoms.to_string(),
            job.formula.clone(),
            decimals(job.original_gamma, 2),
            job.attempts.to_string(),
            job.failures.to_string(),
            job.protocol.clone(),
        ]);
    }
    table.write(out)?;
    if jobs.len() as u64 == u64::from(list.limit) {
        let next = u64::from(list.offset) + u64::from(list.limit);
        writeln!(out, "… there may be more: --offset {next} goes on, --limit changes the number")?;
    }
    Ok(())
}

fn write_details(out: &mut dyn Write, details: &JobDetails) -> io::Result<()> {
    let Job {
        job,
        candidate,
        protocol,
        state,
        priority,
        holder,
        expires,
        atoms,
        formula,
        original_gamma,
        relabel,
        excluded,
        ..
    } = &details.job;
    writeln!(out, "{candidate}")?;
    writeln!(out, "  job       {job}, protocol '{protocol}'")?;
    writeln!(out, "  state     {state}, priority {priority}")?;
    if let Some(reason) = relabel {
        writeln!(out, "  again     another label was asked for: {reason}")?;
    }
    if let Some(reason) = excluded {
        writeln!(out, "  excluded  its label is left out of exports and statistics: {reason}")?;
    }
    if let (Some(holder), Some(expires)) = (holder, expires) {
        let left = (expires - unix_milliseconds()) / 1000;
        writeln!(out, "  held by   {holder}, for {left} s more")?;
    }
    writeln!(out, "  atoms     {atoms}, {formula}")?;
    writeln!(out, "  γ_max     {} (original mixture)", decimals(*original_gamma, 3))?;
    for (standing, energy) in &details.energies {
        let standing = format!("{standing:?}").to_lowercase();
        writeln!(out, "  {standing:<9} energy {energy:.6} eV, {:.6} eV/atom", energy / f64::from(*atoms))?;
    }
    writeln!(
        out,
        "  attempts  {}, {} failed since it was queued",
        details.job.attempts, details.job.failures
    )?;
    details.attempts_made.iter().try_for_each(|attempt| write_attempt(out, attempt))
}

fn write_files(out: &mut dyn Write, written: &[(PathBuf, String)]) -> io::Result<()> {
    if written.is_empty() {
        writeln!(out, "no directory of a calculation is kept (label.keep says which are)")?;
    }
    for (path, left_out) in written {
        writeln!(out, "{}", path.display())?;
        left_out.lines().try_for_each(|line| writeln!(out, "  without {line}: too large"))?;
    }
    Ok(())
}

fn write_attempt(out: &mut dyn Write, attempt: &Attempt) -> io::Result<()> {
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
    let outcome = outcome.as_deref().unwrap_or("under way");
    let lasted = ended.map(|ended| (ended - started) as f64 / 1000.0);
    let lasted = lasted.map_or(String::new(), |seconds| format!(" after {seconds:.1} s"));
    let class = class.as_ref().map_or(String::new(), |class| format!(" ({class})"));
    writeln!(out, "    {number}: {outcome}{class}{lasted}, by {holder}")?;
    if let Some(calculation) = calculation {
        writeln!(out, "       calculation {calculation}")?;
    }
    if let (Some(seconds), Some(cores)) = (core_seconds, made.cores) {
        writeln!(out, "       took {seconds:.1} core-seconds on {}", count(cores, "core"))?;
    }
    if let Some(remedies) = &made.remedies {
        writeln!(out, "       changed after failures: {}", remedies.replace(',', ", "))?;
    }
    let difference = made.difference.as_deref().unwrap_or_default();
    difference.lines().try_for_each(|line| writeln!(out, "       {line}"))?;
    let log = log.as_deref().unwrap_or_default();
    log.lines().try_for_each(|line| writeln!(out, "       | {line}"))
}
