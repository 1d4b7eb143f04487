//! The check of the reference, before the first walk starts: labels the structures of `label.reference_check` by the campaign's own
//! method and compares the labels with what is known.
//!
//! These structures are no candidates, so their labels are no jobs of the queue: no budget, export or count has them. Only
//! this process makes them, while it leads the campaign. Their progress is in the store, by structure and protocol.

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use futures_util::future::try_join_all;
use monitor::reference_check::{CheckState, KnownStructure, METADATA_KEY, ReferenceCheck};
use serde_json::json;
use store::records::Label;
use store::{Store, StoreError, unix_milliseconds};
use wire::ContentHash;
use workers::labeller::{LabelOutcome, RecordedLabel, give_up_others};

use super::RunContext;
use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;
use crate::output::{count, log_and_print, log_and_warn, print_stderr};
use crate::wording;

/// Number of faults that the error message lists.
const MAX_FAULTS: usize = 5;

/// In place of an identity: the user accepts the differences of any check.
pub const ANY_CHECK: &str = "any";

/// Identity of the check of a campaign, which follows from the label protocol, the known labels and the bounds.
///
/// # Errors
/// There is no check.
pub fn identity(campaign: &LoadedCampaign) -> Result<String, CommandError> {
    if campaign.known.is_empty() {
        return Err(CommandError::Input(format!(
            "--accept-reference-check: {} has no label.reference_check.structures, so there is no check to accept",
            campaign.path.display()
        )));
    }
    Ok(begin(campaign).identity)
}

fn begin(campaign: &LoadedCampaign) -> ReferenceCheck {
    let bounds = campaign.config.label.reference_check.bounds();
    ReferenceCheck::begin(&campaign.protocol, &campaign.known, bounds)
}

/// Makes sure that the labels agree with what is known, or that the user accepts or has accepted the differences: `accept`
/// is the identity of the accepted check, or [`ANY_CHECK`]. Returns false if it was stopped.
///
/// # Errors
/// A difference above its bound, a label that cannot be made, errors of the database.
pub async fn run(run: RunContext<'_>, accept: Option<&str>) -> Result<bool, CommandError> {
    let RunContext { campaign, store, .. } = run;
    if campaign.known.is_empty() {
        return Ok(true);
    }
    let mut check = begin(campaign);
    let before = ReferenceCheck::read(store).await?.filter(|before| before.identity == check.identity);
    if before.is_some_and(|before| matches!(before.state, CheckState::Passed | CheckState::Accepted)) {
        return Ok(true);
    }
    let Some(labels) = label_all(run, &check).await? else { return Ok(false) };
    check.compare(&campaign.known, &labels);
    conclude(run, check, accept).await
}

/// Records and prints the result of a check that is complete.
async fn conclude(
    run: RunContext<'_>,
    mut check: ReferenceCheck,
    accept: Option<&str>,
) -> Result<bool, CommandError> {
    match accept.filter(|_| check.state != CheckState::Passed) {
        None => {}
        Some(accepted) if accepted == ANY_CHECK || accepted == check.identity => {
            check.state = CheckState::Accepted;
        }
        Some(_) => log_and_warn(
            "WARNING: --accept-reference-check accepts an earlier check: the label protocol, the structures or the bounds of label.reference_check \
             have changed since, so it does not apply",
        ),
    }
    let RunContext { store, campaign, .. } = run;
    print_stderr(wording::reference_check::table(&check).trim_end());
    write(store, &check).await?;
    let overall = json!({ "energy": check.energy(), "force": check.force(), "stress": check.stress() });
    let faults: Vec<_> = wording::reference_check::faults(&check).collect();
    let detail = json!({
        "state": check.state, "protocol": check.protocol, "structures": check.structures, "overall": overall,
        "faults": faults,
    });
    store.log_operation(unix_milliseconds(), "reference_check", &detail).await?;
    let summary = wording::reference_check::summary(&check);
    match check.state {
        CheckState::Passed | CheckState::Running => log_and_print(format_args!("reference check: {summary}")),
        CheckState::Accepted => log_and_warn(format_args!("WARNING: reference check: {summary}")),
        CheckState::Failed => return Err(refusal(&campaign.path, &faults)),
    }
    Ok(true)
}

