//! The labellers of `calmwalk label`: processes that end with it, and that no run of the campaign takes over.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use orchestrator::launcher::{ChildEvent, Children, Launch};
use orchestrator::supervisor::{ChildState, Limits};
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use tokio::sync::Notify;
use tokio::time::{MissedTickBehavior, interval};
use workers::labeller::SIGN_OF_LIFE;

use super::crew::{PROVEN, all_given_up};
use super::labellers::Labellers;
use super::processes::LABELLER_SILENCE;
use super::records;
use crate::labelling::Labelling;
use crate::outcome::{Ended, Failure};
use crate::output::{Bar, say, show};
use crate::setup::{self, LabellerSetup, SlotSetup};

/// A slot that was asked to stop needs some time beyond its grace to give its label back.
const GIVING_BACK: Duration = Duration::from_secs(10);

const BAR: &str = "{spinner} {pos} labels made  {wide_msg}";

/// What is to be done.
pub struct Slots {
    /// Labels side by side.
    pub number: u32,
    /// Directory of the campaign, or URL of its store.
    pub location: PathBuf,
    /// How labels are made.
    pub labelling: Labelling,
    /// Whether they leave when the queue is empty and nobody runs the campaign.
    pub until_empty: bool,
    /// How long labels in hand may take after a stop.
    pub grace: Duration,
}

/// Labels until there is nothing more to do or `stop` is notified. To be awaited on the main thread: the slots end with the
/// thread that starts them.
pub async fn work(
    store: &Store,
    slots: Slots,
    stopping: &Arc<AtomicBool>,
    stop: &Notify,
) -> Result<Ended, Failure> {
    let attempts = slots.labelling.attempts;
    let mut crew = Crew {
        store,
        labellers: Labellers::new(children(slots), Default::default(), attempts),
        display: Display { bar: Bar::new(None, BAR), labels: 0, queue: String::new() },
        deaf: false,
    };
    let mut look = interval(SIGN_OF_LIFE);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut given_up = None;
    loop {
        let done = tokio::select! {
            event = crew.labellers.children.next() => match event {
                ChildEvent::AllExited => break,
                event => crew.take_in(event).await,
            },
            _ = look.tick() => crew.look().await,
            () = stop.notified() => {
                crew.labellers.children.stop();
                Ok(())
            }
        };
        if let Err(error) = crew.hear(done) {
            given_up.get_or_insert(error.to_string());
            crew.labellers.children.stop();
        }
    }
    let given_up = given_up.or_else(|| all_given_up(&mut crew.labellers.children));
    match given_up.filter(|_| !stopping.load(Ordering::Relaxed)) {
        Some(why) => Err(Failure::Failed(format!("no slot is left: {why}"))),
        None if stopping.load(Ordering::Relaxed) => Ok(Ended::Interrupted),
        None => Ok(Ended::Done),
    }
}

fn children(slots: Slots) -> Children {
    let limits = Limits {
        heartbeat_timeout: LABELLER_SILENCE,
        grace_period: slots.grace + GIVING_BACK,
        ..Limits::default()
    };
    let Slots { number, location, labelling, until_empty, grace } = slots;
    let slot = SlotSetup { parent: std::process::id(), until_empty, grace: grace.as_secs_f64() };
    let setup = LabellerSetup::new(location, labelling);
    Children::new(number, limits, move |_, incarnation| {
        let restarts = incarnation.saturating_sub(1);
        let setup = LabellerSetup { restarts, slot: Some(slot.clone()), ..setup.clone() };
        Launch::this_program(["labeller"], setup::bytes(&setup))
    })
}

/// The slots at work.
struct Crew<'a> {
    store: &'a Store,
    labellers: Labellers,
    display: Display,
    /// Whether the database could not be asked at the last try.
    deaf: bool,
}

impl Crew<'_> {
    async fn take_in(&mut self, event: ChildEvent) -> Result<(), StoreError> {
        match event {
            ChildEvent::Started { number, pid, .. } => self.labellers.started(number, pid),
            ChildEvent::Stderr { number, line } => self.display.said(number, &line),
            ChildEvent::Ended { number, ended } => {
                if !matches!(ended.then, ChildState::Exited) {
                    self.display.line(&format!("slot {number}: {}; {}", ended.reason, ended.then));
                }
                let record = self.labellers.ended(self.store, number, &ended).await?;
                if let Some(record) = record {
                    records::write_down(self.store, record, &ended).await?;
                }
            }
            ChildEvent::AllExited => {}
        }
        Ok(())
    }

    /// Takes in the slots' signs of life, and says what the queue does.
    async fn look(&mut self) -> Result<(), StoreError> {
        self.labellers.look(self.store, PROVEN).await?;
        let jobs = self.store.awaits_labels(unix_milliseconds()).await?;
        let leaders = self.store.processes(Some(ProcessRecord::ORCHESTRATOR)).await?;
        self.display.queue(jobs, leaders.iter().any(ProcessRecord::is_leading));
        Ok(())
    }

    /// What may pass is said once; anything else is returned.
    fn hear(&mut self, done: Result<(), StoreError>) -> Result<(), StoreError> {
        match done {
            Ok(()) => self.deaf = false,
            Err(error) if error.is_transient() => {
                if !std::mem::replace(&mut self.deaf, true) {
                    self.display.line(&format!("the store cannot be asked: {error}"));
                }
                // They cannot be seen to be alive now.
                self.labellers.all_are_heard();
            }
            Err(error) => return Err(error),
        }
        Ok(())
    }
}

/// A bar on a terminal, otherwise a line for each label.
struct Display {
    bar: Bar,
    labels: u64,
    /// What was said of the queue last.
    queue: String,
}

impl Display {
    fn said(&mut self, slot: u32, line: &str) {
        if line.starts_with("labelled ") {
            self.labels += 1;
            if self.bar.is_shown() {
                return self.bar.set(self.labels, || line.to_owned());
            }
        }
        // It stands in the log already, as that of the slot.
        self.bar.suspend(|| show(format_args!("slot {slot}: {line}")));
    }

    fn queue(&mut self, jobs: bool, led: bool) {
        let queue = match (jobs, led) {
            (false, true) => "the queue is empty: waiting for structures",
            (false, false) => "the queue is empty, and nobody runs the campaign",
            _ => "",
        };
        if queue != self.queue && !queue.is_empty() {
            self.line(queue);
        }
        queue.clone_into(&mut self.queue);
    }

    fn line(&self, line: &str) {
        self.bar.suspend(|| say(line));
    }
}
