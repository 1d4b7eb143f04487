//! A labeller leases a job, has its method work on it, judges what comes of it and delivers.
//!
//! [`run`] is one of the tasks of a process, [`serve`] a process of its own, which outlives its orchestrator.

mod begun;
mod closing;
mod code;
mod difference;
mod energies;
mod guard;
mod here;
mod insist;
mod judge;
mod keeper;
mod log;
mod method;
mod once;
mod pack;
mod prepare;
mod presence;
mod private;
mod reference;
mod running;
mod scratch;
mod session;
mod slurm;
mod told;
mod tree;

use std::pin::pin;
use std::time::{Duration, Instant};

use dft::{Failure, FailureClass, Results};
use store::records::{Label, LabelDetails, Lease, Protocol};
use store::{Store, StoreError, Whereabouts};
use tracing::{debug, info, warn};

use closing::Wanted;
use code::Ended;
use energies::Offsets;
use method::Made;
use told::Became;

pub use closing::Closing;
pub use code::CodeMethod;
pub use energies::{energy_offsets, labelled_energy};
pub use guard::{GUARD, LabelGuard, Pair};
pub use insist::insist;
pub use judge::LabelBounds;
pub use keeper::{KeeperCommand, keep};
pub use method::Method;
pub use once::{Once, label_once};
pub use presence::{Stay, serve};
pub use reference::ReferenceMethod;
pub use running::{BatchSystem, Keep, Running};

/// Between two signs of life in the store, of every process that gives them there.
pub const SIGN_OF_LIFE: Duration = Duration::from_secs(5);
/// The longest time between two looks at the queue …
const LONGEST_IDLE: Duration = Duration::from_secs(1);
/// … and where the database tells of new jobs: only leases that ran out are not told of.
const TOLD_IDLE: Duration = Duration::from_secs(5);
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
    /// What is believed of a label.
    pub bounds: LabelBounds,
    /// For how long it is of use, if it is a process of its own, while nobody leads the campaign.
    pub stay: Stay,
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
            sign_of_life: SIGN_OF_LIFE,
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
enum Found {
    Job(Box<Lease>),
    Nothing,
    /// Nothing, and nothing will come.
    TheEnd,
}

/// After it was asked to stop, a labeller waits so long for a calculation that goes on without it.
const LAST_LABEL: Duration = Duration::from_secs(5);

/// Labels until there is nothing more to do. `now` is asked for ms since 1970; `tell` gets a line for each job.
///
/// A database that is busy or full is no reason to end: the queue is looked at again later, and a label that was made is
/// brought again and again, after `closing` asks to stop for a minute more.
///
/// # Errors
/// Whatever else the database says; the label in hand is lost then, and its job comes back.
pub async fn run(
    store: Store,
    method: Method,
    settings: LabellerSettings,
    closing: &Closing,
    now: impl Fn() -> i64,
    tell: impl Fn(&str),
) -> Result<(), StoreError> {
    let done = work(&store, &method, &settings, closing, now, tell).await;
    method.end();
    done
}

async fn work(
    store: &Store,
    method: &Method,
    settings: &LabellerSettings,
    closing: &Closing,
    now: impl Fn() -> i64,
    tell: impl Fn(&str),
) -> Result<(), StoreError> {
    let say = |line: &str| {
        info!("{line}");
        tell(line);
    };
    let (mut idle, mut offsets) = (Duration::ZERO, Offsets::default());
    method.begin(store, closing).await?;
    loop {
        let wanted = closing.wanted();
        if wanted.stop {
            return Ok(());
        }
        let lease = match look(store, settings, wanted.no_more_jobs, now()).await {
            Ok(Found::Job(lease)) => lease,
            Ok(Found::TheEnd) => return Ok(()),
            Err(error) if !error.is_transient() => return Err(error),
            looked => {
                idle += wait(store, idle, settings.timing.idle, looked.is_ok(), closing, wanted).await;
                continue;
            }
        };
        idle = Duration::ZERO;
        debug!(candidate = lease.candidate, job = lease.job, attempt = lease.attempt, "leased");
        let begun = Instant::now();
        let size = method.size(&lease.structure);
        if let Some(reason) = insist(closing, || guard::refusal(store, &lease, size)).await? {
            // Whatever was tried before, another attempt would be refused as well.
            insist(closing, || store.fail(&lease, guard::REFUSED, &reason, 1, now())).await?;
            say(&format!("{} is refused: {reason}", lease.candidate));
            continue;
        }
        let made = match make(store, method, &lease, &settings.timing, closing, &now).await? {
            Work::Done(made) => *made,
            Work::NotWanted => {
                method.stop().await?;
                say(&format!("{} is given up here: it has its label, or is wanted no more", lease.candidate));
                continue;
            }
            Work::LetGo => {
                method.let_go();
                say(&format!("{} is finished by somebody else here", lease.candidate));
                continue;
            }
            Work::LeftToOthers => {
                method.let_go();
                say(&format!("{} goes on and is left to the next labeller here", lease.candidate));
                return insist(closing, || store.release_all(&settings.holder, now())).await.map(drop);
            }
            Work::TooLate => {
                method.stop().await?;
                say(&format!("{} is given back: there is no time to finish it", lease.candidate));
                return insist(closing, || store.release_all(&settings.holder, now())).await.map(drop);
            }
        };
        let expected = offsets.expected(store, &settings.protocol, &lease, &made.result, closing).await?;
        let made = made.judged(&lease, &settings.bounds, expected);
        let Brought { judged, became, ended } =
            bring(store, method, &lease, settings, made, closing, &now).await?;
        let line = told::line(&lease, &judged, &became, begun.elapsed().as_secs_f64());
        match &judged {
            Ok(_) => info!(job = lease.job, attempt = lease.attempt, "{line}"),
            Err(failure) => {
                warn!(job = lease.job, attempt = lease.attempt, class = failure.class.name(), "{line}");
            }
        }
        tell(&line);
        if let Some(ended) = ended {
            method.put_away(store, &lease, closing, ended, judged.is_err()).await?;
        }
    }
}

