//! Manages the walker and labeller processes of a run.

use std::time::Duration;

use orchestrator::launcher::{self, Children};
use orchestrator::supervisor::ChildState;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use tokio::time::{Interval, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use wire::ipc::ServerHandle;
use workers::labeller::HEARTBEAT_INTERVAL;

use super::db_status::DbStatus;
use super::labellers::Labellers;
use super::process_records::ProcessRecords;
use crate::exit_status::CommandError;
use crate::output::log_and_print;

/// Interval between checks for unfinished labels after the last walk has ended.
pub const LABEL_CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// A labeller that has run this long counts as working: its configuration is valid.
pub const PROVEN_AFTER: Duration = Duration::from_secs(10);

/// The walkers and labellers of a run.
pub struct ProcessManager<'a> {
    store: &'a Store,
    records: ProcessRecords<'a>,
    line: ServerHandle,
    walkers: Children,
    labellers: Labellers,
    heartbeats: Interval,
    label_checks: Option<Interval>,
    /// Whether all walkers, and all labellers, have ended.
    ended: [bool; 2],
    /// Cancelled to make the reactor dismiss the walkers.
    stopping: CancellationToken,
    failure: Option<String>,
    /// Whether the database is reachable.
    db_status: DbStatus,
}

/// An event to handle.
pub enum Event {
    /// From a walker.
    Walker(launcher::ChildEvent),
    /// From a labeller.
    Labeller(launcher::ChildEvent),
    /// Heartbeats are due.
    Heartbeat,
    /// A check for unfinished labels is due.
    LabelCheck,
}

impl<'a> ProcessManager<'a> {
    /// Manages the processes of the orchestrator `process`. [`ProcessManager::next_event`] starts them.
    pub fn new(
        store: &'a Store,
        process: ProcessRecord,
        line: ServerHandle,
        mut walkers: Children,
        labellers: Labellers,
        stopping: CancellationToken,
    ) -> Self {
        let mut heartbeats = interval(HEARTBEAT_INTERVAL);
        heartbeats.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let records = ProcessRecords::new(store, process, walkers.status().len());
        Self {
            store,
            records,
            line,
            walkers,
            labellers,
            heartbeats,
            label_checks: None,
            ended: [false; 2],
            stopping,
            failure: None,
            db_status: DbStatus::default(),
        }
    }

