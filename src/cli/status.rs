//! `calmwalk status`

mod batch_jobs;
mod labels;
mod mixture;
pub mod page;
mod processes;
#[cfg(test)]
pub mod tests;
mod versions;
pub mod walks;

use std::io::{self, Write};

use monitor::Snapshot;
use monitor::disk::DiskUse;
use monitor::expected_end::ExpectedEnd;
use monitor::label_cost::SECONDS_PER_HOUR;
use monitor::reference_check::ReferenceCheck;
use monitor::walk_ends::WalkEnds;
use store::{CampaignStatus, Candidates, Location, Store, unix_milliseconds};
use wire::DeviceStatistics;

use self::batch_jobs::BatchJobs;
pub use self::labels::describe_queue;
use self::page::{StatusLayout, cut};
pub use self::processes::state;
use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{count, decimals, print, print_json};
use crate::wording::candidates;
use crate::wording::cost::wall_time;
use crate::wording::disk::megabytes;
use crate::wording::{self, budget, reference_check, walk_ends};

/// Show the progress of a campaign
///
/// Shows walks, mixture, label queue, costs, processes and the expected end. Works on running and finished campaigns and on
/// backups. docs/status.md describes the JSON output.
#[derive(Debug, clap::Args)]
pub struct StatusArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Show all walks, processes and versions of the potential, and the forgetting of each element and component [default: a selection that
    /// fits a screen; JSON always contains all]
    #[arg(long)]
    all: bool,
    /// Number of walks to show, or all: running walks with the largest γ first [default: as many as fit a screen]
    #[arg(long, value_name = "NUMBER", value_parser = page::parse_walks)]
    walks: Option<usize>,
}

impl StatusArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let location = self.location.get()?;
        let snapshot = block_on(read(&location))??;
        let jobs = block_on(BatchJobs::query(&location))?;
        if self.json {
            let mut json = wording::json::snapshot(&snapshot).map_err(CommandError::failed)?;
            jobs.add_to(&mut json);
            print_json(&json)?;
        } else {
            let page = if self.all { StatusLayout::unlimited() } else { StatusLayout::unlimited().screen() };
            print(|out| write(out, &snapshot, &jobs, page, self.walks))?;
        }
        Ok(ExitStatus::Done)
    }
}

async fn read(location: &Location) -> Result<Snapshot, CommandError> {
    let store = Store::open_read_only(location).await?;
    let snapshot = Snapshot::read(&store).await?;
    store.close().await;
    Ok(snapshot)
}

/// The output of `--all` in lines of at most `width` columns, without the jobs of a batch system.
pub fn text(snapshot: &Snapshot, width: usize) -> String {
    let (mut text, page) = (Vec::new(), StatusLayout { width, ..StatusLayout::unlimited() });
    // Writing to memory cannot fail.
    let _ = write(&mut text, snapshot, &BatchJobs::None, page, None);
    String::from_utf8_lossy(&text).into_owned()
}

fn write(
    out: &mut dyn Write,
    snapshot: &Snapshot,
    jobs: &BatchJobs,
    page: StatusLayout,
    walks: Option<usize>,
) -> io::Result<()> {
    let mut head = Vec::new();
    write_head(&mut head, snapshot, &page)?;
    out.write_all(&head)?;
    let lines = head.iter().filter(|byte| **byte == b'\n').count();
    let page = page.fitted(lines, if matches!(jobs, BatchJobs::Known(_)) { 3 } else { 2 }, walks);
    let status = &snapshot.status;
    if page.is_unlimited() {
        versions::write(out, &snapshot.versions, &page)?;
        mixture::write_forgetting(out, &snapshot.mixture, &page)?;
    }
    walks::write(out, &status.walks, status.run_active, &page)?;
    processes::write(out, &status.processes, &page)?;
    jobs.write(out, &page)
}

fn write_head(out: &mut dyn Write, snapshot: &Snapshot, page: &StatusLayout) -> io::Result<()> {
    let Snapshot { campaign, origin, status, mixture, disk, labels, check, versions, devices, .. } = snapshot;
    let (name, mode) = (origin.as_ref().map_or("", |origin| &origin.name), &campaign.mode);
    let id = campaign.id.to_string();
    // Ids of candidates start with the same eight characters.
    let id = if page.is_unlimited() || name.is_empty() { &id[..] } else { &id[..8] };
    let separator = if name.is_empty() { "" } else { ", " };
    let round = if status.round == 0 { String::new() } else { format!(", round {}", status.round) };
    page.titled(out, "campaign", &format!("{name}{separator}{id}, {mode} mode{round}"))?;
    if let Some(origin) = origin.as_ref().filter(|_| page.is_unlimited()) {
        page.titled(out, "", &format!("configured by {}", origin.file.path))?;
    }
    let checked = check.as_ref().filter(|_| !page.is_unlimited()).map(reference_check::state);
    let checked = checked.map_or(String::new(), |checked| format!("; reference check {checked}"));
    page.titled(out, "state", &format!("{}{checked}", state(status)))?;
    let ends = WalkEnds::from_walks(&status.walks);
    page.titled(out, "walks", &describe_walks(status, &ends))?;
    if page.is_unlimited() {
        walk_ends::early_ends(&ends).iter().try_for_each(|line| page.titled(out, "", line))?;
    } else {
        let advice =
            ends.causes().map(|(cause, _)| format!("{}: try {}", walk_ends::cause(cause), cause.advice()));
        advice.take(page.few).try_for_each(|line| page.titled(out, "", &line))?;
    }
    versions::write_head(out, versions, page)?;
    let potential = if page.is_unlimited() { String::new() } else { versions::short(versions) };
    page.titled(out, "mixture", &format!("version {}{potential}", status.mixture_version))?;
    mixture::write(out, mixture, page, &campaign.mode)?;
    write_candidates(out, page, &status.candidates, mixture.left_out(), labels.shared)?;
    labels::write(out, labels, page, status)?;
    if let Some(check) = check.as_ref().filter(|_| page.is_unlimited()) {
        write_check(out, page, check)?;
    }
    if let Some(budget) = budget::describe(&status.budget) {
        page.titled(out, "budget", &budget)?;
    }
    if let Some(total) = DeviceStatistics::total(devices).filter(|_| page.is_unlimited()) {
        page.titled(out, "device", &wording::device::describe(&total))?;
        let each = devices.iter().filter(|_| devices.len() > 1);
        each.map(wording::device::describe).try_for_each(|line| page.titled(out, "", &line))?;
    }
    page.titled(out, "disk", &describe_disk(disk, page, status))?;
    match end(snapshot) {
        Some(end) => page.titled(out, "end", &end),
        None => Ok(()),
    }
}

