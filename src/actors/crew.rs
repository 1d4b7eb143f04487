//! The processes of a campaign: what happens to them, and what is done about it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use orchestrator::launcher::{self, Children};
use orchestrator::supervisor::ChildState;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use tokio::time::{Interval, MissedTickBehavior, interval};
use wire::ipc::ServerHandle;
use workers::labeller::SIGN_OF_LIFE;

use super::answers::Answers;
use super::labellers::Labellers;
use super::records::Records;
use crate::outcome::Failure;
use crate::output::say;

/// Between two looks whether labels are still to be made, once no more structures will come.
pub const LAST_LABELS: Duration = Duration::from_millis(100);
/// A labeller that has lived for so long is of use: what it was started with is in order.
pub const PROVEN: Duration = Duration::from_secs(10);

/// Walkers and labellers at work.
pub struct Crew<'a> {
    store: &'a Store,
    records: Records<'a>,
    line: ServerHandle,
    walkers: Children,
    labellers: Labellers,
    look: Interval,
    last_labels: Option<Interval>,
    /// Whether every walker is gone, every labeller.
    gone: [bool; 2],
    /// Tells the reactor to send walkers home.
    stopping: Arc<AtomicBool>,
    failure: Option<String>,
    /// Whether the database does.
    answers: Answers,
}

/// What there is to react to.
pub enum Event {
    /// A walker.
    Walker(launcher::ChildEvent),
    /// A labeller.
    Labeller(launcher::ChildEvent),
    /// It is time for signs of life.
    Look,
    /// It is time to look whether every label is made.
    LastLabels,
}

impl<'a> Crew<'a> {
    /// The crew of the orchestrator `process`; [`Crew::event`] starts it.
    pub fn new(
        store: &'a Store,
        process: ProcessRecord,
        line: ServerHandle,
        mut walkers: Children,
        labellers: Labellers,
        stopping: Arc<AtomicBool>,
    ) -> Self {
        let mut look = interval(SIGN_OF_LIFE);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let records = Records::new(store, process, walkers.status().len());
        Self {
            store,
            records,
            line,
            walkers,
            labellers,
            look,
            last_labels: None,
            gone: [false; 2],
            stopping,
            failure: None,
            answers: Answers::default(),
        }
    }

