//! Labels outside the queue. The store has the progress of each under a key. After a crash, the next process that makes
//! the same label reads the result, or waits for the calculation that still runs.

use std::sync::Arc;

use atoms::Structure;
use store::records::Label;
use store::{Store, StoreError};
use tokio_util::sync::CancellationToken;

use super::calculation_request::{CalculationNote, CalculationRequest};
use super::code::CodeMethod;
use super::failure_classes::failure_classes;
use super::label_attempt::LabelAttempt;
use super::label_progress::{LabelOutcome, LabelProgress};
use super::method::{Method, evaluate};
use super::validate::{LabelBounds, validate};

/// Job number in the names of directories. No job of the queue has it.
const NO_JOB: i64 = 0;

/// A label to make.
#[derive(Clone, Copy, Debug)]
pub struct RecordedLabel<'a> {
    /// Key of its progress among the store's metadata; it must identify structure and protocol.
    pub key: &'a str,
    /// The structure.
    pub structure: &'a Structure,
    /// Bounds that a valid label must satisfy.
    pub bounds: &'a LabelBounds,
    /// Attempts before the label counts as failed.
    pub attempts: u32,
}

/// Ends the calculations of labels whose keys begin with `prefix` and are not among `keys`: their results are no longer needed. What
/// cannot be ended now is tried again by the next call.
///
/// # Errors
/// Errors of the database.
pub async fn give_up_others(
    store: &Store,
    method: &Method,
    prefix: &str,
    keys: &[String],
) -> Result<(), StoreError> {
    let Method::Code(method) = method else { return Ok(()) };
    for (key, text) in store.metadata_below(prefix).await? {
        if keys.contains(&key) {
            continue;
        }
        let progress = LabelProgress::parse(&key, &text)?;
        let Some(calculation) = &progress.calculation else { continue };
        match method.give_up(calculation).await {
            Ok(()) => {
                let progress = LabelProgress { calculation: None, ..progress };
                store.set_metadata(&key, &progress.to_text()).await?;
            }
            Err(error) => tracing::warn!("cannot end a calculation that is not wanted any more: {error}"),
        }
    }
    Ok(())
}

impl RecordedLabel<'_> {
    /// The stored label, if it was made.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn stored(&self, store: &Store) -> Result<Option<Label>, StoreError> {
        Ok(self.progress(store).await?.outcome.and_then(|outcome| outcome.label().ok()))
    }

    /// Makes the label, unless the store has it. Each failure applies the next retry adjustment, as in the queue. A label that
    /// failed for good is tried again from the start. `None` after a stop request: a calculation under way continues,
    /// and the next call for the same key waits for it.
    ///
    /// # Errors
    /// Errors of the database, and if no calculation can be started on this host, whatever the structure.
    pub async fn make(
        &self,
        store: &Store,
        method: &Method,
        stop: &CancellationToken,
    ) -> Result<Option<LabelOutcome>, StoreError> {
        let mut progress = self.progress(store).await?;
        match progress.outcome {
            Some(made @ LabelOutcome::Made { .. }) => return Ok(Some(made)),
            Some(LabelOutcome::Failed(_)) => progress = LabelProgress::default(),
            None => {}
        }
        loop {
            let attempt = tokio::select! {
                attempt = self.attempt(store, method, &progress, stop) => attempt?,
                () = stop.cancelled() => None,
            };
            let Some(LabelAttempt { result, ended }) = attempt else {
                method.detach();
                return Ok(None);
            };
            let result = result.and_then(|results| validate(results, self.structure, self.bounds, None));
            // A record of a failed calculation has the node where it failed.
            let recorded = self.progress(store).await?.calculation;
            progress.add(result, recorded, self.attempts);
            progress.write(store, self.key, stop).await?;
            if let (Method::Code(method), Some(ended)) = (method, ended) {
                method.discard(ended).await?;
            }
            if progress.outcome.is_some() {
                return Ok(progress.outcome);
            }
        }
    }

    async fn attempt(
        &self,
        store: &Store,
        method: &Method,
        progress: &LabelProgress,
        stop: &CancellationToken,
    ) -> Result<Option<LabelAttempt>, StoreError> {
        match method {
            Method::Reference(method) => {
                let result = evaluate(Arc::clone(method), self.structure.clone()).await;
                Ok(Some(LabelAttempt { result, ended: None }))
            }
            Method::Code(method) => self.calculate(store, method, progress, stop).await,
        }
    }

    async fn calculate(
        &self,
        store: &Store,
        method: &CodeMethod,
        progress: &LabelProgress,
        stop: &CancellationToken,
    ) -> Result<Option<LabelAttempt>, StoreError> {
        let earlier: Vec<_> = progress.calculation.iter().cloned().collect();
        let request = CalculationRequest {
            structure: self.structure,
            job: NO_JOB,
            attempt: progress.failures.len() as u32 + 1,
            failures: failure_classes(&progress.failures),
            earlier: &earlier,
            failed: &progress.failed,
            record: CalculationNote::Progress(self.key, progress),
        };
        method.calculate(store, request, stop).await
    }

    async fn progress(&self, store: &Store) -> Result<LabelProgress, StoreError> {
        LabelProgress::read(store, self.key).await
    }
}
