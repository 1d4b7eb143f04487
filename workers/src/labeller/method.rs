//! Methods that make labels.

use std::panic;
use std::sync::{Arc, Mutex, PoisonError};

use atoms::{Potential, Structure};
use dft::{CalculationResults, CalculationSize, DftBackend, Failure};
use store::records::Lease;
use store::{Store, StoreError};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use super::code::CodeMethod;
use super::label_attempt::{EndedCalculation, LabelAttempt};
use super::retry_decision::attempt_limit;
use super::{ExecutionSettings, ReferenceMethod, RunnerCommand};

/// A way to make labels.
pub enum Method {
    /// A potential, evaluated in this process.
    Reference(Arc<Mutex<ReferenceMethod>>),
    /// Another program, run in processes that outlive this one.
    Code(Box<CodeMethod>),
}

impl Method {
    /// Labels by a potential.
    pub fn reference(potential: Box<dyn Potential>) -> Self {
        Self::Reference(Arc::new(Mutex::new(ReferenceMethod::new(potential))))
    }

    /// Labels by another program.
    pub fn code(code: Box<dyn DftBackend>, execution: ExecutionSettings) -> Self {
        Self::with_runner(RunnerCommand::default(), code, execution)
    }

    /// The same method, with this command to start calculation runners ([`super::run_calculation`]).
    pub fn with_runner(
        runner: RunnerCommand,
        code: Box<dyn DftBackend>,
        execution: ExecutionSettings,
    ) -> Self {
        Self::Code(Box::new(CodeMethod::new(runner, code, execution)))
    }

    /// Whether a calculation continues without this labeller, and another labeller can find it.
    pub(super) fn outlives_labeller(&self) -> bool {
        matches!(self, Self::Code(_))
    }

    /// Ends the current calculation, if there is one, and removes its directory.
    ///
    /// # Errors
    /// [`StoreError::File`] if that fails.
    pub async fn stop(&self) -> Result<(), StoreError> {
        match self {
            Self::Reference(_) => Ok(()),
            Self::Code(method) => method.cancel().await,
        }
    }

    /// Prepares the scratch directory, and removes what killed labellers left.
    pub(super) async fn start(&self, store: &Store, stop: &CancellationToken) -> Result<(), StoreError> {
        match self {
            Self::Reference(_) => Ok(()),
            Self::Code(method) => method.scratch_root(store, stop).await.map(drop),
        }
    }

    /// Removes empty directories. Call this at the end.
    pub fn end(&self) {
        if let Self::Code(method) = self {
            method.end();
        }
    }

    /// Leaves the current calculation to the other labeller that waits for it.
    pub(super) fn detach(&self) {
        if let Self::Code(method) = self {
            method.detach();
        }
    }

    /// After the result is stored: archives or removes the calculation.
    pub(super) async fn archive(
        &self,
        store: &Store,
        lease: &Lease,
        stop: &CancellationToken,
        ended: EndedCalculation,
        failed: bool,
    ) -> Result<(), StoreError> {
        match self {
            Self::Reference(_) => Ok(()),
            Self::Code(method) => method.archive(store, lease, stop, ended, failed).await,
        }
    }

    /// Makes the result of a job. A potential runs on a thread of its own. `None` if a stop was requested and
    /// reading the result would take longer.
    pub(super) async fn make(
        &self,
        store: &Store,
        lease: &Lease,
        stop: &CancellationToken,
    ) -> Result<Option<LabelAttempt>, StoreError> {
        match self {
            Self::Reference(method) => {
                let result = evaluate(Arc::clone(method), lease.structure.clone()).await;
                Ok(Some(LabelAttempt { result, ended: None }))
            }
            Self::Code(method) => method.make(store, lease, stop).await,
        }
    }

    /// The properties that determine the cost of a label.
    pub(super) fn size(&self, structure: &Structure) -> CalculationSize {
        match self {
            Self::Reference(_) => CalculationSize { atoms: structure.len(), electrons: 0.0, k_points: 1 },
            Self::Code(method) => method.size(structure),
        }
    }

    /// The handle of the current calculation in the form of the store, if there is one.
    pub(super) fn calculation(&self) -> Option<String> {
        match self {
            Self::Reference(_) => None,
            Self::Code(method) => method.calculation(),
        }
    }

    /// The number of attempts after which a job fails that has failed like this, at most `attempts`.
    pub(super) fn attempt_limit(&self, lease: &Lease, failure: &Failure, attempts: u32) -> u32 {
        match self {
            // Every attempt would give the same result.
            Self::Reference(_) => attempts,
            Self::Code(_) => attempt_limit(&lease.failures, failure.class, attempts),
        }
    }
}

/// A panic of the method ends its labeller.
pub(super) async fn evaluate(
    method: Arc<Mutex<ReferenceMethod>>,
    structure: Structure,
) -> Result<CalculationResults, Failure> {
    // A panic has ended every labeller that shares the lock.
    let label = move || method.lock().unwrap_or_else(PoisonError::into_inner).label(&structure);
    spawn_blocking(label).await.unwrap_or_else(|crash| panic::resume_unwind(crash.into_panic()))
}
