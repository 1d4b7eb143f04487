//! Labellers: lease a job, let a method compute it, validate the result and deliver it to the store.
//!
//! [`run`] is a task within a process. [`serve`] runs a labeller as a process of its own, which outlives its
//! orchestrator.

mod batch_access;
mod batch_job;
mod blocking;
mod calculation_handle;
mod calculation_request;
mod calculation_runner;
mod calculation_state;
mod code;
mod custom_jobs;
mod energies;
mod execution;
mod failure_classes;
mod file_error;
mod guard;
mod heartbeat;
mod input_diff;
mod label_attempt;
mod label_progress;
mod local;
mod log;
mod method;
mod pack;
mod prepare;
mod private_directory;
mod process_tree;
mod recorded_label;
mod reference;
mod removal;
mod remove_tree;
mod report_line;
mod retry;
mod retry_decision;
mod scratch;
mod shutdown;
mod single_label;
mod slurm;
mod validate;

use std::pin::pin;
use std::time::{Duration, Instant};

use dft::{CalculationResults, Failure};
use store::records::{Label, LabelDetails, Lease, Protocol};
use store::{LeaseStatus, Store, StoreError};
use tokio_util::sync::CancellationToken;
use tracing::{debug, info, warn};

use energies::Offsets;
use label_attempt::{EndedCalculation, LabelAttempt};
use report_line::DeliveryOutcome;
use retry_decision::counts_as_attempt;

pub use calculation_runner::{RunnerCommand, run_calculation};
pub use code::CodeMethod;
pub use execution::{BatchSystem, ExecutionSettings, KeepDirectories};
pub use guard::{GUARD, LabelGuard};
pub use heartbeat::{ExitPolicy, serve};
pub use label_attempt::SingleLabel;
pub use label_progress::LabelOutcome;
pub use method::Method;
pub use process_tree::{MARK as CALCULATION_MARK, terminate_marked};
pub use recorded_label::{RecordedLabel, give_up_others};
pub use reference::ReferenceMethod;
pub use retry::retry_until_written;
pub use shutdown::Shutdown;
pub use single_label::label_structure;
pub use validate::LabelBounds;

/// What labellers decide, apart from what they read, write and run.
pub mod decisions {
    pub use super::calculation_runner::{CalculationEnd, EndReason};
    pub use super::calculation_state::{CalculationState, EarlierStep, WaitStep};
    pub use super::custom_jobs::{
        AfterFailure, CustomDirectory, CustomInspection, CustomStep, CustomSubmission, JobSubmission,
        MAX_NUMBER, MAX_SUBMISSIONS, SubmissionFailure, infer_custom_end,
    };
    pub use super::failure_classes::failure_classes;
    pub use super::retry_decision::{attempt_limit, counts_as_attempt, failure_at, next_adjustments};
    pub use super::scratch::is_left_over;
    pub use super::slurm::{
        Inspection, InspectionStep, JobDirectory, SqueueJob, SubmissionRetry, SubmissionStep, Traces,
        infer_end, is_listed, jobs_to_cancel,
    };
}

/// Time between two heartbeats in the store, for every process that sends them.
pub const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(5);
/// Longest time between two polls of the queue.
const MAX_POLL_INTERVAL: Duration = Duration::from_secs(1);
/// The same if the database sends notifications of new jobs: only expired leases need polling.
const NOTIFIED_POLL_INTERVAL: Duration = Duration::from_secs(5);
/// The poll interval is the idle time divided by this, which bounds the delay until new work is found.
const IDLE_DIVISOR: u32 = 8;

/// Settings of a labeller.
#[derive(Clone, Debug)]
pub struct LabellerSettings {
    /// Holder of its leases: the id of a registered process, or `process/part`.
    pub holder: String,
    /// The protocol of its labels.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// Bounds that a valid label must satisfy.
    pub bounds: LabelBounds,
    /// When a labeller process exits while nothing runs the campaign.
    pub exit_policy: ExitPolicy,
    /// Intervals and timeouts.
    pub timing: Timing,
}