    /// To be told which walker was heard, and whether it delivered something.
    pub fn listener(&self) -> impl FnMut(u32, bool) + Send + 'static {
        let (signs, heard) = (self.walkers.heartbeats(), self.records.listener());
        move |walker, useful| {
            heard(walker);
            if useful { signs.delivered(walker) } else { signs.heartbeat(walker) }
        }
    }

    /// The next thing that happens. Dropped while it waits, it has lost nothing.
    pub async fn event(&mut self) -> Event {
        let last_labels = async {
            match &mut self.last_labels {
                Some(interval) => interval.tick().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            event = self.walkers.next() => Event::Walker(event),
            event = self.labellers.children.next() => Event::Labeller(event),
            _ = self.look.tick() => Event::Look,
            _ = last_labels => Event::LastLabels,
        }
    }

    /// Does what is to be done about it. A database that is busy or full for a moment is no reason to leave: what could
    /// not be said is said at the next look.
    pub async fn take_in(&mut self, event: Event) {
        let done = match event {
            Event::Walker(event) => self.walker(event).await,
            Event::Labeller(event) => self.labeller(event).await,
            Event::Look => {
                let looked = self.look().await;
                self.answers.tried(&looked);
                looked
            }
            Event::LastLabels => self.look_for_labels().await,
        };
        match done {
            Ok(()) => {}
            // They cannot be seen to be alive now.
            Err(error) if error.is_transient() => self.labellers.all_are_heard(),
            Err(error) => self.fail(error.to_string()),
        }
    }

    /// Asks everybody to end in order.
    pub fn stop(&mut self) {
        self.last_labels = None;
        self.stopping.store(true, Ordering::Relaxed);
        self.walkers.stop();
        self.labellers.children.stop();
    }

    /// No more structures will come: the labellers end when those that are there have their labels.
    pub fn wait_for_labels(&mut self) {
        if !self.is_stopping() {
            self.last_labels = Some(interval(LAST_LABELS));
        }
    }

    /// Whether nobody is left, and no label of others is waited for.
    pub fn is_gone(&self) -> bool {
        self.gone == [true; 2] && self.last_labels.is_none()
    }

    /// Why the campaign cannot go on, if it cannot.
    pub fn failure(&self) -> Result<(), Failure> {
        self.failure.clone().map_or(Ok(()), |failure| Err(Failure::Failed(failure)))
    }

    fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }

    fn fail(&mut self, why: String) {
        self.failure.get_or_insert(why);
        self.stop();
    }

    async fn walker(&mut self, event: launcher::ChildEvent) -> Result<(), StoreError> {
        match event {
            launcher::ChildEvent::Started { number, incarnation, pid } => {
                self.records.walker_started(number, incarnation, pid).await?;
            }
            launcher::ChildEvent::Stderr { number, line } => say(format_args!("walker {number}: {line}")),
            launcher::ChildEvent::Ended { number, ended } => {
                self.line.lost(number, ended.incarnation, ended.reason.is_crash());
                if ended.then == ChildState::Exited {
                    // There is no more work for the others either.
                    self.walkers.close();
                }
                self.records.walker_ended(number, &ended).await?;
            }
            launcher::ChildEvent::AllExited => {
                self.gone[0] = true;
                self.line.close();
                let given_up = all_given_up(&mut self.walkers);
                self.nobody_is_left("walker", given_up);
            }
        }
        Ok(())
    }

    async fn labeller(&mut self, event: launcher::ChildEvent) -> Result<(), StoreError> {
        match event {
            launcher::ChildEvent::Started { number, pid, .. } => self.labellers.started(number, pid),
            launcher::ChildEvent::Stderr { number, line } => say(format_args!("labeller {number}: {line}")),
            launcher::ChildEvent::Ended { number, ended } => {
                let record = self.labellers.ended(self.store, number, &ended).await?;
                self.records.labeller_ended(number, record, &ended).await?;
            }
            launcher::ChildEvent::AllExited => {
                self.gone[1] = true;
                let given_up = all_given_up(&mut self.labellers.children);
                self.nobody_is_left("labeller", given_up);
            }
        }
        Ok(())
    }

    /// Nobody of a kind is left to do the work.
    fn nobody_is_left(&mut self, kind: &str, given_up: Option<String>) {
        if let Some(given_up) = given_up.filter(|_| !self.is_stopping()) {
            self.fail(format!("no {kind} is left: {given_up}"));
        }
    }

    /// Signs of life: this process and its walkers give them in the database, labellers by themselves.
    async fn look(&mut self) -> Result<(), StoreError> {
        self.records.look(self.line.traffic()).await?;
        // Also of those whose end could not be written down at once.
        self.store.release_leases_of_gone_processes(unix_milliseconds()).await?;
        self.labellers.look(self.store, PROVEN).await
    }

    async fn look_for_labels(&mut self) -> Result<(), StoreError> {
        if !self.store.awaits_labels(unix_milliseconds()).await? {
            self.last_labels = None;
            self.labellers.children.stop();
        }
        Ok(())
    }
}

/// How the last of them failed, if all were given up.
pub fn all_given_up(children: &mut Children) -> Option<String> {
    let status = children.status();
    let given_up = status.iter().all(|child| child.state == ChildState::Failed);
    let last = status.last().filter(|_| given_up)?;
    let how = last.last_failure.as_ref().map(ToString::to_string).unwrap_or_default();
    Some(format!("each was given up after {} restarts, number {} with {how}", last.restarts, last.number))
}
