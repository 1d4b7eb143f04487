//! The labellers of `calmwalk label`. They end with the command, and no run of the campaign adopts them.

use std::path::PathBuf;
use std::pin::pin;
use std::time::Duration;

use futures_util::FutureExt;
use orchestrator::launcher::{ChildEvent, Children, Launch};
use orchestrator::supervisor::{ChildState, Limits};
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use workers::labeller::HEARTBEAT_INTERVAL;

use super::labellers::Labellers;
use super::multi_process::LABELLER_TIMEOUT;
use super::process_manager::{PROVEN_AFTER, all_failed_message};
use super::process_records;
use crate::exit_status::{CommandError, ExitStatus};
use crate::label_setup::LabelSetup;
use crate::output::{Bar, log_and_print, print_stderr};
use crate::process_config::{self, LabellerConfig, PoolConfig};

/// Time beyond its grace period that a stopping labeller has to release its lease.
const RELEASE_TIME: Duration = Duration::from_secs(10);

const BAR: &str = "{spinner} {pos} labels made  {wide_msg}";

/// Settings of the pool.
pub struct LabelPool {
    /// Number of labellers.
    pub number: u32,
    /// Directory of the campaign, or URL of its store.
    pub location: PathBuf,
    /// How to make labels.
    pub label_setup: LabelSetup,
    /// Restarts of a labeller that fails again and again.
    pub max_restarts: u32,
    /// Whether the labellers exit when the queue is empty and no run is active.
    pub until_empty: bool,
    /// Time that labels in progress may take after a stop.
    pub grace_period: Duration,
}

/// Makes labels until there is nothing left to do or `stop` is cancelled.
///
/// Await this on the main thread: the labellers end with the thread that starts them.
pub async fn run(
    store: &Store,
    pool: LabelPool,
    stop: &CancellationToken,
) -> Result<ExitStatus, CommandError> {
    let attempts = pool.label_setup.max_attempts;
    let mut manager = PoolManager {
        store,
        labellers: Labellers::new(children(pool), Default::default(), attempts),
        display: LabelPoolDisplay { bar: Bar::new(None, BAR), labels: 0, queue: String::new() },
        unreachable: false,
    };
    let mut ticks = interval(HEARTBEAT_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut stop_requested, mut failure) = (pin!(stop.cancelled().fuse()), None);
    loop {
        let done = tokio::select! {
            event = manager.labellers.children.next() => match event {
                ChildEvent::AllExited => break,
                event => manager.handle(event).await,
            },
            _ = ticks.tick() => manager.update().await,
            () = &mut stop_requested => {
                manager.labellers.children.stop();
                Ok(())
            }
        };
        if let Err(error) = manager.check(done) {
            failure.get_or_insert(error.to_string());
            manager.labellers.children.stop();
        }
    }
    let failure = failure.or_else(|| all_failed_message(&mut manager.labellers.children));
    match failure.filter(|_| !stop.is_cancelled()) {
        Some(why) => Err(CommandError::Failed(format!("all labellers failed: {why}"))),
        None if stop.is_cancelled() => Ok(ExitStatus::Interrupted),
        None => Ok(ExitStatus::Done),
    }
}

fn children(pool: LabelPool) -> Children {
    let limits = Limits {
        heartbeat_timeout: LABELLER_TIMEOUT,
        grace_period: pool.grace_period + RELEASE_TIME,
        max_restarts: pool.max_restarts,
        ..Limits::default()
    };
    let LabelPool { number, location, label_setup, until_empty, grace_period, .. } = pool;
    let pool =
        PoolConfig { parent: std::process::id(), until_empty, grace_period: grace_period.as_secs_f64() };
    let setup = LabellerConfig::new(location, label_setup);
    Children::new(number, limits, move |_, incarnation| {
        let restarts = incarnation.saturating_sub(1);
        let setup = LabellerConfig { restarts, pool: Some(pool.clone()), ..setup.clone() };
        Launch::this_program(["labeller"], process_config::to_bytes(&setup))
    })
}

/// The running labellers.
struct PoolManager<'a> {
    store: &'a Store,
    labellers: Labellers,
    display: LabelPoolDisplay,
    /// Whether the last attempt to reach the database failed.
    unreachable: bool,
}

impl PoolManager<'_> {
    async fn handle(&mut self, event: ChildEvent) -> Result<(), StoreError> {
        match event {
            ChildEvent::Started { number, pid, .. } => self.labellers.started(number, pid),
            ChildEvent::Stderr { number, line } => self.display.child_line(number, &line),
            ChildEvent::Ended { number, ended } => {
                if !matches!(ended.then, ChildState::Exited) {
                    self.display.line(&format!("label worker {number}: {}; {}", ended.reason, ended.then));
                }
                let record = self.labellers.ended(self.store, number, &ended).await?;
                if let Some(record) = record {
                    process_records::write_end(self.store, record, &ended).await?;
                }
            }
            ChildEvent::AllExited => {}
        }
        Ok(())
    }

    /// Reads the labellers' heartbeats and displays the state of the queue.
    async fn update(&mut self) -> Result<(), StoreError> {
        self.labellers.read_heartbeats(self.store, PROVEN_AFTER).await?;
        let jobs = self.store.has_pending_labels(unix_milliseconds()).await?;
        let leaders = self.store.processes(Some(ProcessRecord::ORCHESTRATOR)).await?;
        self.display.queue(jobs, leaders.iter().any(ProcessRecord::is_leading));
        Ok(())
    }

    /// Reports a transient error once and returns any other.
    fn check(&mut self, done: Result<(), StoreError>) -> Result<(), StoreError> {
        match done {
            Ok(()) => self.unreachable = false,
            Err(error) if error.is_transient() => {
                if !std::mem::replace(&mut self.unreachable, true) {
                    self.display.line(&format!("cannot read the store: {error}"));
                }
                // Their heartbeats cannot be read now.
                self.labellers.assume_all_alive();
            }
            Err(error) => return Err(error),
        }
        Ok(())
    }
}

/// Shows a bar on a terminal, otherwise a line for each label.
struct LabelPoolDisplay {
    bar: Bar,
    labels: u64,
    /// The last message about the queue.
    queue: String,
}

impl LabelPoolDisplay {
    fn child_line(&mut self, worker: u32, line: &str) {
        if line.starts_with("labelled ") {
            self.labels += 1;
            if self.bar.is_shown() {
                return self.bar.set(self.labels, || line.to_owned());
            }
        }
        // The labeller has logged it already.
        self.bar.suspend(|| print_stderr(format_args!("label worker {worker}: {line}")));
    }

    fn queue(&mut self, jobs: bool, led: bool) {
        let queue = match (jobs, led) {
            (false, true) => "the queue is empty: waiting for structures",
            (false, false) => "the queue is empty, and no run is active",
            _ => "",
        };
        if queue != self.queue && !queue.is_empty() {
            self.line(queue);
        }
        queue.clone_into(&mut self.queue);
    }

    fn line(&self, line: &str) {
        self.bar.suspend(|| log_and_print(line));
    }
}
