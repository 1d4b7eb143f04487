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
    let last = store.first_decision_of(version).await?;
    let bar = Bar::new(last.map(i64::unsigned_abs), BAR);
    let on_decision = |decision: i64| bar.set(decision.unsigned_abs(), String::new);
    MixtureStream::open(store, original, begin).await?.advance_to(version, on_decision).await
}

/// The mixtures of a campaign, or of one version of its potential, from the first on.
pub struct MixtureStream<'a> {
    store: &'a Store,
    original: &'a Artifact,
    history: MixtureHistory,
    /// Sequence number of the last decision that was applied.
    applied: i64,
    other_processor: bool,
}

impl<'a> MixtureStream<'a> {
    /// The stream at its first mixture; see [`mixture_of`].
    pub async fn open(
        store: &'a Store,
        original: &'a Artifact,
        begin: Option<&LoggedDecision>,
    ) -> Result<Self, CommandError> {
        let record = store.campaign().await?;
        let settings = recorded_settings(&record)?;
        let other_processor = is_other_processor(&resolved(&record)?);
        let (applied, at_begin) = begin.map_or((0, 0), |begin| (begin.sequence, begin.mixture_version));
        let history = MixtureHistory::new(settings.search, Arc::new(original.mixture.at_version(at_begin)));
        Ok(Self { store, original, history, applied, other_processor })
    }

    /// Goes on to a version, and calls `on_decision` with the number of each decision on the way.
    ///
    /// # Errors
    /// See [`mixture_of`]; also an earlier version.
    pub async fn advance_to(
        &mut self,
        version: u64,
        on_decision: impl Fn(i64),
    ) -> Result<Arc<Mixture>, CommandError> {
        if self.history.mixture().version() < version {
            let last = self.store.first_decision_of(version).await?.ok_or_else(|| no_decision(version))?;
            for first in follow::pages(self.applied + 1, last) {
                for decision in follow::page(self.store, first, last).await? {
                    self.apply(&decision, version).await?;
                    on_decision(decision.sequence);
                }
            }
        }
        let mixture = Arc::clone(self.history.mixture());
        if mixture.version() == version { Ok(mixture) } else { Err(no_decision(version)) }
    }

    async fn apply(&mut self, decision: &LoggedDecision, version: u64) -> Result<(), CommandError> {
        let update = match self.history.is_update(decision) {
            true => apply_update(self.store, &mut self.history, decision, self.original).await?,
            false => self.history.apply(decision, None).map_err(failure)?,
        };
        self.applied = decision.sequence;
        match update {
            Some(now) => check(version, decision, &now, self.other_processor_note()),
            None => Ok(()),
        }
    }

    /// What may explain a difference, if the campaign began on another type of processor.
    pub fn other_processor_note(&self) -> &'static str {
        match self.other_processor {
            true => {
                " (the campaign was started on another type of processor, whose floating-point results differ)"
            }
            false => "",
        }
    }
}

fn no_decision(version: u64) -> CommandError {
    CommandError::Failed(format!("mixture version {version}: no decision made it: the database is damaged"))
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
fn check(version: u64, decision: &LoggedDecision, now: &Value, note: &str) -> Result<(), CommandError> {
    let Some((what, recorded, now)) =
        first_difference("decision.detail.update", &decision.detail["update"], now)
    else {
        return Ok(());
    };
    Err(CommandError::Failed(format!(
        "mixture version {version} cannot be computed again: decision {} is not reproduced: {what} was {recorded}, and is now {now}\
         {note}",
        decision.sequence
    )))
}
