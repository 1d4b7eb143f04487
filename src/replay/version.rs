//! Computes the mixture of an earlier version, which the store does not keep.

use std::sync::Arc;

use calm::{Artifact, Mixture};
use orchestrator::selector::{AcceptedAtoms, MixtureHistory};
use serde_json::Value;
use store::{LoggedDecision, Store};

use super::report::first_difference;
use super::{BAR, failure, follow, is_other_processor, recorded_settings, resolved};
use crate::exit_status::CommandError;
use crate::output::Bar;

/// The mixture of a version between the first and the newest, by the accepted candidates before it. `original` is the artifact
/// with which the campaign began, or that of the version of the potential that the decision `begin` switched to.
///
/// # Errors
/// Updates that are not reproduced as recorded; a damaged database.
pub async fn mixture_of(
    store: &Store,
    version: u64,
    original: &Artifact,
    begin: Option<&LoggedDecision>,
) -> Result<Arc<Mixture>, CommandError> {
    let record = store.campaign().await?;
    let settings = recorded_settings(&record)?;
    let other_processor = is_other_processor(&resolved(&record)?);
    let last = store.first_decision_of(version).await?.ok_or_else(|| {
        CommandError::Failed(format!(
            "mixture version {version}: no decision made it: the database is damaged"
        ))
    })?;
    let (before, at_begin) = begin.map_or((0, 0), |begin| (begin.sequence, begin.mixture_version));
    let mut history = MixtureHistory::new(settings.search, Arc::new(original.mixture.at_version(at_begin)));
    let bar = Bar::new(Some(last.unsigned_abs()), BAR);
    for first in follow::pages(before + 1, last) {
        for decision in follow::page(store, first, last).await? {
            let update = match history.is_update(&decision) {
                true => apply_update(store, &mut history, &decision, original).await?,
                false => history.apply(&decision, None).map_err(failure)?,
            };
            if let Some(now) = update {
                check(version, &decision, &now, other_processor)?;
            }
            bar.set(decision.sequence.unsigned_abs(), String::new);
        }
    }
    Ok(Arc::clone(history.mixture()))
}

/// Updates the mixture with the candidate of a decision. Returns what the log should have of the update.
async fn apply_update(
    store: &Store,
    history: &mut MixtureHistory,
    decision: &LoggedDecision,
    original: &Artifact,
) -> Result<Option<Value>, CommandError> {
    let missing = |what| follow::damaged(decision.sequence, what);
    let name = decision.candidate.as_deref().unwrap_or_default();
    let candidate = store.candidate(name).await?.ok_or_else(|| missing("its candidate is missing"))?;
    let features = candidate.features.ok_or_else(|| missing("the features of its candidate are missing"))?;
    let index = |symbol: &str| original.symbols.iter().position(|known| known == symbol);
    let species = candidate.block.view().structure().species;
    let elements: Option<Vec<usize>> = species.iter().map(|species| index(species.symbol())).collect();
    let elements = elements.ok_or_else(|| missing("the artifact lacks an element of its candidate"))?;
    let atoms = AcceptedAtoms { elements: &elements, features: &features };
    history.apply(decision, Some(atoms)).map_err(failure)
}

/// Compares an update with its record.
fn check(
    version: u64,
    decision: &LoggedDecision,
    now: &Value,
    other_processor: bool,
) -> Result<(), CommandError> {
    let Some((what, recorded, now)) =
        first_difference("decision.detail.update", &decision.detail["update"], now)
    else {
        return Ok(());
    };
    let processor = match other_processor {
        true => {
            " (the campaign was started on another type of processor, whose floating-point results differ)"
        }
        false => "",
    };
    Err(CommandError::Failed(format!(
        "mixture version {version} cannot be computed again: decision {} is not reproduced: {what} was {recorded}, and is now {now}\
         {processor}",
        decision.sequence
    )))
}
