//! The actors of a campaign at work: in processes of their own, or all in one.

pub mod agent;
mod agents;
mod answers;
mod crew;
pub mod in_process;
mod labellers;
pub mod processes;
mod records;
pub mod slots;
mod starts;

use std::path::Path;
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use orchestrator::reactor::{self, Reactor};
use orchestrator::selector::Selector;
use store::{ProcessRecord, SERVER_AWAY, Store};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{Notify, mpsc};
use wire::net::{Endpoint, Tls};
use wire::transport::Incoming;

use crate::campaign::Campaign;
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
}

/// Where agents of other hosts may join.
#[derive(Clone, Debug)]
pub struct Listen {
    /// The address.
    pub endpoint: Endpoint,
    /// Needed for everything but loopback.
    pub tls: Option<Tls>,
}

/// What is said when a campaign is asked to stop.
const STOPPING: &str = "stopping: walks are checkpointed …";

/// The reactor at work.
type ReactorTask = tokio::task::JoinHandle<Result<reactor::Ended, reactor::ReactorError>>;

/// Starts the reactor, with a display of what it does.
fn start_reactor(
    run: Run<'_>,
    selector: Selector,
    incoming: mpsc::Receiver<Incoming>,
    stopping: &Arc<AtomicBool>,
) -> ReactorTask {
    let config = &run.campaign.config;
    let walk_steps = config.walk.equilibration + config.walk.steps.get();
    let mut display = Display::new(walk_steps, selector.standing(walk_steps));
    let reactor = Reactor {
        selector,
        store: run.store.clone().patient(SERVER_AWAY),
        incoming,
        stopping: Arc::clone(stopping),
        queue_limit: u64::from(config.label.queue_limit.get()),
    };
    tokio::spawn(async move {
        let ended = reactor.run(|notice| display.notice(&notice)).await;
        display.finish();
        ended
    })
}

/// Walkers side by side, as the configuration has it.
fn wanted_walkers(campaign: &Campaign) -> u32 {
    match campaign.config.run.walkers {
        0 => cores(),
        wanted => wanted as u32,
    }
}

/// Processor cores that this process may use.
pub fn cores() -> u32 {
    thread::available_parallelism().map_or(1, |cores| cores.get()) as u32
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

/// Ctrl-C, SIGTERM and a closed terminal: the first calls `stop`, which stops in order, the second ends at once (which is safe too).
fn stop_on_signals(told: &'static str, stop: impl Fn() + Send + 'static) -> Result<(), Failure> {
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Failure::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::failed)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(Failure::failed)?;
    tokio::spawn(async move {
        for first in [true, false] {
            tokio::select! { _ = interrupt.recv() => (), _ = terminate.recv() => (), _ = hangup.recv() => () };
            if !first {
                process::exit(130);
            }
            stop();
            say(told);
        }
    });
    Ok(())
}