/// The check of the reference with its differences.
fn write_check(out: &mut dyn Write, page: &StatusLayout, check: &ReferenceCheck) -> io::Result<()> {
    page.titled(out, "check", &format!("reference {}", reference_check::summary(check)))?;
    reference_check::faults(check).try_for_each(|fault| page.titled(out, "", &fault))?;
    reference_check::table(check).lines().try_for_each(|line| writeln!(out, "{}", cut(line, page.width)))
}

fn describe_disk(disk: &DiskUse, page: &StatusLayout, status: &CampaignStatus) -> String {
    let now = megabytes(disk.bytes);
    let Some((forecast, end)) = disk.forecast.zip(disk.at_the_end(status)) else {
        return format!("{now} now");
    };
    let end = format!("{now} now; about {} at the end", megabytes(end));
    match page.is_unlimited() {
        true => {
            let declined = megabytes(forecast.declined);
            format!("{end}, plus up to {declined} for features of declined candidates")
        }
        false => end,
    }
}

/// The expected end, or why the campaign ended; `None` if it is unknown.
pub fn end(snapshot: &Snapshot) -> Option<String> {
    let reason = || snapshot.end_reason.as_ref().map(wording::end_reason::describe);
    expected_end(&snapshot.end).or_else(reason)
}

/// The expected end as text; `None` if it is unknown.
fn expected_end(end: &ExpectedEnd) -> Option<String> {
    let milliseconds = end.time? - unix_milliseconds();
    let within = wall_time(milliseconds.max(0) as f64 / 1000.0);
    let part = |what: &str, hours: Option<f64>| {
        hours.map(|hours| format!("{what} {}", wall_time(hours * SECONDS_PER_HOUR)))
    };
    let parts =
        [part("walks", end.walks_hours), part("labels", end.labels_hours), part("budget", end.budget_hours)];
    let parts: Vec<_> = parts.into_iter().flatten().collect();
    Some(format!("expected within {within} ({})", parts.join(", ")))
}

fn describe_walks(status: &CampaignStatus, ends: &WalkEnds) -> String {
    let under_way = status.walks.iter().filter(|walk| walk.is_active()).count();
    let state = if status.run_active { "running" } else { "unfinished" };
    let ended = match ends.ended() {
        0 => String::new(),
        ended => format!("{ended} ended ({})", walk_ends::without_causes(ends)),
    };
    let speed = status.steps_per_second.filter(|_| under_way > 0);
    let speed = speed.map_or(String::new(), |speed| format!(" ({} steps/s)", decimals(Some(speed), 1)));
    let going = if under_way > 0 { format!("{under_way} {state}{speed}") } else { String::new() };
    let parts: Vec<_> = [going, ended].into_iter().filter(|part| !part.is_empty()).collect();
    if parts.is_empty() { "none yet".to_owned() } else { parts.join(", ") }
}

fn write_candidates(
    out: &mut dyn Write,
    page: &StatusLayout,
    candidates: &Candidates,
    left_out: u64,
    shared: Option<u64>,
) -> io::Result<()> {
    let Candidates { seen, accepted, declined, control, rejected_by_guards } = candidates;
    let is_shown = |number: u64| number > 0 || page.is_unlimited();
    let declined = candidates::declined(declined, page.is_unlimited());
    page.titled(out, "candidates", &format!("{seen} seen, {accepted} accepted{declined}"))?;
    let shared = match shared {
        None | Some(0) => String::new(),
        Some(shared) if page.is_unlimited() => format!(
            " ({shared} of them also found by biased walks: {} in total)",
            count(accepted + control - shared, "label")
        ),
        Some(shared) => format!(" ({shared} also biased)"),
    };
    let mut parts = Vec::new();
    if is_shown(*control) {
        parts.push(format!("{}{shared}", count(*control, "control frame")));
    }
    if is_shown(*rejected_by_guards) {
        parts.push(format!("{rejected_by_guards} rejected by guards"));
    }
    if left_out > 0 {
        parts.push(format!("{left_out} left out (the decision log has the reasons)"));
    }
    if parts.is_empty() { Ok(()) } else { page.titled(out, "", &parts.join("; ")) }
}
