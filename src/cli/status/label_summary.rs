//! The label queue, costs and failures in `calmwalk status`.

use std::io::{self, Write};

use serde_json::{Value, json};
use store::{FailureCount, JobState, Labels, Status, Store, StoreError, Unlabelled};

use super::page::{Page, cut};
use super::processes::since;
use crate::label_cost::{self, QueueCost, two_digits};
use crate::output::count;
use crate::unlabelled;

/// Largest number of labelled structures for which ranges of grades and volumes are computed.
const MAX_STRUCTURES: u64 = 20_000;

/// Costs and failures of the labels of the current protocol.
#[derive(Clone, Debug, Default)]
pub struct LabelSummary {
    pub(super) bill: QueueCost,
    pub(super) failures: Vec<FailureCount>,
    pub(super) unlabelled: Vec<Unlabelled>,
    /// The states of label jobs by protocol, as text.
    pub(super) by_protocol: Vec<String>,
    /// Structures found by both biased and control walks, with one label each; not counted in large campaigns.
    pub(super) shared: Option<u64>,
}

impl LabelSummary {
    /// Reads the store. Empty if there is no protocol yet.
    pub async fn read(store: &Store, status: &Status) -> Result<Self, StoreError> {
        let shared = match status.candidates.control <= MAX_STRUCTURES {
            true => Some(store.structures_of_both_origins().await?.len() as u64),
            false => None,
        };
        let Some(protocol) = store.protocol_in_force().await? else {
            return Ok(Self { shared, ..Self::default() });
        };
        let failures = store.failures(protocol.hash).await?;
        let unlabelled = match (status.labels.failed, status.labels.labelled) {
            (0, _) => Vec::new(),
            (_, labelled) => store.unlabelled(protocol.hash, labelled <= MAX_STRUCTURES).await?,
        };
        let by_protocol = by_protocol(&store.jobs_by_protocol().await?, &protocol.name);
        Ok(Self {
            bill: label_cost::queue_cost(store, protocol.hash).await?,
            failures,
            unlabelled,
            by_protocol,
            shared,
        })
    }

    /// Costs of the labels so far, and of the queued ones.
    pub fn bill(&self) -> &QueueCost {
        &self.bill
    }

    /// Adds the summary to the JSON output.
    pub fn add_to(&self, json: &mut Value, status: &Status) {
        json["labels_per_hour"] = json!(per_hour(status));
        json["cost"] = json!({ "core_hours": status.budget.used.core_hours, "queue": self.bill });
        json["failures"] = json!(self.failures);
        json["unlabelled"] = json!(self.unlabelled);
        json["shared_structures"] = json!(self.shared);
    }

    /// Writes the state of the queue, costs, failures and the structures without labels.
    pub fn write(&self, out: &mut dyn Write, page: &Page, status: &Status) -> io::Result<()> {
        page.titled(out, "labels", &describe_queue(status))?;
        if let Some(relabelling) = describe_relabelling(&status.labels) {
            page.titled(out, "", &relabelling)?;
        }
        if self.by_protocol.len() > 1 {
            page.titled(out, "protocols", &self.by_protocol.join("; "))?;
        }
        page.titled(out, "", &describe_rate(status))?;
        page.titled(out, "cost", &self.cost(status.budget.used.core_hours))?;
        for (k, failure) in self.failures.iter().take(page.few).enumerate() {
            page.titled(out, if k == 0 { "failures" } else { "" }, &describe_failure(failure))?;
        }
        if self.failures.len() > page.few {
            page.titled(out, "", &format!("… and {} more classes", self.failures.len() - page.few))?;
        }
        unlabelled::describe(&self.unlabelled, 12, page.few)
            .lines()
            .try_for_each(|line| writeln!(out, "{}", cut(line, page.width)))
    }

    fn cost(&self, used: f64) -> String {
        let QueueCost { unfinished, remaining, hours_left, cores, measured, overhead } = &self.bill;
        let used = format!("{} core-hours so far", two_digits(used));
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
            Some(hours) => format!("done in {} h on {}", two_digits(*hours), count(*cores, "core")),
            None => "no active labellers".to_owned(),
        };
        format!(
            "{used}; {} to come: about {remaining}, from {} so far{failures}; {done}",
            count(*unfinished, "label"),
            count(*measured, "label")
        )
    }
}

fn describe_queue(status: &Status) -> String {
    let Labels { queued, leased, labelled, failed, dropped, superseded, excluded, .. } = &status.labels;
    let oldest = status.oldest_lease.as_ref();
    let oldest = oldest.map_or(String::new(), |lease| format!(" (oldest for {})", since(lease.started)));
    let superseded = if *superseded > 0 { format!(", {superseded} superseded") } else { String::new() };
    let excluded = if *excluded > 0 { format!(", {excluded} labels excluded") } else { String::new() };
    let imported = status.imported;
    format!(
        "{queued} queued, {leased} leased{oldest}, {labelled} labelled, {failed} failed, {dropped} dropped{superseded}{excluded}; \
         {} imported",
        count(imported, "structure")
    )
}

/// Structures that are relabelled, and failed attempts at it.
fn describe_relabelling(labels: &Labels) -> Option<String> {
    let parts = [
        (labels.again, "being relabelled keep their labels until then"),
        (labels.again_in_vain, "failed to be relabelled and keep their labels"),
    ];
    let parts = parts.iter().filter(|(count, _)| *count > 0);
    let parts: Vec<_> = parts.map(|(count, what)| format!("{count} {what}")).collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

/// One text per protocol.
fn by_protocol(jobs: &[(String, JobState, u64)], in_force: &str) -> Vec<String> {
    let of_one = |jobs: &[(String, JobState, u64)]| {
        let name = &jobs[0].0;
        let counts: Vec<_> = jobs.iter().map(|(_, state, count)| format!("{count} {state}")).collect();
        let current = if name == in_force { " (current)" } else { "" };
        format!("'{name}'{current}: {}", counts.join(", "))
    };
    jobs.chunk_by(|a, b| a.0 == b.0).map(of_one).collect()
}

fn describe_rate(status: &Status) -> String {
    let average = per_hour(status)
        .map_or(String::new(), |average| format!("; {} per hour on average", two_digits(average)));
    format!("{} computed in the last hour{average}", status.labels_last_hour)
}

/// Average number of labels per hour of running time.
fn per_hour(status: &Status) -> Option<f64> {
    let used = &status.budget.used;
    (used.wall_hours > 0.0).then(|| used.labels as f64 / used.wall_hours)
}

fn describe_failure(failure: &FailureCount) -> String {
    let FailureCount { class, labelled, given_up, unfinished } = failure;
    let (class, jobs) = (class.replace('_', " "), labelled + given_up + unfinished);
    format!("{class} in {jobs}: {labelled} labelled later, {given_up} failed, {unfinished} open")
}