/// A result that the store has.
struct Brought {
    judged: Result<Results, Failure>,
    became: Became,
    ended: Option<Ended>,
}

/// Brings what was made for a job and judged to the store, with what it has cost.
async fn bring(
    store: &Store,
    method: &Method,
    lease: &Lease,
    settings: &LabellerSettings,
    made: Made,
    closing: &Closing,
    now: impl Fn() -> i64,
) -> Result<Brought, StoreError> {
    let Made { result: judged, ended } = made;
    let log = ended.as_ref().map_or("", |ended| &ended.log);
    if let Some(ended) = &ended {
        insist(closing, || store.account(lease, ended.core_seconds, log)).await?;
    }
    // What no remedy helps against is not tried again.
    let no_remedy = judged.as_ref().is_err_and(|failure| method.has_no_remedy(lease, failure));
    let attempts = if no_remedy { 1 } else { settings.attempts };
    let became = insist(closing, || deliver(store, lease, &judged, log, attempts, now())).await?;
    Ok(Brought { judged, became, ended })
}

async fn look(
    store: &Store,
    settings: &LabellerSettings,
    last_look: bool,
    now: i64,
) -> Result<Found, StoreError> {
    // Its loop holds none now: leasing a job, working on it and the next look follow each other.
    give_back_unknown(store, &settings.holder, &[], now).await?;
    if !store.awaits_labels(now).await? {
        return Ok(if last_look { Found::TheEnd } else { Found::Nothing });
    }
    let (protocol, seconds) = (settings.protocol.hash, settings.timing.lease_seconds());
    match store.lease(protocol, &settings.holder, now, seconds).await? {
        Some(lease) => Ok(Found::Job(Box::new(lease))),
        // What there is to do is for others.
        None if !store.is_in_force(protocol).await? => Ok(Found::TheEnd),
        None => Ok(Found::Nothing),
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
    closing: &Closing,
    wanted: Wanted,
) -> Duration {
    let wait = match answers && store.tells_of_jobs() {
        true => TOLD_IDLE,
        false => (idle / IDLE_PART).min(LONGEST_IDLE).max(least),
    };
    tokio::select! {
        () = store.wait_for_jobs(wait) => {}
        () = closing.other_than(wanted) => {}
    }
    wait
}

/// What came of a lease.
enum Work {
    Done(Box<Made>),
    /// Nobody waits for the result any more.
    NotWanted,
    /// Somebody else waits for this very calculation.
    LetGo,
    /// Somebody asked to stop, and it goes on without this labeller, or waits to be read.
    LeftToOthers,
    /// There was no time to end it.
    TooLate,
}

/// Works on a job, and renews the lease meanwhile. A label whose lease was lost is made to its end: if another is first, it
/// becomes a check. But a calculation of its own is ended when nobody waits for it, and left alone when somebody else does.
async fn make(
    store: &Store,
    method: &Method,
    lease: &Lease,
    timing: &Timing,
    closing: &Closing,
    now: impl Fn() -> i64,
) -> Result<Work, StoreError> {
    let mut making = pin!(method.make(store, lease, closing));
    let mut too_late = pin!(end_of_grace(timing.grace, closing));
    // Who has no time of grace is followed by others, who find the calculation.
    let leaves = timing.grace.is_none() && method.outlives_its_labeller();
    let mut leave = pin!(async {
        end_of_grace(leaves.then_some(LAST_LABEL), closing).await;
        while method.calculation().is_none() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    let seconds = timing.lease_seconds();
    let mut held = true;
    loop {
        tokio::select! {
            made = &mut making => {
                return Ok(made?.map_or(Work::LeftToOthers, |made| Work::Done(Box::new(made))));
            }
            () = &mut too_late => return Ok(Work::TooLate),
            () = &mut leave => return Ok(Work::LeftToOthers),
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
        match store.whereabouts(lease).await {
            Ok(Whereabouts::Over) => return Ok(Work::NotWanted),
            Ok(Whereabouts::LeasedAgain { calculation: Some(other) }) if other == own => {
                return Ok(Work::LetGo);
            }
            Ok(_) => {}
            Err(error) if error.is_transient() => {}
            Err(error) => return Err(error),
        }
    }
}

async fn end_of_grace(grace: Option<Duration>, closing: &Closing) {
    match grace {
        Some(grace) => {
            closing.stopped().await;
            tokio::time::sleep(grace).await;
        }
        None => std::future::pending().await,
    }
}

async fn deliver(
    store: &Store,
    lease: &Lease,
    judged: &Result<Results, Failure>,
    log: &str,
    attempts: u32,
    now: i64,
) -> Result<Became, StoreError> {
    let failure = match judged {
        Ok(made) => return store.complete(lease, &label(made), now).await.map(Became::Completed),
        Err(failure) => failure,
    };
    let (class, text) = (failure.class.name(), format!("{failure}\n{log}"));
    let text = text.trim_end();
    let failed = match failure.class {
        // That was no fault of the job.
        FailureClass::LostNode => store.lose(lease, class, text, now).await,
        _ => store.fail(lease, class, text, attempts, now).await,
    };
    failed.map(Became::Failed)
}

/// A result as the store keeps it.
fn label(made: &Results) -> Label {
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
