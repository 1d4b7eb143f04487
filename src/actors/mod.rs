//! The actors of a campaign at work: in processes of their own, or all in one.

pub mod agent;
mod agents;
mod answers;
pub mod budget;
mod crew;
pub mod in_process;
mod labellers;
mod listen;
pub mod notify;
mod pace;
pub mod processes;
mod records;
pub mod scratch;
pub mod slots;
mod starts;

use std::path::Path;
use std::process;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use orchestrator::reactor::{self, Notice, Reactor};
use orchestrator::selector::Selector;
use store::{ProcessRecord, SERVER_AWAY, Store, unix_milliseconds};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{Notify, mpsc};
use wire::transport::Incoming;

use self::pace::Paces;
pub use listen::Listen;

use crate::campaign::Campaign;
use crate::config::QueueFull;
use crate::ends::Ends;
use crate::forgetting::Forgetting;
use crate::outcome::Failure;
use crate::output::say;
use crate::progress::Display;

/// Reports under way between walkers and reactor.
const CHANNEL: usize = 64;

/// A run of a campaign.
#[derive(Clone, Copy)]
pub struct Run<'a> {
    /// All that its configuration names.
    pub campaign: &'a Campaign,
    /// Its database.
    pub store: &'a Store,
    /// The record of this process.
    pub process: &'a ProcessRecord,
    /// Its directory.
    pub directory: &'a Path,
    /// Where agents of other hosts may join.
    pub listen: Option<&'a Listen>,
    /// Told when a limit of time is reached.
    pub over: &'a Arc<Notify>,
}

/// What is said when a campaign is asked to stop.
const STOPPING: &str = "stopping: walks are checkpointed …";

/// The reactor at work.
type ReactorTask = tokio::task::JoinHandle<Result<reactor::RunOutcome, reactor::ReactorError>>;

/// Starts the reactor, with a display of what it does.
fn start_reactor(
    run: Run<'_>,
    mut selector: Selector,
    incoming: mpsc::Receiver<Incoming>,
    stopping: &Arc<AtomicBool>,
) -> ReactorTask {
    let config = &run.campaign.config;
    let walk_steps = config.walk.equilibration + config.walk.steps.get();
    let mut ends = Ends::default();
    selector.ended_walks().for_each(|(walk, end, reason)| ends.add(walk.0, end, reason));
    let mut display =
        Display::new(walk_steps, selector.walk_progress(walk_steps), ends, Forgetting::new(&config.calm));
    let queue_limit = u64::from(config.label.queue_limit.get());
    if config.label.queue_full == QueueFull::Raise {
        selector.raise_threshold_above(queue_limit);
    }
    let reactor = Reactor {
        selector,
        store: run.store.clone().patient(SERVER_AWAY),
        incoming,
        stopping: Arc::clone(stopping),
        queue_limit,
    };
    let (store, paces) = (run.store.clone(), Mutex::new(Paces::default()));
    tokio::spawn(async move {
        let watch = |notice: Notice<'_>| {
            paces.lock().unwrap_or_else(PoisonError::into_inner).notice(&notice, unix_milliseconds());
            display.notice(&notice);
        };
        let ended = tokio::select! {
            ended = reactor.run(watch) => ended,
            never = pace::keep(&store, &paces) => match never {},
        };
        display.finish();
        ended
    })
}

/// Walkers side by side, as the configuration has it.
fn wanted_walkers(campaign: &Campaign) -> u32 {
    match campaign.config.run.walkers {
        0 => (cores() / campaign.config.run.threads.get() as u32).max(1),
        wanted => wanted as u32,
    }
}

/// Processor cores that this process may use.
pub fn cores() -> u32 {
    let there = thread::available_parallelism().map_or(1, |cores| cores.get()) as u32;
    // Not every batch system keeps a job to the processors that it was given.
    let given = std::env::var("SLURM_CPUS_PER_TASK").ok().and_then(|text| text.parse().ok());
    given.map_or(there, |given: u32| given.clamp(1, there))
}

/// Whether somebody has asked this process to stop, and what wakes whoever waits for that; `told` is said then.
pub fn asked_to_stop(told: &'static str) -> Result<(Arc<AtomicBool>, Arc<Notify>), Failure> {
    let (stopping, stop) = (Arc::new(AtomicBool::new(false)), Arc::new(Notify::new()));
    let asked = (Arc::clone(&stopping), Arc::clone(&stop));
    stop_on_signals(told, move || {
        asked.0.store(true, Ordering::Relaxed);
        asked.1.notify_one();
    })?;
    Ok((stopping, stop))
}

/// Stops in order, as on a signal, when a limit of time is reached.
fn stop_when_over(over: &Arc<Notify>, stop: impl FnOnce() + Send + 'static) {
    let over = Arc::clone(over);
    tokio::spawn(async move {
        over.notified().await;
        stop();
    });
}

/// A batch system tells every process of a job to end, and the job's script hands on what it is told: that is one request.
const AT_ONCE: Duration = Duration::from_secs(5);

/// Ctrl-C, SIGTERM and a closed terminal: the first calls `stop`, which stops in order, the second ends at once (which is
/// safe too), but for a SIGTERM that comes together with the first.
fn stop_on_signals(told: &'static str, stop: impl Fn() + Send + 'static) -> Result<(), Failure> {
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Failure::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::failed)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(Failure::failed)?;
    tokio::spawn(async move {
        let mut asked: Option<Instant> = None;
        loop {
            let again = tokio::select! {
                _ = interrupt.recv() => false,
                _ = hangup.recv() => false,
                _ = terminate.recv() => asked.is_some_and(|asked| asked.elapsed() < AT_ONCE),
            };
            if again {
                continue;
            }
            if asked.replace(Instant::now()).is_some() {
                process::exit(130);
            }
            stop();
            say(told);
        }
    });
    Ok(())
}
