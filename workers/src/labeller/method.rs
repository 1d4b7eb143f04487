//! What makes labels.

use std::panic;
use std::sync::{Arc, Mutex, PoisonError};

use atoms::{Potential, Structure};
use dft::{Calculated, Code, Failure, Size};
use store::records::Lease;
use store::{Store, StoreError};
use tokio::task::spawn_blocking;

use super::code::{CodeMethod, EndedCalculation, failure_classes};
use super::validate::{EnergyReference, LabelBounds, validate};
use super::{ExecutionSettings, ReferenceMethod, RunnerCommand, Shutdown};

/// A way to make labels.
pub enum Method {
    /// A potential, in this process.
    Reference(Arc<Mutex<ReferenceMethod>>),
    /// Another program, in processes of its own that outlive this one.
    Code(Box<CodeMethod>),
}

/// A result.
pub(super) struct LabelAttempt {
    pub result: Result<Calculated, Failure>,
    /// The calculation behind it, if it was a process of its own.
    pub ended: Option<EndedCalculation>,
}

impl LabelAttempt {
    /// The same, if it can be believed; otherwise why not.
    pub fn validated(
        self,
        lease: &Lease,
        bounds: &LabelBounds,
        expected: Option<EnergyReference<'_>>,
    ) -> Self {
        let result = self.result.and_then(|made| validate(made, &lease.structure, bounds, expected));
        Self { result, ..self }
    }
}

impl Method {
    /// Labels by a potential.
    pub fn reference(potential: Box<dyn Potential>) -> Self {
        Self::Reference(Arc::new(Mutex::new(ReferenceMethod::new(potential))))
    }

    /// Labels by another program.
    pub fn code(code: Box<dyn Code>, execution: ExecutionSettings) -> Self {
        Self::with_runner(RunnerCommand::default(), code, execution)
    }

    /// The same with keepers ([`super::run_calculation`]) that are started so.
    pub fn with_runner(runner: RunnerCommand, code: Box<dyn Code>, execution: ExecutionSettings) -> Self {
        Self::Code(Box::new(CodeMethod::new(runner, code, execution)))
    }

    /// Whether a calculation goes on without this labeller, and another finds it.
    pub(super) fn outlives_labeller(&self) -> bool {
        matches!(self, Self::Code(_))
    }

    /// Ends the calculation in hand, if there is one, and removes its directory.
    ///
    /// # Errors
    /// [`StoreError::File`] if that is impossible.
    pub async fn stop(&self) -> Result<(), StoreError> {
        match self {
            Self::Reference(_) => Ok(()),
            Self::Code(method) => method.cancel().await,
        }
    }

    /// Makes room for calculations, and clears away what killed labellers have left.
    pub(super) async fn start(&self, store: &Store, shutdown: &Shutdown) -> Result<(), StoreError> {
        match self {
            Self::Reference(_) => Ok(()),
            Self::Code(method) => method.scratch_root(store, shutdown).await.map(drop),
        }
    }

    /// Nothing more is to be done.
    pub(super) fn end(&self) {
        if let Self::Code(method) = self {
            method.end();
        }
    }

    /// Leaves the calculation in hand to whoever waits for it as well.
    pub(super) fn detach(&self) {
        if let Self::Code(method) = self {
            method.detach();
        }
    }

    /// The result of a job is where it belongs, and what was needed for it is put away.
    pub(super) async fn archive(
        &self,
        store: &Store,
        lease: &Lease,
        shutdown: &Shutdown,
        ended: EndedCalculation,
        failed: bool,
    ) -> Result<(), StoreError> {
        match self {
            Self::Reference(_) => Ok(()),
            Self::Code(method) => method.archive(store, lease, shutdown, ended, failed).await,
        }
    }

    /// Makes the result for a job. A potential takes a thread of its own. None if somebody asked to stop and it would take longer
    /// to read it.
    pub(super) async fn make(
        &self,
        store: &Store,
        lease: &Lease,
        shutdown: &Shutdown,
    ) -> Result<Option<LabelAttempt>, StoreError> {
        match self {
            Self::Reference(method) => {
                let result = evaluate(Arc::clone(method), lease.structure.clone()).await;
                Ok(Some(LabelAttempt { result, ended: None }))
            }
            Self::Code(method) => method.make(store, lease, shutdown).await,
        }
    }

    /// What the cost of a label depends on.
    pub(super) fn size(&self, structure: &Structure) -> Size {
        match self {
            Self::Reference(_) => Size { atoms: structure.len(), electrons: 0.0, k_points: 1 },
            Self::Code(method) => method.size(structure),
        }
    }

    /// What is said of the calculation in hand in the store, if there is one.
    pub(super) fn calculation(&self) -> Option<String> {
        match self {
            Self::Reference(_) => None,
            Self::Code(method) => method.calculation(),
        }
    }

    /// Classes of failures after which nothing is left to try.
    pub(super) fn has_no_remedy(&self, lease: &Lease, failure: &Failure) -> bool {
        match self {
            // Every attempt would be like the one before.
            Self::Reference(_) => false,
            Self::Code(_) => {
                let failures = failure_classes(lease).into_iter().chain([failure.class]);
                dft::remedies(&failures.collect::<Vec<_>>()).is_none()
            }
        }
    }
}

/// A method that panics takes its labeller with it.
pub(super) async fn evaluate(
    method: Arc<Mutex<ReferenceMethod>>,
    structure: Structure,
) -> Result<Calculated, Failure> {
    // One that panicked has taken everybody with it who could see it.
    let label = move || method.lock().unwrap_or_else(PoisonError::into_inner).label(&structure);
    spawn_blocking(label).await.unwrap_or_else(|crash| panic::resume_unwind(crash.into_panic()))
}