/// Intervals and timeouts of a labeller.
#[derive(Clone, Copy, Debug)]
pub struct Timing {
    /// Lease duration, in whole seconds. While a label is computed, the lease is renewed every third of it, without
    /// limit, even for a method that never ends. An expired lease frees jobs of processes that no other process can
    /// observe, see [`Store::lease`].
    pub lease: Duration,
    /// Poll interval right after the queue became empty. It grows with the idle time, up to a second: each poll
    /// costs some tenths of a millisecond.
    pub idle: Duration,
    /// Time between two heartbeats of a labeller process.
    pub heartbeat_interval: Duration,
    /// How long the current label may continue after the labeller is asked to stop, before its job is released and
    /// its calculation ended. If `None`, the label is finished, but a calculation that outlives the labeller is
    /// left to the next one after some seconds.
    pub grace: Option<Duration>,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            lease: Duration::from_secs(600),
            idle: Duration::from_millis(50),
            heartbeat_interval: HEARTBEAT_INTERVAL,
            grace: None,
        }
    }
}

impl Timing {
    fn lease_seconds(&self) -> u32 {
        u32::try_from(self.lease.as_secs()).unwrap_or(u32::MAX).max(1)
    }
}

/// The result of polling the queue.
enum QueuePoll {
    Job(Box<Lease>),
    Nothing,
    /// No job, and none will come.
    Finished,
}

/// How long a labeller that is asked to stop waits for a calculation that can continue without it.
const DETACH_DELAY: Duration = Duration::from_secs(5);

/// Labels until there is no more work. `now` returns ms since 1970; `on_line` receives a line for each job.
///
/// A busy database or a full disk does not end the labeller: it polls the queue again later, and retries the
/// delivery of a label, for up to a minute after `shutdown` was requested.
///
/// # Errors
/// Any other error of the database. The current label is lost then, and its job returns to the queue.
pub async fn run(
    store: Store,
    method: Method,
    settings: LabellerSettings,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
    on_line: impl Fn(&str),
) -> Result<(), StoreError> {
    let done = label_jobs(&store, &method, &settings, shutdown, now, on_line).await;
    method.end();
    done
}

async fn label_jobs(
    store: &Store,
    method: &Method,
    settings: &LabellerSettings,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
    on_line: impl Fn(&str),
) -> Result<(), StoreError> {
    let announce = |line: &str| {
        info!("{line}");
        on_line(line);
    };
    let (mut idle, mut offsets) = (Duration::ZERO, Offsets::default());
    let stop = &shutdown.stop;
    method.start(store, stop).await?;
    loop {
        if stop.is_cancelled() {
            return Ok(());
        }
        let no_more_jobs = shutdown.no_more_jobs();
        let lease = match poll_queue(store, settings, no_more_jobs, now()).await {
            Ok(QueuePoll::Job(lease)) => lease,
            Ok(QueuePoll::Finished) => return Ok(()),
            Err(error) if !error.is_transient() => return Err(error),
            polled => {
                idle += wait(store, idle, settings.timing.idle, polled.is_ok(), shutdown, no_more_jobs).await;
                continue;
            }
        };
        idle = Duration::ZERO;
        debug!(candidate = lease.candidate, job = lease.job, attempt = lease.attempt, "leased");
        let started = Instant::now();
        let size = method.size(&lease.structure);
        if let Some(reason) = retry_until_written(stop, || guard::rejection(store, &lease, size)).await? {
            // Another attempt would be rejected as well, whatever was tried before.
            retry_until_written(stop, || store.fail(&lease, guard::REJECTED, &reason, 1, now())).await?;
            announce(&format!("{} rejected by label guard: {reason}", lease.candidate));
            continue;
        }
        let attempt = match make_label(store, method, &lease, &settings.timing, stop, &now).await? {
            LeaseOutcome::Done(attempt) => *attempt,
            LeaseOutcome::NotWanted => {
                method.stop().await?;
                announce(&format!("stopped labelling {}: its result is no longer needed", lease.candidate));
                continue;
            }
            LeaseOutcome::Detached => {
                method.detach();
                announce(&format!("{} is finished by another labeller on this host", lease.candidate));
                continue;
            }
            LeaseOutcome::LeftRunning => {
                method.detach();
                announce(&format!(
                    "{} continues and is left to the next labeller on this host",
                    lease.candidate
                ));
                return retry_until_written(stop, || store.release_all(&settings.holder, now()))
                    .await
                    .map(drop);
            }
            LeaseOutcome::GraceExpired => {
                method.stop().await?;
                announce(&format!("released {}: there is no time to finish it", lease.candidate));
                return retry_until_written(stop, || store.release_all(&settings.holder, now()))
                    .await
                    .map(drop);
            }
        };
        let reference =
            offsets.energy_reference(store, &settings.protocol, &lease, &attempt.result, stop).await?;
        let attempt = attempt.validated(&lease, &settings.bounds, reference);
        let Delivered { validated, outcome, ended } =
            deliver_attempt(store, method, &lease, settings, attempt, stop, &now).await?;
        let line = report_line::format_report(&lease, &validated, &outcome, started.elapsed().as_secs_f64());
        match &validated {
            Ok(_) => info!(job = lease.job, attempt = lease.attempt, "{line}"),
            Err(failure) => {
                warn!(job = lease.job, attempt = lease.attempt, class = failure.class.name(), "{line}");
            }
        }
        on_line(&line);
        if let Some(ended) = ended {
            method.archive(store, &lease, stop, ended, validated.is_err()).await?;
        }
    }
}

