//! A labeller leases a job, has its method work on it, judges what comes of it and delivers.
//!
//! [`run`] is one of the tasks of a process, [`serve`] a process of its own, which outlives its orchestrator.

mod calculation_handle;
mod calculation_runner;
mod code;
mod energies;
mod execution;
mod guard;
mod heartbeat;
mod input_diff;
mod local;
mod log;
mod method;
mod pack;
mod prepare;
mod private_directory;
mod process_tree;
mod reference;
mod remove_tree;
mod report_line;
mod retry;
mod scratch;
mod shutdown;
mod single_label;
mod slurm;
mod validate;

use std::pin::pin;
use std::time::{Duration, Instant};

use dft::{Calculated, Failure, FailureClass};
use store::records::{Label, LabelDetails, Lease, Protocol};
use store::{LeaseStatus, Store, StoreError};
use tracing::{debug, info, warn};

use code::EndedCalculation;
use energies::Offsets;
use method::LabelAttempt;
use report_line::DeliveryOutcome;
use shutdown::ShutdownState;

pub use calculation_runner::{RunnerCommand, run_calculation};
pub use code::CodeMethod;
pub use energies::{energy_offsets, labelled_energy};
pub use execution::{BatchSystem, ExecutionSettings, KeepDirectories};
pub use guard::{GUARD, LabelGuard, Pair};
pub use heartbeat::{ExitPolicy, serve};
pub use method::Method;
pub use reference::ReferenceMethod;
pub use retry::retry_until_written;
pub use shutdown::Shutdown;
pub use single_label::{SingleLabel, label_structure};
pub use validate::LabelBounds;

/// Between two signs of life in the store, of every process that gives them there.
pub const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(5);
/// The longest time between two looks at the queue …
const MAX_POLL_INTERVAL: Duration = Duration::from_secs(1);
/// … and where the database tells of new jobs: only leases that ran out are not told of.
const NOTIFIED_POLL_INTERVAL: Duration = Duration::from_secs(5);
/// Which part of the time without work passes until the next look, and so how late work may be found.
const IDLE_DIVISOR: u32 = 8;

/// What a labeller needs to know.
#[derive(Clone, Debug)]
pub struct LabellerSettings {
    /// Whose leases these are: the name of a process that has its record in the store, or `process/part`.
    pub holder: String,
    /// Under which settings labels are made.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// What is believed of a label.
    pub bounds: LabelBounds,
    /// For how long it is of use, if it is a process of its own, while nobody leads the campaign.
    pub exit_policy: ExitPolicy,
    /// How often it does what has to be done again and again.
    pub timing: Timing,
}

