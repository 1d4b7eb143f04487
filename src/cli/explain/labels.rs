//! Prints the label jobs of a candidate with their attempts, and its labels.

use std::io::{self, Write};

use monitor::candidate_details::{CandidateDetails, CandidateLabel, ForceError, LabelJob};
use monitor::label_cost::SECONDS_PER_HOUR;
use store::{Attempt, Exclusion, QueueEntry, Supersession, unix_milliseconds};

use super::line;
use crate::output::count;
use crate::wording;
use crate::wording::cost::{core_time, wall_time};

/// Lines printed from the end of a log.
const LOG_LINES: usize = 10;

/// `all`: also the logs of attempts that did not fail.
pub fn write(out: &mut dyn Write, details: &CandidateDetails, all: bool) -> io::Result<()> {
    if details.jobs.is_empty() && details.labels.is_empty() {
        return line(out, "label", "no label job: only accepted candidates and control frames get one");
    }
    details.jobs.iter().try_for_each(|job| write_job(out, job, all))?;
    details.labels.iter().try_for_each(|label| write_label(out, label, details.structure.atoms))
}

fn write_job(out: &mut dyn Write, job: &LabelJob, all: bool) -> io::Result<()> {
    let QueueEntry {
        job: number,
        protocol,
        state,
        priority,
        attempts,
        holder,
        expires,
        overruled,
        relabel,
        ..
    } = &job.details.job;
    let cost = job
        .core_seconds
        .map_or(String::new(), |seconds| format!(", {}", core_time(seconds / SECONDS_PER_HOUR)));
    line(
        out,
        "label job",
        &format!(
            "{number} by protocol '{protocol}': {state}, priority {priority}, attempts {attempts}{cost}"
        ),
    )?;
    if let (Some(holder), Some(expires)) = (holder, expires) {
        let left = (expires - unix_milliseconds()) / 1000;
        line(out, "", &format!("leased by {holder}, lease expires in {left} s"))?;
    }
    if let Some(reason) = relabel {
        line(out, "", &format!("relabelling requested: {reason}"))?;
    }
    if *overruled {
        line(out, "", "queued by the user: bypasses the labellers' guard")?;
    }
    for done in &job.manual_actions {
        let to = done.priority.map_or(String::new(), |priority| format!(", to {priority}"));
        let why = done.reason.as_ref().map_or(String::new(), |reason| format!(" ({reason})"));
        line(out, "", &format!("by the user: {}{to}{why}, {} ago", done.action, elapsed_since(done.time)))?;
    }
    job.details.attempts_made.iter().try_for_each(|attempt| write_attempt(out, attempt, all))
}

fn write_attempt(out: &mut dyn Write, attempt: &Attempt, all: bool) -> io::Result<()> {
    let Attempt { attempt: number, holder, started, ended, outcome, class, log, made, core_seconds, .. } =
        attempt;
    let outcome = outcome.as_deref().unwrap_or("running");
    let class = class.as_ref().map_or(String::new(), |class| format!(" ({})", class.replace('_', " ")));
    let lasted = match ended {
        Some(ended) => format!("after {}", wall_time((ended - started) as f64 / 1000.0)),
        None => format!("for {}", elapsed_since(*started)),
    };
    let cost = core_seconds.map_or(String::new(), |seconds| {
        format!(", {} on {}", core_time(seconds / SECONDS_PER_HOUR), count(made.cores.unwrap_or(1), "core"))
    });
    line(out, "", &format!("attempt {number}: {outcome}{class} {lasted}, by {holder}{cost}"))?;
    if let Some(remedies) = &made.remedies {
        line(out, "", &format!("  retry adjustments: {}", remedies.replace(',', ", ")))?;
    }
    let difference = made.difference.as_deref().unwrap_or_default();
    difference.lines().try_for_each(|changed| line(out, "", &format!("  {changed}")))?;
    let log = log.as_deref().filter(|_| all || !attempt.made_label());
    let log: Vec<_> = log.unwrap_or_default().lines().collect();
    let tail = &log[log.len().saturating_sub(LOG_LINES)..];
    tail.iter().try_for_each(|text| line(out, "", &format!("  | {text}")))
}

fn write_label(out: &mut dyn Write, label: &CandidateLabel, atoms: usize) -> io::Result<()> {
    let CandidateLabel { protocol, protocol_hash, status, source, energy, energy_per_atom, .. } = label;
    let status = format!("{status:?}").to_lowercase();
    line(
        out,
        &status,
        &format!(
            "energy {energy:.6} eV ({energy_per_atom:.6} eV/atom), largest force {:.4} eV/Å",
            label.max_force
        ),
    )?;
    line(out, "", &format!("protocol '{protocol}' ({}), from {source}", &protocol_hash[..16]))?;
    if let Some(moment) = label.details.magnetisation {
        line(out, "", &format!("magnetisation {moment:.4} μ_B"))?;
    }
    if let Some(adjustments) = wording::labels::retry_adjustments(&label.details.retry_adjustments) {
        line(out, "", &adjustments)?;
    }
    if let Some(Exclusion { time, reason }) = &label.excluded {
        line(
            out,
            "",
            &format!("excluded from exports and statistics {} ago: {reason}", elapsed_since(*time)),
        )?;
    }
    if let Some(Supersession { time, reason }) = &label.superseded {
        line(out, "", &format!("superseded {} ago: {reason}", elapsed_since(*time)))?;
    }
    let Some(model) = &label.model else { return Ok(()) };
    let ForceError { mean, largest, atom, .. } = model;
    line(
        out,
        "potential",
        &format!(
            "|F_model − F_label|: mean {mean:.4} eV/Å over {}, largest {largest:.4} eV/Å (atom {atom})",
            count(atoms, "atom"),
        ),
    )?;
    match model.energy_error_per_atom {
        Some(error) => line(out, "", &format!("E_model − E_label: {:.1} meV/atom", 1000.0 * error))?,
        None if model.energy_offsets.structures == 0 => {}
        None => line(out, "", "E_model − E_label: not shown, too few labels for this composition")?,
    }
    line(out, "", &wording::energies::offsets(&model.energy_offsets))
}

/// The time since then.
fn elapsed_since(time: i64) -> String {
    let seconds = (unix_milliseconds() - time).max(0) / 1000;
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        7200..172_800 => format!("{} h", seconds / 3600),
        _ => format!("{} d", seconds / 86_400),
    }
}
