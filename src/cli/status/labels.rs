//! What labels cost and which of them failed, in `calmwalk status`.

use std::io::{self, Write};

use serde_json::{Value, json};
use store::{FailureCount, JobState, Labels, Status, Store, StoreError, Unlabelled};

use super::page::{Page, cut};
use super::processes::since;
use crate::label_cost::{self, QueueCost, two_digits};
use crate::output::count;
use crate::unlabelled;

/// Labelled structures that are looked through for ranges of grades and volumes, at most.
const LOOKED_THROUGH: u64 = 20_000;

/// What is known of the labels of the protocol in force.
#[derive(Clone, Debug, Default)]
pub struct LabelsSoFar {
    pub(super) bill: QueueCost,
    pub(super) failures: Vec<FailureCount>,
    pub(super) unlabelled: Vec<Unlabelled>,
    /// What became of label jobs by each protocol, in words.
    pub(super) by_protocol: Vec<String>,
    /// Control frames that are the structures of their biased walks, which have one label each; not counted in large campaigns.
    pub(super) shared: Option<u64>,
}

impl LabelsSoFar {
    /// Reads it; nothing without a protocol.
    pub async fn of(store: &Store, status: &Status) -> Result<Self, StoreError> {
        let shared = match status.candidates.control <= LOOKED_THROUGH {
            true => Some(store.structures_of_both_origins().await?.len() as u64),
            false => None,
        };
        let Some(protocol) = store.protocol_in_force().await? else {
            return Ok(Self { shared, ..Self::default() });
        };
        let failures = store.failures(protocol.hash).await?;
        let unlabelled = match (status.labels.failed, status.labels.labelled) {
            (0, _) => Vec::new(),
            (_, labelled) => store.unlabelled(protocol.hash, labelled <= LOOKED_THROUGH).await?,
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

    /// What labels have cost and will.
    pub fn bill(&self) -> &QueueCost {
        &self.bill
    }

    /// Adds it to the state of a campaign.
    pub fn add_to(&self, json: &mut Value, status: &Status) {
        json["labels_per_hour"] = json!(per_hour(status));
        json["cost"] = json!({ "core_hours": status.budget.used.core_hours, "queue": self.bill });
        json["failures"] = json!(self.failures);
        json["unlabelled"] = json!(self.unlabelled);
        json["shared_structures"] = json!(self.shared);
    }

    /// The queue, what it costs, failures and what is unlabelled because of them.
    pub fn write(&self, out: &mut dyn Write, page: &Page, status: &Status) -> io::Result<()> {
        page.titled(out, "labels", &queue(status))?;
        if let Some(again) = again(&status.labels) {
            page.titled(out, "", &again)?;
        }
        if self.by_protocol.len() > 1 {
            page.titled(out, "protocols", &self.by_protocol.join("; "))?;
        }
        page.titled(out, "", &made(status))?;
        page.titled(out, "cost", &self.cost(status.budget.used.core_hours))?;
        for (k, failure) in self.failures.iter().take(page.few).enumerate() {
            page.titled(out, if k == 0 { "failures" } else { "" }, &in_words(failure))?;
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
                    "{used}; that of {} to come is unknown before a first one",
                    count(*unfinished, "label")
                ),
            };
        };
        let in_vain = match *overhead > 1.005 {
            true => format!(", attempts in vain add {:.0} %", 100.0 * (overhead - 1.0)),
            false => String::new(),
        };
        let done = match hours_left {
            Some(hours) => format!("done in {} h on {} at work", two_digits(*hours), count(*cores, "core")),
            None => "nobody is at work on them".to_owned(),
        };
        format!(
            "{used}; {} to come: about {remaining} as {} so far{in_vain}; {done}",
            count(*unfinished, "label"),
            count(*measured, "label")
        )
    }
}

fn queue(status: &Status) -> String {
    let Labels { queued, leased, labelled, failed, dropped, superseded, excluded, .. } = &status.labels;
    let oldest = status.oldest_lease.as_ref();
    let oldest = oldest.map_or(String::new(), |lease| format!(" (the oldest for {})", since(lease.started)));
    let superseded = if *superseded > 0 { format!(", {superseded} superseded") } else { String::new() };
    let excluded =
        if *excluded > 0 { format!(", {excluded} labels excluded by hand") } else { String::new() };
    let imported = status.imported;
    format!(
        "{queued} queued, {leased} leased{oldest}, {labelled} labelled, {failed} failed, {dropped} dropped{superseded}{excluded}; \
         {} imported",
        count(imported, "structure")
    )
}

/// What is labelled again, and what could not be.
fn again(labels: &Labels) -> Option<String> {
    let said = [
        (labels.again, "of those that wait keep their labels until the new ones come"),
        (labels.again_in_vain, "could not be labelled again and keep their labels"),
    ];
    let said: Vec<_> = said.iter().filter(|(count, _)| *count > 0).collect();
    let said: Vec<_> = said.iter().map(|(count, what)| format!("{count} {what}")).collect();
    (!said.is_empty()).then(|| said.join("; "))
}

/// A text for each protocol.
fn by_protocol(jobs: &[(String, JobState, u64)], in_force: &str) -> Vec<String> {
    let of_one = |jobs: &[(String, JobState, u64)]| {
        let name = &jobs[0].0;
        let counts: Vec<_> = jobs.iter().map(|(_, state, count)| format!("{count} {state}")).collect();
        let which = if name == in_force { " (in force)" } else { "" };
        format!("'{name}'{which}: {}", counts.join(", "))
    };
    jobs.chunk_by(|a, b| a.0 == b.0).map(of_one).collect()
}

fn made(status: &Status) -> String {
    let average = per_hour(status)
        .map_or(String::new(), |average| format!("; {} an hour on average", two_digits(average)));
    format!("{} made in the last hour{average}", status.labels_last_hour)
}

/// Labels that were made by the time for which the campaign was under way.
fn per_hour(status: &Status) -> Option<f64> {
    let used = &status.budget.used;
    (used.wall_hours > 0.0).then(|| used.labels as f64 / used.wall_hours)
}

fn in_words(failure: &FailureCount) -> String {
    let FailureCount { class, labelled, given_up, unfinished } = failure;
    let (class, jobs) = (class.replace('_', " "), labelled + given_up + unfinished);
    format!("{class} in {jobs}: {labelled} labelled later, {given_up} given up, {unfinished} open")
}