/// How often a labeller does what has to be done again and again.
#[derive(Clone, Copy, Debug)]
pub struct Timing {
    /// How long a job is leased, in whole seconds. The lease is renewed at a third of it while the label is made,
    /// however long that takes, and so also for a method that never comes to an end. It is for processes that nobody
    /// can see to be gone, see [`Store::lease`].
    pub lease: Duration,
    /// How long a labeller that has just run out of work waits before it looks again. The longer it has had none, the
    /// longer it waits, up to a second: each look costs some tenths of a millisecond.
    pub idle: Duration,
    /// Between two signs of life of a labeller that is a process.
    pub heartbeat_interval: Duration,
    /// How long the label in hand may go on when the labeller is asked to stop, before it is given back and its calculation
    /// ended. With none the label is finished, but a calculation that outlives the labeller is left to the next one after some
    /// seconds.
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

/// What a look at the queue finds.
enum QueuePoll {
    Job(Box<Lease>),
    Nothing,
    /// Nothing, and nothing will come.
    Finished,
}

/// After it was asked to stop, a labeller waits so long for a calculation that goes on without it.
const DETACH_DELAY: Duration = Duration::from_secs(5);

/// Labels until there is nothing more to do. `now` is asked for ms since 1970; `tell` gets a line for each job.
///
/// A database that is busy or full is no reason to end: the queue is polled at again later, and a label that was made is
/// brought again and again, after `closing` asks to stop for a minute more.
///
/// # Errors
/// Whatever else the database says; the label in hand is lost then, and its job comes back.
pub async fn run(
    store: Store,
    method: Method,
    settings: LabellerSettings,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
    tell: impl Fn(&str),
) -> Result<(), StoreError> {
    let done = label_jobs(&store, &method, &settings, shutdown, now, tell).await;
    method.end();
    done
}

async fn label_jobs(
    store: &Store,
    method: &Method,
    settings: &LabellerSettings,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
    tell: impl Fn(&str),
) -> Result<(), StoreError> {
    let say = |line: &str| {
        info!("{line}");
        tell(line);
    };
    let (mut idle, mut offsets) = (Duration::ZERO, Offsets::default());
    method.start(store, shutdown).await?;
    loop {
        let requested = shutdown.state();
        if requested.stop {
            return Ok(());
        }
        let lease = match poll_queue(store, settings, requested.no_more_jobs, now()).await {
            Ok(QueuePoll::Job(lease)) => lease,
            Ok(QueuePoll::Finished) => return Ok(()),
            Err(error) if !error.is_transient() => return Err(error),
            polled => {
                idle += wait(store, idle, settings.timing.idle, polled.is_ok(), shutdown, requested).await;
                continue;
            }
        };
        idle = Duration::ZERO;
        debug!(candidate = lease.candidate, job = lease.job, attempt = lease.attempt, "leased");
        let begun = Instant::now();
        let size = method.size(&lease.structure);
        if let Some(reason) = retry_until_written(shutdown, || guard::refusal(store, &lease, size)).await? {
            // Whatever was tried before, another attempt would be refused as well.
            retry_until_written(shutdown, || store.fail(&lease, guard::REFUSED, &reason, 1, now())).await?;
            say(&format!("{} is refused: {reason}", lease.candidate));
            continue;
        }
        let made = match make(store, method, &lease, &settings.timing, shutdown, &now).await? {
            LeaseOutcome::Done(made) => *made,
            LeaseOutcome::NotWanted => {
                method.stop().await?;
                say(&format!(
                    "{} is given up here: it has its label, or is requested no more",
                    lease.candidate
                ));
                continue;
            }
            LeaseOutcome::Detached => {
                method.detach();
                say(&format!("{} is finished by somebody else here", lease.candidate));
                continue;
            }
            LeaseOutcome::LeftRunning => {
                method.detach();
                say(&format!("{} goes on and is left to the next labeller here", lease.candidate));
                return retry_until_written(shutdown, || store.release_all(&settings.holder, now()))
                    .await
                    .map(drop);
            }
            LeaseOutcome::GraceExpired => {
                method.stop().await?;
                say(&format!("{} is given back: there is no time to finish it", lease.candidate));
                return retry_until_written(shutdown, || store.release_all(&settings.holder, now()))
                    .await
                    .map(drop);
            }
        };
        let expected = offsets.expected(store, &settings.protocol, &lease, &made.result, shutdown).await?;
        let made = made.validated(&lease, &settings.bounds, expected);
        let Delivered { validated, became, ended } =
            deliver_attempt(store, method, &lease, settings, made, shutdown, &now).await?;
        let line = report_line::format_report(&lease, &validated, &became, begun.elapsed().as_secs_f64());
        match &validated {
            Ok(_) => info!(job = lease.job, attempt = lease.attempt, "{line}"),
            Err(failure) => {
                warn!(job = lease.job, attempt = lease.attempt, class = failure.class.name(), "{line}");
            }
        }
        tell(&line);
        if let Some(ended) = ended {
            method.archive(store, &lease, shutdown, ended, validated.is_err()).await?;
        }
    }
}

/// A result that the store has.
struct Delivered {
    validated: Result<Calculated, Failure>,
    became: DeliveryOutcome,
    ended: Option<EndedCalculation>,
}

/// Brings what was made for a job and judged to the store, with what it has cost.
async fn deliver_attempt(
    store: &Store,
    method: &Method,
    lease: &Lease,
    settings: &LabellerSettings,
    made: LabelAttempt,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
) -> Result<Delivered, StoreError> {
    let LabelAttempt { result: validated, ended } = made;
    let log = ended.as_ref().map_or("", |ended| &ended.log);
    if let Some(ended) = &ended {
        retry_until_written(shutdown, || store.record_cost(lease, ended.core_seconds, log)).await?;
    }
    // What no remedy helps against is not tried again.
    let no_remedy = validated.as_ref().is_err_and(|failure| method.has_no_remedy(lease, failure));
    let attempts = if no_remedy { 1 } else { settings.attempts };
    let became =
        retry_until_written(shutdown, || deliver(store, lease, &validated, log, attempts, now())).await?;
    Ok(Delivered { validated, became, ended })
}

async fn poll_queue(
    store: &Store,
    settings: &LabellerSettings,
    no_more_jobs: bool,
    now: i64,
) -> Result<QueuePoll, StoreError> {
    // Its loop holds none now: leasing a job, working on it and the next look follow each other.
    give_back_unknown(store, &settings.holder, &[], now).await?;
    if !store.awaits_labels(now).await? {
        return Ok(if no_more_jobs { QueuePoll::Finished } else { QueuePoll::Nothing });
    }
    let (protocol, seconds) = (settings.protocol.hash, settings.timing.lease_seconds());
    match store.lease(protocol, &settings.holder, now, seconds).await? {
        Some(lease) => Ok(QueuePoll::Job(Box::new(lease))),
        // What there is to do is for others.
        None if !store.is_in_force(protocol).await? => Ok(QueuePoll::Finished),
        None => Ok(QueuePoll::Nothing),
    }
}

/// Gives back leases that the store has in the name of this labeller, and it does not know: the answer to a commit was lost.
async fn give_back_unknown(store: &Store, holder: &str, held: &[&Lease], now: i64) -> Result<(), StoreError> {
    let leases = store.state_leases(holder, held, now).await?;
    if leases > 0 {
        warn!(leases, "given back: the answer of the database to a commit was lost");
    }
    Ok(())
}

/// Waits until there may be work after `idle` without any, or until something else is `wanted`. Returns how long, at most.
async fn wait(
    store: &Store,
    idle: Duration,
    least: Duration,
    answers: bool,
    shutdown: &Shutdown,
    requested: ShutdownState,
) -> Duration {
    let wait = match answers && store.has_job_notifications() {
        true => NOTIFIED_POLL_INTERVAL,
        false => (idle / IDLE_DIVISOR).min(MAX_POLL_INTERVAL).max(least),
    };
    tokio::select! {
        () = store.wait_for_jobs(wait) => {}
        () = shutdown.changed_from(requested) => {}
    }
    wait
}

/// What came of a lease.
enum LeaseOutcome {
    Done(Box<LabelAttempt>),
    /// Nobody waits for the result any more.
    NotWanted,
    /// Somebody else waits for this very calculation.
    Detached,
    /// Somebody asked to stop, and it goes on without this labeller, or waits to be read.
    LeftRunning,
    /// There was no time to end it.
    GraceExpired,
}

/// Works on a job, and renews the lease meanwhile. A label whose lease was lost is made to its end: if another is first, it
/// becomes a check. But a calculation of its own is ended when nobody waits for it, and left alone when somebody else does.
async fn make(
    store: &Store,
    method: &Method,
    lease: &Lease,
    timing: &Timing,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
) -> Result<LeaseOutcome, StoreError> {
    let mut making = pin!(method.make(store, lease, shutdown));
    let mut too_late = pin!(end_of_grace(timing.grace, shutdown));
    // Who has no time of grace is followed by others, who find the calculation.
    let leaves = timing.grace.is_none() && method.outlives_labeller();
    let mut leave = pin!(async {
        end_of_grace(leaves.then_some(DETACH_DELAY), shutdown).await;
        while method.calculation().is_none() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    let seconds = timing.lease_seconds();
    let mut held = true;
    loop {
        tokio::select! {
            made = &mut making => {
                return Ok(made?.map_or(LeaseOutcome::LeftRunning, |made| LeaseOutcome::Done(Box::new(made))));
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
        // A commit that the server was still at when its connection broke may have come after the look at the queue.
        match give_back_unknown(store, &lease.holder, &[lease], now()).await {
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

async fn end_of_grace(grace: Option<Duration>, shutdown: &Shutdown) {
    match grace {
        Some(grace) => {
            shutdown.stop_requested().await;
            tokio::time::sleep(grace).await;
        }
        None => std::future::pending().await,
    }
}

async fn deliver(
    store: &Store,
    lease: &Lease,
    validated: &Result<Calculated, Failure>,
    log: &str,
    attempts: u32,
    now: i64,
) -> Result<DeliveryOutcome, StoreError> {
    let failure = match validated {
        Ok(made) => return store.complete(lease, &label(made), now).await.map(DeliveryOutcome::Completed),
        Err(failure) => failure,
    };
    let (class, text) = (failure.class.name(), format!("{failure}\n{log}"));
    let text = text.trim_end();
    let failed = match failure.class {
        // That was no fault of the job.
        FailureClass::LostNode => store.release_lost(lease, class, text, now).await,
        _ => store.fail(lease, class, text, attempts, now).await,
    };
    failed.map(DeliveryOutcome::Failed)
}

/// A result as the store keeps it.
fn label(made: &Calculated) -> Label {
    Label {
        energy: made.energy,
        forces: made.forces.clone(),
        stress: made.stress,
        details: LabelDetails {
            energy_without_smearing: made.energy_without_smearing,
            magnetic_moments: made.magnetic_moments.clone(),
            magnetisation: made.magnetisation,
            electronic_steps: made.electronic_steps,
        },
    }
}
