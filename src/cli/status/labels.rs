//! The label queue, costs and failures in `calmwalk status`.

use std::io::{self, Write};

use monitor::label_cost::{QueueCost, SECONDS_PER_HOUR};
use monitor::label_queue::{LabelQueue, ProtocolJobs, labels_per_hour};
use store::{CampaignStatus, FailureCount, LabelJobCounts, unix_milliseconds};

use super::page::{StatusLayout, cut};
use super::processes::since;
use crate::output::count;
use crate::wording::cost::{core_hours, core_time, two_digits, wall_time};
use crate::wording::{label_progress, unlabelled};

/// Writes the state of the queue, costs, failures and the structures without labels.
pub fn write(
    out: &mut dyn Write,
    queue: &LabelQueue,
    page: &StatusLayout,
    status: &CampaignStatus,
) -> io::Result<()> {
    page.titled(out, "labels", &describe_queue(status, page.is_unlimited()))?;
    let now = unix_milliseconds();
    for progress in queue.running.iter().take(page.few) {
        page.titled(out, "", &label_progress::describe(progress, now))?;
    }
    if let Some(relabelling) = describe_relabelling(&status.labels) {
        page.titled(out, "", &relabelling)?;
    }
    if status.labels.lower_states > 0 {
        let structures = count(status.labels.lower_states, "structure");
        page.titled(
            out,
            "",
            &format!("lower magnetic states are known of {structures} (see calmwalk lower-states)"),
        )?;
    }
    if queue.by_protocol.len() > 1 {
        let protocols: Vec<_> = queue.by_protocol.iter().map(describe_protocol).collect();
        page.titled(out, "protocols", &protocols.join("; "))?;
    }
    if page.is_unlimited() || (!status.finished && status.labels_last_hour > 0) {
        page.titled(out, "", &describe_rate(status))?;
    }
    let used = status.budget.used.core_hours;
    if page.is_unlimited() || used > 0.0 || queue.cost.unfinished > 0 {
        page.titled(out, "cost", &describe_cost(&queue.cost, used))?;
    }
    for (k, failure) in queue.failures.iter().take(page.few).enumerate() {
        page.titled(out, if k == 0 { "failures" } else { "" }, &describe_failure(failure))?;
    }
    if queue.failures.len() > page.few {
        page.titled(out, "", &format!("… and {} more classes", queue.failures.len() - page.few))?;
    }
    unlabelled::describe(&queue.unlabelled, 12, page.few)
        .lines()
        .try_for_each(|line| writeln!(out, "{}", cut(line, page.width)))
}

fn describe_cost(cost: &QueueCost, used: f64) -> String {
    let QueueCost { unfinished, remaining, hours_left, cores, measured, overhead } = cost;
    let used = format!("{} so far", core_time(used));
    let Some(remaining) = remaining else {
        return match unfinished {
            0 => used,
            _ => format!(
                "{used}; cost of {} to come unknown before the first one",
                count(*unfinished, "label")
            ),
        };
    };
    let failures = match *overhead > 1.005 {
        true => format!(", failed attempts add {:.0} %", 100.0 * (overhead - 1.0)),
        false => String::new(),
    };
    let done = match hours_left {
        Some(hours) => {
            format!("done in {} on {}", wall_time(hours * SECONDS_PER_HOUR), count(*cores, "core"))
        }
        None => "no active labellers".to_owned(),
    };
    format!(
        "{used}; {} to come: about {}, from {} so far{failures}; {done}",
        count(*unfinished, "label"),
        core_hours(remaining),
        count(*measured, "label")
    )
}

/// The number of jobs in each state; `all`: also of states without any.
pub fn describe_queue(status: &CampaignStatus, all: bool) -> String {
    let LabelJobCounts { queued, leased, labelled, failed, dropped, superseded, excluded, .. } =
        &status.labels;
    let oldest = status.oldest_lease.as_ref();
    let oldest = oldest.map_or(String::new(), |lease| format!(" (oldest for {})", since(lease.started)));
    let parts = [
        (*queued, format!("{queued} queued"), all),
        (*leased, format!("{leased} leased{oldest}"), all),
        (*labelled, format!("{labelled} labelled"), all),
        (*failed, format!("{failed} failed"), all),
        (*dropped, format!("{dropped} dropped"), all),
        (*superseded, format!("{superseded} superseded"), false),
        (*excluded, format!("{} excluded", count(*excluded, "label")), false),
        (status.imported, format!("{} imported", count(status.imported, "structure")), all),
    ];
    let shown = parts.into_iter().filter(|(number, _, always)| *always || *number > 0);
    let shown: Vec<_> = shown.map(|(_, text, _)| text).collect();
    if shown.is_empty() { "none yet".to_owned() } else { shown.join(", ") }
}

/// Structures that are relabelled, and failed attempts at it.
fn describe_relabelling(labels: &LabelJobCounts) -> Option<String> {
    let parts = [
        (labels.relabelling, "being relabelled keep their labels until then"),
        (labels.relabel_failed, "failed to be relabelled and keep their labels"),
    ];
    let parts = parts.iter().filter(|(count, _)| *count > 0);
    let parts: Vec<_> = parts.map(|(count, what)| format!("{count} {what}")).collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

fn describe_protocol(jobs: &ProtocolJobs) -> String {
    let ProtocolJobs { protocol, in_force, counts } = jobs;
    let counts: Vec<_> = counts.iter().map(|(state, count)| format!("{count} {state}")).collect();
    let current = if *in_force { " (current)" } else { "" };
    format!("'{protocol}'{current}: {}", counts.join(", "))
}

fn describe_rate(status: &CampaignStatus) -> String {
    let average = labels_per_hour(status)
        .map_or(String::new(), |average| format!("; {} per hour on average", two_digits(average)));
    format!("{} made in the last hour{average}", status.labels_last_hour)
}

fn describe_failure(failure: &FailureCount) -> String {
    let FailureCount { class, labelled, failed, unfinished } = failure;
    let (class, jobs) = (class.replace('_', " "), labelled + failed + unfinished);
    format!("{class} in {jobs}: {labelled} labelled, {failed} failed, {unfinished} unfinished")
}