    /// A callback for messages of walkers: takes the walker's number and whether the message delivered something.
    pub fn listener(&self) -> impl FnMut(u32, bool) + Send + 'static {
        let (signs, heard) = (self.walkers.heartbeats(), self.records.listener());
        move |walker, useful| {
            heard(walker);
            if useful { signs.delivered(walker) } else { signs.heartbeat(walker) }
        }
    }

    /// Waits for the next event. Cancel-safe.
    pub async fn next_event(&mut self) -> Event {
        let label_checks = async {
            match &mut self.label_checks {
                Some(interval) => interval.tick().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            event = self.walkers.next() => Event::Walker(event),
            event = self.labellers.children.next() => Event::Labeller(event),
            _ = self.heartbeats.tick() => Event::Heartbeat,
            _ = label_checks => Event::LabelCheck,
        }
    }

    /// Handles an event. A database that is busy or full for a moment is not fatal: the next heartbeat writes what is
    /// missing.
    pub async fn handle(&mut self, event: Event) {
        let done = match event {
            Event::Walker(event) => self.handle_walker(event).await,
            Event::Labeller(event) => self.handle_labeller(event).await,
            Event::Heartbeat => {
                let written = self.send_heartbeats().await;
                self.db_status.observe(&written);
                written
            }
            Event::LabelCheck => self.check_labels().await,
        };
        match done {
            Ok(()) => {}
            // Their heartbeats cannot be read now.
            Err(error) if error.is_transient() => self.labellers.assume_all_alive(),
            Err(error) => self.fail(error.to_string()),
        }
    }

    /// Asks all processes to end in order.
    pub fn stop(&mut self) {
        self.label_checks = None;
        self.stopping.cancel();
        self.walkers.stop();
        self.labellers.children.stop();
    }

    /// Lets the labellers finish the queue, since no more structures will come.
    pub fn wait_for_labels(&mut self) {
        if !self.is_stopping() {
            self.label_checks = Some(interval(LABEL_CHECK_INTERVAL));
        }
    }

    /// Whether all processes have ended and no external label is awaited.
    pub fn has_ended(&self) -> bool {
        self.ended == [true; 2] && self.label_checks.is_none()
    }

    /// Fails if the campaign cannot continue.
    pub fn failure(&self) -> Result<(), CommandError> {
        self.failure.clone().map_or(Ok(()), |failure| Err(CommandError::Failed(failure)))
    }

    fn is_stopping(&self) -> bool {
        self.stopping.is_cancelled()
    }

    fn fail(&mut self, why: String) {
        self.failure.get_or_insert(why);
        self.stop();
    }

    async fn handle_walker(&mut self, event: launcher::ChildEvent) -> Result<(), StoreError> {
        match event {
            launcher::ChildEvent::Started { number, incarnation, pid } => {
                self.records.walker_started(number, incarnation, pid).await?;
            }
            launcher::ChildEvent::Stderr { number, line } => {
                log_and_print(format_args!("walker {number}: {line}"))
            }
            launcher::ChildEvent::Ended { number, ended } => {
                self.line.lost(number, ended.incarnation, ended.reason.is_crash());
                if ended.then == ChildState::Exited {
                    // There is no more work for the other walkers either.
                    self.walkers.close();
                }
                self.records.walker_ended(number, &ended).await?;
            }
            launcher::ChildEvent::AllExited => {
                self.ended[0] = true;
                self.line.close();
                let failed = all_failed_message(&mut self.walkers);
                self.fail_if_none_left("walker", failed);
            }
        }
        Ok(())
    }

    async fn handle_labeller(&mut self, event: launcher::ChildEvent) -> Result<(), StoreError> {
        match event {
            launcher::ChildEvent::Started { number, pid, .. } => self.labellers.started(number, pid),
            launcher::ChildEvent::Stderr { number, line } => {
                log_and_print(format_args!("labeller {number}: {line}"))
            }
            launcher::ChildEvent::Ended { number, ended } => {
                let record = self.labellers.ended(self.store, number, &ended).await?;
                self.records.labeller_ended(number, record, &ended).await?;
            }
            launcher::ChildEvent::AllExited => {
                self.ended[1] = true;
                let failed = all_failed_message(&mut self.labellers.children);
                self.fail_if_none_left("labeller", failed);
            }
        }
        Ok(())
    }

    /// Fails the run if no process of this kind is left to do the work.
    fn fail_if_none_left(&mut self, kind: &str, failed: Option<String>) {
        if let Some(failed) = failed.filter(|_| !self.is_stopping()) {
            self.fail(format!("no {kind} is left: {failed}"));
        }
    }

    /// Writes the heartbeats of this process and its walkers. Labellers write their own.
    async fn send_heartbeats(&mut self) -> Result<(), StoreError> {
        self.records.write_heartbeats(self.line.traffic()).await?;
        // This includes processes whose end could not be recorded at once.
        self.store.release_leases_of_dead_processes(unix_milliseconds()).await?;
        self.labellers.read_heartbeats(self.store, PROVEN_AFTER).await
    }

    async fn check_labels(&mut self) -> Result<(), StoreError> {
        if !self.store.has_pending_labels(unix_milliseconds()).await? {
            self.label_checks = None;
            self.labellers.children.stop();
        }
        Ok(())
    }
}

/// How the last process failed, if all of them have failed for good.
pub fn all_failed_message(children: &mut Children) -> Option<String> {
    let status = children.status();
    let failed = status.iter().all(|child| child.state == ChildState::Failed);
    let last = status.last().filter(|_| failed)?;
    let how = last.last_failure.as_ref().map(ToString::to_string).unwrap_or_default();
    Some(format!("each failed after {} restarts, number {} with {how}", last.restarts, last.number))
}
