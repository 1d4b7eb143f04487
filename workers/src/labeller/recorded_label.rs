//! Labels outside the queue. The store has the progress of each under a key. After a crash, the next process that makes
//! the same label reads the result, or waits for the calculation that still runs.

use std::sync::Arc;

use atoms::{Matrix3, Structure, Vec3};
use dft::{Failure, FailureClass, Results};
use serde::{Deserialize, Serialize};
use store::records::{Label, LabelDetails};
use store::{Store, StoreError};
use tokio_util::sync::CancellationToken;

use super::code::{CalculationNote, CalculationRequest, CodeMethod, failure_classes};
use super::label_attempt::LabelAttempt;
use super::method::{Method, evaluate};
use super::retry_until_written;
use super::validate::{LabelBounds, validate};

/// Job number in the names of directories. No job of the queue has it.
const NO_JOB: i64 = 0;
/// Number of lost calculations after which the label counts as failed.
const MAX_LOSSES: usize = 25;

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

/// The end of a recorded label.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LabelOutcome {
    /// It was made.
    Made {
        /// eV
        energy: f64,
        /// [n], eV/Å
        forces: Vec<Vec3>,
        /// eV/Å³, tension positive
        stress: Option<Matrix3>,
    },
    /// No attempt or remedy is left. Contains the last failure.
    Failed(String),
}

/// What the store knows about a label.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub(super) struct LabelProgress {
    /// The calculation under way.
    calculation: Option<String>,
    /// Classes of the failures so far, oldest first.
    failures: Vec<String>,
    /// Calculations that failed.
    failed: Vec<String>,
    outcome: Option<LabelOutcome>,
}

/// Ends the calculations of labels whose keys begin with `prefix` and are not among `keys`: nobody wants them any more. What
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

    /// Makes the label, unless the store has it. Each failure applies the next remedy, as in the queue. A label that
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
            self.write(store, &progress, stop).await?;
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
            record: CalculationNote::Progress(self, progress),
        };
        method.calculate(store, request, stop).await
    }

    /// Records a calculation that is about to start.
    pub(super) async fn record_calculation(
        &self,
        store: &Store,
        progress: &LabelProgress,
        calculation: String,
        stop: &CancellationToken,
    ) -> Result<(), StoreError> {
        let progress = LabelProgress { calculation: Some(calculation), ..progress.clone() };
        self.write(store, &progress, stop).await
    }

    async fn progress(&self, store: &Store) -> Result<LabelProgress, StoreError> {
        let text = store.metadata(self.key).await?;
        Ok(text.map(|text| LabelProgress::parse(self.key, &text)).transpose()?.unwrap_or_default())
    }

    async fn write(
        &self,
        store: &Store,
        progress: &LabelProgress,
        stop: &CancellationToken,
    ) -> Result<(), StoreError> {
        let text = progress.to_text();
        retry_until_written(stop, || store.set_metadata(self.key, &text)).await
    }
}

impl LabelProgress {
    fn parse(key: &str, text: &str) -> Result<Self, StoreError> {
        serde_json::from_str(text).map_err(|error| StoreError::damaged(key, error))
    }

    fn to_text(&self) -> String {
        serde_json::to_string(self).expect("validated numbers are finite, so they become JSON")
    }

    /// Adds the result of an attempt, whose calculation is recorded as `calculation`.
    fn add(&mut self, result: Result<Results, Failure>, calculation: Option<String>, attempts: u32) {
        self.calculation = None;
        let failure = match result {
            Ok(Results { energy, forces, stress, .. }) => {
                self.outcome = Some(LabelOutcome::Made { energy, forces, stress });
                return;
            }
            Err(failure) => failure,
        };
        self.failed.extend(calculation);
        self.failures.push(failure.class.name().to_owned());
        let classes = failure_classes(&self.failures);
        let lost = classes.iter().filter(|class| **class == FailureClass::LostNode).count();
        let is_last = classes.len() - lost >= attempts as usize || lost >= MAX_LOSSES;
        if is_last || dft::adjustments(&classes).is_none() {
            self.outcome = Some(LabelOutcome::Failed(failure.to_string()));
        }
    }
}

impl LabelOutcome {
    /// The label.
    ///
    /// # Errors
    /// Why there is none.
    pub fn label(self) -> Result<Label, String> {
        match self {
            Self::Made { energy, forces, stress } => {
                Ok(Label { energy, forces, stress, details: LabelDetails::default() })
            }
            Self::Failed(message) => Err(message),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failed(progress: &mut LabelProgress, class: FailureClass) -> bool {
        progress.add(Err(class.with_message("so")), Some("it".to_owned()), 3);
        progress.outcome.is_some()
    }

    #[test]
    fn a_label_fails_when_no_attempt_or_remedy_is_left() {
        let mut progress = LabelProgress { calculation: Some("it".to_owned()), ..LabelProgress::default() };
        assert!(!failed(&mut progress, FailureClass::NotConverged));
        assert_eq!((progress.calculation.as_ref(), progress.failed.len()), (None, 1));
        assert!(!failed(&mut progress, FailureClass::LostNode));
        assert!(!failed(&mut progress, FailureClass::NotConverged));
        assert!(failed(&mut progress, FailureClass::NotConverged));
        assert_eq!(progress.outcome, Some(LabelOutcome::Failed("not converged: so".to_owned())));
        assert!(failed(&mut LabelProgress::default(), FailureClass::BadInput));
        let mut lost = LabelProgress::default();
        let losses = (0..).take_while(|_| !failed(&mut lost, FailureClass::LostNode)).count();
        assert_eq!(losses + 1, MAX_LOSSES);
    }

    #[test]
    fn progress_survives_as_json() {
        let mut progress = LabelProgress::default();
        failed(&mut progress, FailureClass::Crashed);
        let results = Results { energy: -0.1, forces: vec![[1e-300, 0.3, -2.0]], ..Results::default() };
        progress.add(Ok(results), None, 3);
        let text = serde_json::to_string(&progress).unwrap();
        assert_eq!(serde_json::from_str::<LabelProgress>(&text).unwrap(), progress);
    }
}
