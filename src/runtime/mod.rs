//! Runs a campaign: walkers and labellers in separate processes, or everything in one process.

pub mod agent_host;
mod agent_service;
mod db_status;
pub mod label_pool;
mod labellers;
mod listen;
pub mod multi_process;
pub mod notify;
mod process_manager;
mod process_records;
pub mod scratch_dir;
pub mod single_process;
mod spawn;
mod throughput;
pub mod time_budget;

use std::path::Path;
use std::process;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use monitor::walk_ends::WalkEnds;
use orchestrator::reactor::{self, Notice, Reactor};
use orchestrator::selector::Selector;
use store::{ProcessRecord, SERVER_RECONNECT_TIMEOUT, Store, unix_milliseconds};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{Notify, mpsc};
use wire::transport::Incoming;

use self::throughput::Throughput;
use crate::campaign::Campaign;
use crate::config::QueueFull;
use crate::exit_status::Failure;
use crate::forgetting::ForgettingRule;
use crate::output::log_and_print;
use crate::progress::Display;
pub use listen::Listen;

/// Capacity of the channel of reports from walkers to the reactor.
const CHANNEL: usize = 64;

/// What a run of a campaign needs.
#[derive(Clone, Copy)]
pub struct RunContext<'a> {
    /// The configuration and the files that it names, loaded.
    pub campaign: &'a Campaign,
    /// The campaign's database.
    pub store: &'a Store,
    /// The database record of this process.
    pub process: &'a ProcessRecord,
    /// The campaign's directory.
    pub directory: &'a Path,
    /// Where agents of other hosts may join.
    pub listen: Option<&'a Listen>,
    /// Notified when a time limit is reached.
    pub limit_reached: &'a Arc<Notify>,
}

/// Printed when a campaign is asked to stop.
const STOP_MESSAGE: &str = "stopping: walks are checkpointed …";

/// The task that runs the reactor.
type ReactorTask = tokio::task::JoinHandle<Result<reactor::RunOutcome, reactor::ReactorError>>;

/// Starts the reactor and displays its progress.
fn start_reactor(
    run: RunContext<'_>,
    mut selector: Selector,
    incoming: mpsc::Receiver<Incoming>,
    stopping: &Arc<AtomicBool>,
) -> ReactorTask {
    let config = &run.campaign.config;
    let walk_steps = config.walk.equilibration_steps + config.walk.biased_steps.get();
    let mut ends = WalkEnds::default();
    selector.ended_walks().for_each(|(walk, end, reason)| ends.add(walk.0, end, reason));
    let mut display =
        Display::new(walk_steps, selector.walk_progress(walk_steps), ends, ForgettingRule::new(&config.calm));
    let queue_limit = u64::from(config.label.queue_limit.get());
    if config.label.on_queue_full == QueueFull::Raise {
        selector.raise_threshold_above(queue_limit);
    }
    let reactor = Reactor {
        selector,
        store: run.store.clone().with_reconnect_timeout(SERVER_RECONNECT_TIMEOUT),
        incoming,
        stopping: Arc::clone(stopping),
        queue_limit,
    };
    let (store, throughput) = (run.store.clone(), Mutex::new(Throughput::default()));
    tokio::spawn(async move {
        let watch = |notice: Notice<'_>| {
            throughput.lock().unwrap_or_else(PoisonError::into_inner).notice(&notice, unix_milliseconds());
            display.notice(&notice);
        };
        let ended = tokio::select! {
            ended = reactor.run(watch) => ended,
            never = throughput::record(&store, &throughput) => match never {},
        };
        display.finish();
        ended
    })
}

/// Number of walkers to run in parallel, from the configuration.
fn wanted_walkers(campaign: &Campaign) -> u32 {
    match campaign.config.run.walkers {
        0 => (cores() / campaign.config.run.threads_per_walker.get() as u32).max(1),
        wanted => wanted as u32,
    }
}

/// Number of processor cores that this process may use.
pub fn cores() -> u32 {
    let there = thread::available_parallelism().map_or(1, |cores| cores.get()) as u32;
    // Not every batch system confines a job to its allocated cores.
    let given = std::env::var("SLURM_CPUS_PER_TASK").ok().and_then(|text| text.parse().ok());
    given.map_or(there, |given: u32| given.clamp(1, there))
}

/// Returns a flag that the first stop signal sets and a notification that it sends. Prints `message` then.
pub fn stop_signal(message: &'static str) -> Result<(Arc<AtomicBool>, Arc<Notify>), Failure> {
    let (stopping, stop) = (Arc::new(AtomicBool::new(false)), Arc::new(Notify::new()));
    let asked = (Arc::clone(&stopping), Arc::clone(&stop));
    on_stop_signal(message, move || {
        asked.0.store(true, Ordering::Relaxed);
        asked.1.notify_one();
    })?;
    Ok((stopping, stop))
}

/// Calls `stop` when a time limit is reached, as a stop signal would.
fn stop_at_limit(limit_reached: &Arc<Notify>, stop: impl FnOnce() + Send + 'static) {
    let limit_reached = Arc::clone(limit_reached);
    tokio::spawn(async move {
        limit_reached.notified().await;
        stop();
    });
}

/// A batch system signals every process of a job, and the job script forwards the signal it receives. Signals within
/// this time count as one request.
const SIGNAL_MERGE_WINDOW: Duration = Duration::from_secs(5);

/// Calls `stop` on the first Ctrl-C, SIGTERM or hang-up. A second signal exits at once, which is safe too, unless it
/// is a SIGTERM within [`SIGNAL_MERGE_WINDOW`] of the first.
fn on_stop_signal(message: &'static str, stop: impl Fn() + Send + 'static) -> Result<(), Failure> {
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Failure::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::failed)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(Failure::failed)?;
    tokio::spawn(async move {
        let mut asked: Option<Instant> = None;
        loop {
            let again = tokio::select! {
                _ = interrupt.recv() => false,
                _ = hangup.recv() => false,
                _ = terminate.recv() => asked.is_some_and(|asked| asked.elapsed() < SIGNAL_MERGE_WINDOW),
            };
            if again {
                continue;
            }
            if asked.replace(Instant::now()).is_some() {
                process::exit(130);
            }
            stop();
            log_and_print(message);
        }
    });
    Ok(())
}