fn refusal(config: &Path, faults: &[String]) -> CommandError {
    let mut shown = faults[..faults.len().min(MAX_FAULTS)].join("; ");
    if faults.len() > MAX_FAULTS {
        shown += &format!("; and {} more", faults.len() - MAX_FAULTS);
    }
    CommandError::Failed(format!(
        "the labels contradict the reference of label.reference_check: {shown}. No walk was started. Compare [label.method] with the \
         reference that the potential was trained on (functional, pseudopotentials, cutoff, k-points, smearing, magnetic moments, \
         which energy), and the units of the file. If you expect these differences, run calmwalk run {} --accept-reference-check, or \
         calmwalk launch with this option",
        config.display()
    ))
}

/// The labels of all structures. `None` if a stop was requested first.
async fn label_all(
    run: RunContext<'_>,
    check: &ReferenceCheck,
) -> Result<Option<Vec<Result<Label, String>>>, CommandError> {
    let RunContext { campaign, store, .. } = run;
    let (keys, bounds) = (keys(campaign), campaign.config.label.bounds());
    let attempts = campaign.config.label.max_attempts.get();
    write(store, check).await?;
    let method = campaign.method()?.load(&campaign.protocol)?;
    give_up_others(store, &method, &format!("{METADATA_KEY}/"), &keys).await?;
    method.end();
    let (mut made, mut missing) = (Vec::new(), Vec::new());
    for (index, (known, key)) in campaign.known.iter().zip(&keys).enumerate() {
        let request = RecordedLabel { key, structure: &known.structure, bounds: &bounds, attempts };
        match request.stored(store).await? {
            Some(label) => made.push((index, Ok(label))),
            None => missing.push((index, request)),
        }
    }
    if !missing.is_empty() {
        let missing = count(missing.len(), "structure");
        log_and_print(format_args!("checking the reference: labelling {missing} of label.reference_check"));
    }
    made.extend(make(run, missing).await?);
    made.sort_by_key(|(index, _)| *index);
    Ok((made.len() == keys.len()).then(|| made.into_iter().map(|(_, label)| label).collect()))
}

/// The result for the structure of this number.
type NumberedLabel = (usize, Result<Label, String>);

/// Makes labels, several at the same time; not all of them if a stop is requested.
async fn make(
    run: RunContext<'_>,
    missing: Vec<(usize, RecordedLabel<'_>)>,
) -> Result<Vec<NumberedLabel>, CommandError> {
    let RunContext { campaign, store, stop, .. } = run;
    let workers = campaign.config.label.concurrency.max(1).min(missing.len());
    let next = Mutex::new(missing.into_iter());
    let worker = async || {
        let method = campaign.method()?.load(&campaign.protocol)?;
        let mut made = Vec::new();
        loop {
            let taken = next.lock().unwrap_or_else(PoisonError::into_inner).next();
            let Some((index, request)) = taken else { break };
            let Some(outcome) = request.make(store, &method, stop).await? else { break };
            made.push((index, report(&campaign.known[index], outcome)));
        }
        method.end();
        Ok::<_, CommandError>(made)
    };
    let made = try_join_all((0..workers).map(|_| worker())).await?;
    Ok(made.into_iter().flatten().collect())
}

/// Metadata key of the progress of each label.
fn keys(campaign: &LoadedCampaign) -> Vec<String> {
    let key = |known: &KnownStructure| {
        let structure = ContentHash::from_structure(&known.structure);
        format!("{METADATA_KEY}/{}/{structure}", campaign.protocol.hash)
    };
    campaign.known.iter().map(key).collect()
}

/// Prints a line for a label.
fn report(known: &KnownStructure, outcome: LabelOutcome) -> Result<Label, String> {
    let label = outcome.label();
    match &label {
        Ok(label) => log_and_print(format_args!("labelled {}: {:.4} eV", known.source, label.energy)),
        Err(why) => log_and_warn(format_args!("no label of {}: {why}", known.source)),
    }
    label
}

async fn write(store: &Store, check: &ReferenceCheck) -> Result<(), StoreError> {
    let text = serde_json::to_string(check).expect("the differences of finite numbers become JSON");
    store.set_metadata(METADATA_KEY, &text).await
}
