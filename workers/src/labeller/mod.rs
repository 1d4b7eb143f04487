//! A labeller leases a job, has its method work on it, judges what comes of it and delivers.
//!
//! [`run`] is one of the tasks of a process, [`serve`] a process of its own, which outlives its orchestrator.

mod insist;
mod judge;
mod presence;
pub mod reference;

use std::panic;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use store::records::{Label, Lease, Protocol};
use store::{Store, StoreError};
use tokio::task::{JoinError, spawn_blocking};

use insist::insist;
pub use presence::serve;
pub use reference::{LabelFailure, ReferenceMethod};

/// Between two signs of life in the store, of every process that gives them there.
pub const SIGN_OF_LIFE: Duration = Duration::from_secs(5);
/// The longest time between two looks at the queue.
const LONGEST_IDLE: Duration = Duration::from_secs(1);
/// Which part of the time without work passes until the next look, and so how late work may be found.
const IDLE_PART: u32 = 8;

/// What a labeller needs to know.
#[derive(Clone, Debug)]
pub struct LabellerSettings {
    /// Whose leases these are: the name of a process that has its record in the store, or `process/part`.
    pub holder: String,
    /// Under which settings labels are made.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// Largest force that is believed, eV/Å.
    pub largest_force: f64,
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
    pub sign_of_life: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self { lease: Duration::from_secs(600), idle: Duration::from_millis(50), sign_of_life: SIGN_OF_LIFE }
    }
}

impl Timing {
    fn lease_seconds(&self) -> u32 {
        u32::try_from(self.lease.as_secs()).unwrap_or(u32::MAX).max(1)
    }
}

/// When a labeller may go home.
#[derive(Debug, Default)]
pub struct Closing {
    /// No more jobs will be queued: go home once there are none.
    pub no_more_jobs: AtomicBool,
    /// Go home after the label in hand.
    pub stopping: AtomicBool,
}

/// What a look at the queue finds.
enum Found {
    Job(Box<Lease>),
    Nothing,
    /// Nothing, and nothing will come.
    TheEnd,
}

/// Labels until there is nothing more to do. `now` is asked for ms since 1970.
///
/// A database that is busy or full is no reason to end: the queue is looked at again later, and a label that was made is
/// brought again and again, after `closing` asks to stop for a minute more.
///
/// # Errors
/// Whatever else the database says; the label in hand is lost then, and its job comes back.
pub async fn run(
    store: Store,
    mut method: ReferenceMethod,
    settings: LabellerSettings,
    closing: &Closing,
    now: impl Fn() -> i64,
) -> Result<(), StoreError> {
    let mut idle = Duration::ZERO;
    while !closing.stopping.load(Ordering::Relaxed) {
        let last_look = closing.no_more_jobs.load(Ordering::Relaxed);
        let lease = match look(&store, &settings, last_look, now()).await {
            Ok(Found::Job(lease)) => lease,
            Ok(Found::TheEnd) => break,
            Err(error) if !error.is_transient() => return Err(error),
            Ok(Found::Nothing) | Err(_) => {
                let wait = (idle / IDLE_PART).min(LONGEST_IDLE).max(settings.timing.idle);
                nap(wait, settings.timing.idle, closing, last_look).await;
                idle += wait;
                continue;
            }
        };
        idle = Duration::ZERO;
        let made;
        (method, made) = make(&store, method, &lease, &settings.timing, &now).await?;
        let judged = made.and_then(|label| judge::judge(label, &lease, settings.largest_force));
        insist(closing, || deliver(&store, &lease, &judged, &settings, now())).await?;
    }
    Ok(())
}

async fn look(
    store: &Store,
    settings: &LabellerSettings,
    last_look: bool,
    now: i64,
) -> Result<Found, StoreError> {
    if store.unfinished_jobs().await? == 0 {
        return Ok(if last_look { Found::TheEnd } else { Found::Nothing });
    }
    let (protocol, seconds) = (settings.protocol.hash, settings.timing.lease_seconds());
    let lease = store.lease(protocol, &settings.holder, now, seconds).await?;
    Ok(lease.map_or(Found::Nothing, |lease| Found::Job(Box::new(lease))))
}

/// Waits in steps of `step`, so that it ends at once when there may be a reason to go home.
async fn nap(wait: Duration, step: Duration, closing: &Closing, last_look: bool) {
    let mut left = wait;
    while !left.is_zero()
        && !closing.stopping.load(Ordering::Relaxed)
        && closing.no_more_jobs.load(Ordering::Relaxed) == last_look
    {
        tokio::time::sleep(left.min(step)).await;
        left = left.saturating_sub(step);
    }
}

/// Makes a label on a thread of its own, and renews the lease meanwhile. A label whose lease was lost is made to its
/// end: if another is first, it becomes a check.
async fn make(
    store: &Store,
    mut method: ReferenceMethod,
    lease: &Lease,
    timing: &Timing,
    now: impl Fn() -> i64,
) -> Result<(ReferenceMethod, Result<Label, LabelFailure>), StoreError> {
    let structure = lease.structure.clone();
    let mut making = spawn_blocking(move || {
        let made = method.label(&structure);
        (method, made)
    });
    let mut held = true;
    loop {
        let seconds = timing.lease_seconds();
        tokio::select! {
            made = &mut making => return made.or_else(crashed),
            () = tokio::time::sleep(Duration::from_secs(seconds.into()) / 3), if held => {
                held = match store.renew(lease, now(), seconds).await {
                    // There is time for another try.
                    Err(error) if error.is_transient() => true,
                    renewed => renewed?,
                };
            }
        }
    }
}

/// A method that panics takes its labeller with it.
fn crashed<T>(crash: JoinError) -> Result<T, StoreError> {
    panic::resume_unwind(crash.into_panic())
}

async fn deliver(
    store: &Store,
    lease: &Lease,
    judged: &Result<Label, LabelFailure>,
    settings: &LabellerSettings,
    now: i64,
) -> Result<(), StoreError> {
    match judged {
        Ok(label) => store.complete(lease, label, now).await.map(|_| ()),
        Err(failure) => {
            store.fail(lease, failure.class(), &failure.to_string(), settings.attempts, now).await.map(|_| ())
        }
    }
}
