//! How far a label outside the queue is, as the store has it.

use atoms::{Matrix3, Vec3};
use dft::{CalculationResults, Failure, FailureClass};
use serde::{Deserialize, Serialize};
use store::records::{Label, LabelDetails};
use store::{Store, StoreError};
use tokio_util::sync::CancellationToken;

use super::failure_classes::failure_classes;
use super::retry_until_written;

/// Number of lost calculations after which the label counts as failed.
const MAX_LOSSES: usize = 25;

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
    /// No attempt or retry adjustment is left. Contains the last failure.
    Failed(String),
}

/// What the store knows about a label.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub(super) struct LabelProgress {
    /// The calculation under way.
    pub calculation: Option<String>,
    /// Classes of the failures so far, oldest first.
    pub failures: Vec<String>,
    /// Calculations that failed.
    pub failed: Vec<String>,
    /// Its end, if it has ended.
    pub outcome: Option<LabelOutcome>,
}

impl LabelProgress {
    /// The progress of the label with this key.
    pub async fn read(store: &Store, key: &str) -> Result<Self, StoreError> {
        let text = store.metadata(key).await?;
        Ok(text.map(|text| Self::parse(key, &text)).transpose()?.unwrap_or_default())
    }

    /// Stores it under this key.
    pub async fn write(&self, store: &Store, key: &str, stop: &CancellationToken) -> Result<(), StoreError> {
        let text = self.to_text();
        retry_until_written(stop, || store.set_metadata(key, &text)).await
    }

    /// Records a calculation that is about to start.
    pub async fn record_calculation(
        &self,
        store: &Store,
        key: &str,
        calculation: String,
        stop: &CancellationToken,
    ) -> Result<(), StoreError> {
        let progress = Self { calculation: Some(calculation), ..self.clone() };
        progress.write(store, key, stop).await
    }

    /// The progress with this text, stored under `key`.
    pub fn parse(key: &str, text: &str) -> Result<Self, StoreError> {
        serde_json::from_str(text).map_err(|error| StoreError::damaged(key, error))
    }

    /// As the store has it.
    pub fn to_text(&self) -> String {
        serde_json::to_string(self).expect("validated numbers are finite, so they become JSON")
    }

    /// Adds the result of an attempt, whose calculation is recorded as `calculation`.
    pub fn add(
        &mut self,
        result: Result<CalculationResults, Failure>,
        calculation: Option<String>,
        attempts: u32,
    ) {
        self.calculation = None;
        let failure = match result {
            Ok(CalculationResults { energy, forces, stress, .. }) => {
                self.outcome = Some(LabelOutcome::Made { energy, forces, stress });
                return;
            }
            Err(failure) => failure,
        };
        self.failed.extend(calculation);
        self.failures.push(failure.class.name().to_owned());
        let classes = failure_classes(&self.failures);
        let lost = classes.iter().filter(|class| **class == FailureClass::NodeFailure).count();
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
        assert!(!failed(&mut progress, FailureClass::NodeFailure));
        assert!(!failed(&mut progress, FailureClass::NotConverged));
        assert!(failed(&mut progress, FailureClass::NotConverged));
        assert_eq!(progress.outcome, Some(LabelOutcome::Failed("not converged: so".to_owned())));
        assert!(failed(&mut LabelProgress::default(), FailureClass::BadInput));
        let mut lost = LabelProgress::default();
        let losses = (0..).take_while(|_| !failed(&mut lost, FailureClass::NodeFailure)).count();
        assert_eq!(losses + 1, MAX_LOSSES);
    }

    #[test]
    fn progress_survives_as_json() {
        let mut progress = LabelProgress::default();
        failed(&mut progress, FailureClass::Crashed);
        let results = CalculationResults {
            energy: -0.1,
            forces: vec![[1e-300, 0.3, -2.0]],
            ..CalculationResults::default()
        };
        progress.add(Ok(results), None, 3);
        let text = serde_json::to_string(&progress).unwrap();
        assert_eq!(serde_json::from_str::<LabelProgress>(&text).unwrap(), progress);
    }
}