/// A result that the store has.
struct Delivered {
    validated: Result<CalculationResults, Failure>,
    outcome: DeliveryOutcome,
    ended: Option<EndedCalculation>,
}

/// Stores the validated result of a job and its cost.
async fn deliver_attempt(
    store: &Store,
    method: &Method,
    lease: &Lease,
    settings: &LabellerSettings,
    attempt: LabelAttempt,
    stop: &CancellationToken,
    now: impl Fn() -> i64,
) -> Result<Delivered, StoreError> {
    let LabelAttempt { result: validated, ended } = attempt;
    let log = ended.as_ref().map_or("", |ended| &ended.log);
    if let Some(ended) = &ended {
        retry_until_written(stop, || store.record_cost(lease, ended.core_seconds, log)).await?;
    }
    // A failure without a retry adjustment is not tried again.
    let attempts = match &validated {
        Ok(_) => settings.attempts,
        Err(failure) => method.attempt_limit(lease, failure, settings.attempts),
    };
    let outcome =
        retry_until_written(stop, || deliver(store, lease, &validated, log, attempts, now())).await?;
    Ok(Delivered { validated, outcome, ended })
}

async fn poll_queue(
    store: &Store,
    settings: &LabellerSettings,
    no_more_jobs: bool,
    now: i64,
) -> Result<QueuePoll, StoreError> {
    // The loop holds no lease at this point: leasing, labelling and polling follow each other.
    release_unknown_leases(store, &settings.holder, &[], now).await?;
    if !store.has_pending_labels(now).await? {
        return Ok(if no_more_jobs { QueuePoll::Finished } else { QueuePoll::Nothing });
    }
    let (protocol, seconds) = (settings.protocol.hash, settings.timing.lease_seconds());
    match store.lease(protocol, &settings.holder, now, seconds).await? {
        Some(lease) => Ok(QueuePoll::Job(Box::new(lease))),
        // The remaining work is for others.
        None if !store.is_in_force(protocol).await? => Ok(QueuePoll::Finished),
        None => Ok(QueuePoll::Nothing),
    }
}

/// Releases leases that the store has under this labeller's name but that it does not know: the reply to a commit
/// was lost.
async fn release_unknown_leases(
    store: &Store,
    holder: &str,
    held: &[&Lease],
    now: i64,
) -> Result<(), StoreError> {
    let leases = store.state_leases(holder, held, now).await?;
    if leases > 0 {
        warn!(leases, "released leases: the database's reply to a commit was lost");
    }
    Ok(())
}

/// Waits until there may be work, or until a stop is requested or `no_more_jobs` is no longer so. `idle` is the time without
/// work so far. Returns the longest time that it may have waited.
async fn wait(
    store: &Store,
    idle: Duration,
    least: Duration,
    answers: bool,
    shutdown: &Shutdown,
    no_more_jobs: bool,
) -> Duration {
    let wait = match answers && store.has_job_notifications() {
        true => NOTIFIED_POLL_INTERVAL,
        false => (idle / IDLE_DIVISOR).min(MAX_POLL_INTERVAL).max(least),
    };
    tokio::select! {
        () = store.wait_for_jobs(wait) => {}
        () = shutdown.changed_from(no_more_jobs) => {}
    }
    wait
}

/// The outcome of a lease.
enum LeaseOutcome {
    Done(Box<LabelAttempt>),
    /// The result is no longer needed.
    NotWanted,
    /// Another labeller waits for the same calculation.
    Detached,
    /// The labeller was asked to stop; the calculation continues without it, or waits to be read.
    LeftRunning,
    /// The grace period ended first.
    GraceExpired,
}

/// Works on a job and renews its lease meanwhile. If the lease is lost, the label is still finished: if another
/// result comes first, it becomes a check. But its calculation is ended when the result is no longer needed, and
/// left alone when another labeller waits for it.
async fn make_label(
    store: &Store,
    method: &Method,
    lease: &Lease,
    timing: &Timing,
    stop: &CancellationToken,
    now: impl Fn() -> i64,
) -> Result<LeaseOutcome, StoreError> {
    let mut labelling = pin!(method.make(store, lease, stop));
    let mut too_late = pin!(end_of_grace(timing.grace, stop));
    // Labellers without a grace period are followed by others, which find the calculation.
    let leaves = timing.grace.is_none() && method.outlives_labeller();
    let mut leave = pin!(async {
        end_of_grace(leaves.then_some(DETACH_DELAY), stop).await;
        while method.calculation().is_none() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    let seconds = timing.lease_seconds();
    let mut held = true;
    loop {
        tokio::select! {
            attempt = &mut labelling => {
                return Ok(attempt?.map_or(LeaseOutcome::LeftRunning, |attempt| LeaseOutcome::Done(Box::new(attempt))));
            }
            () = &mut too_late => return Ok(LeaseOutcome::GraceExpired),
            () = &mut leave => return Ok(LeaseOutcome::LeftRunning),
            () = tokio::time::sleep(Duration::from_secs(seconds.into()) / 3) => {}
        }
        if held {
            held = match store.renew(lease, now(), seconds).await {
                // There is time for another try.
                Err(error) if error.is_transient() => true,
                renewed => renewed?,
            };
        }
        // The server may have completed a commit after its connection broke and the queue was polled.
        match release_unknown_leases(store, &lease.holder, &[lease], now()).await {
            Err(error) if !error.is_transient() => return Err(error),
            _ => {}
        }
        let Some(own) = method.calculation().filter(|_| !held) else { continue };
        match store.lease_status(lease).await {
            Ok(LeaseStatus::Over) => return Ok(LeaseOutcome::NotWanted),
            Ok(LeaseStatus::LeasedAgain { calculation: Some(other) }) if other == own => {
                return Ok(LeaseOutcome::Detached);
            }
            Ok(_) => {}
            Err(error) if error.is_transient() => {}
            Err(error) => return Err(error),
        }
    }
}

async fn end_of_grace(grace: Option<Duration>, stop: &CancellationToken) {
    match grace {
        Some(grace) => {
            stop.cancelled().await;
            tokio::time::sleep(grace).await;
        }
        None => std::future::pending().await,
    }
}

async fn deliver(
    store: &Store,
    lease: &Lease,
    validated: &Result<CalculationResults, Failure>,
    log: &str,
    attempts: u32,
    now: i64,
) -> Result<DeliveryOutcome, StoreError> {
    let failure = match validated {
        Ok(results) => {
            return store.complete(lease, &label(results), now).await.map(DeliveryOutcome::Completed);
        }
        Err(failure) => failure,
    };
    let (class, text) = (failure.class.name(), format!("{failure}\n{log}"));
    let text = text.trim_end();
    let failed = match counts_as_attempt(failure.class) {
        true => store.fail(lease, class, text, attempts, now).await,
        false => store.release_lost(lease, class, text, now).await,
    };
    failed.map(DeliveryOutcome::Failed)
}

/// A result for the store keeps it.
fn label(results: &CalculationResults) -> Label {
    Label {
        energy: results.energy,
        forces: results.forces.clone(),
        stress: results.stress,
        details: LabelDetails {
            energy_without_smearing: results.energy_without_smearing,
            magnetic_moments: results.magnetic_moments.clone(),
            magnetisation: results.magnetisation,
            electronic_steps: results.electronic_steps,
            // The store knows both.
            retry_adjustments: Vec::new(),
            ordered_by_value: false,
        },
    }
}
