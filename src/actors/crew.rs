//! The processes of a campaign, and what is said of them: to those who watch, in `status`, in the operations log.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use orchestrator::launcher::{self, Children};
use orchestrator::supervisor::{Ended, Standing};
use serde_json::json;
use store::{ProcessRecord, Store, unix_milliseconds};
use tokio::time::{Interval, MissedTickBehavior, interval};
use wire::ipc::Handle;

use crate::outcome::Failure;
use crate::output::say;

/// Between two signs of life in the database.
const SIGN_OF_LIFE: Duration = Duration::from_secs(5);
/// Between two looks whether labels are still to be made, once no more structures will come.
const LAST_LABELS: Duration = Duration::from_millis(100);
/// A labeller that has lived for so long is of use: what it was started with is in order.
const PROVEN: i64 = 10_000;

/// Walkers and labellers at work.
pub struct Crew<'a> {
    store: &'a Store,
    /// The record of this process.
    process: ProcessRecord,
    line: Handle,
    walkers: Children,
    labellers: Children,
    /// Walkers, as `status` shows them.
    records: BTreeMap<u32, ProcessRecord>,
    /// When each walker was last heard, ms since 1970.
    heard: Arc<[AtomicI64]>,
    /// When each labeller last gave a sign of life, ms since 1970.
    seen: BTreeMap<u32, i64>,
    look: Interval,
    last_labels: Option<Interval>,
    gone: [bool; 2],
    stopping: bool,
    failure: Option<String>,
}

/// What there is to react to.
pub enum Event {
    /// A walker.
    Walker(launcher::Event),
    /// A labeller.
    Labeller(launcher::Event),
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
        line: Handle,
        mut walkers: Children,
        labellers: Children,
    ) -> Self {
        let mut look = interval(SIGN_OF_LIFE);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let heard = walkers.status().iter().map(|_| AtomicI64::default()).collect();
        Self {
            store,
            process,
            line,
            walkers,
            labellers,
            records: BTreeMap::new(),
            heard,
            seen: BTreeMap::new(),
            look,
            last_labels: None,
            gone: [false; 2],
            stopping: false,
            failure: None,
        }
    }

    /// To be told which walker was heard, and whether it delivered something.
    pub fn listener(&self) -> impl FnMut(u32, bool) + Send + 'static {
        let (signs, heard) = (self.walkers.signs(), Arc::clone(&self.heard));
        move |walker, useful| {
            if let Some(heard) = heard.get(walker as usize) {
                heard.store(unix_milliseconds(), Ordering::Relaxed);
            }
            if useful { signs.useful(walker) } else { signs.heard(walker) }
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
            event = self.labellers.next() => Event::Labeller(event),
            _ = self.look.tick() => Event::Look,
            _ = last_labels => Event::LastLabels,
        }
    }

    /// Does what is to be done about it.
    pub async fn take_in(&mut self, event: Event) -> Result<(), Failure> {
        match event {
            Event::Walker(event) => self.walker(event).await,
            Event::Labeller(event) => self.labeller(event).await,
            Event::Look => self.look().await,
            Event::LastLabels => {
                if self.store.unfinished_jobs().await? == 0 {
                    self.last_labels = None;
                    self.labellers.stop();
                }
                Ok(())
            }
        }
    }

    /// Asks everybody to end in order.
    pub fn stop(&mut self) {
        self.stopping = true;
        self.walkers.stop();
        self.labellers.stop();
    }

    /// No more structures will come: the labellers end when those that are there have their labels.
    pub fn wait_for_labels(&mut self) {
        if !self.stopping {
            self.last_labels = Some(interval(LAST_LABELS));
        }
    }

    /// Whether nobody is left.
    pub fn is_gone(&self) -> bool {
        self.gone == [true; 2]
    }

    /// Why the campaign cannot go on, if it cannot.
    pub fn failure(&self) -> Result<(), Failure> {
        self.failure.clone().map_or(Ok(()), |failure| Err(Failure::Failed(failure)))
    }

    async fn walker(&mut self, event: launcher::Event) -> Result<(), Failure> {
        match event {
            launcher::Event::Started { number, incarnation, pid } => {
                let now = unix_milliseconds();
                let restarts = incarnation.saturating_sub(1);
                let record = ProcessRecord::new(ProcessRecord::WALKER, Some(number), pid, now);
                let record = ProcessRecord { restarts, ..record };
                self.store.upsert_process(&record).await?;
                self.records.insert(number, record);
            }
            launcher::Event::Said { number, line } => say(format_args!("walker {number}: {line}")),
            launcher::Event::Ended { number, ended } => {
                let fault = ended.ending.is_own_fault().then(|| ended.ending.to_string());
                self.line.gone(number, ended.incarnation, fault);
                if let Some(record) = self.records.remove(&number) {
                    let record = self.ended(record, &ended).await?;
                    self.records.extend(record.map(|record| (number, record)));
                }
            }
            launcher::Event::AllGone => {
                self.gone[0] = true;
                self.line.close();
                let given_up = all_given_up(&mut self.walkers);
                self.failed("walker", given_up);
            }
        }
        Ok(())
    }

    async fn labeller(&mut self, event: launcher::Event) -> Result<(), Failure> {
        match event {
            launcher::Event::Started { .. } => {}
            launcher::Event::Said { number, line } => say(format_args!("labeller {number}: {line}")),
            launcher::Event::Ended { number, ended } => {
                let labellers = self.store.processes(Some(ProcessRecord::LABELLER)).await?;
                // One that could not even be started has no record yet.
                let record = labellers.into_iter().rfind(|record| record.number == Some(number));
                let now = unix_milliseconds();
                let record = record
                    .unwrap_or_else(|| ProcessRecord::new(ProcessRecord::LABELLER, Some(number), 0, now));
                self.ended(record, &ended).await?;
                self.store.release_leases_of_gone_processes(now).await?;
            }
            launcher::Event::AllGone => {
                self.gone[1] = true;
                let given_up = all_given_up(&mut self.labellers);
                self.failed("labeller", given_up);
            }
        }
        Ok(())
    }

    /// Writes down how a process ended; its record, if it is to be kept.
    async fn ended(
        &mut self,
        mut record: ProcessRecord,
        ended: &Ended,
    ) -> Result<Option<ProcessRecord>, Failure> {
        if matches!(ended.then, Standing::GoneHome) {
            self.store.remove_process(&record.id).await?;
            return Ok(None);
        }
        let (now, kind, number) = (unix_milliseconds(), record.kind.clone(), record.number);
        let shown = number.map_or_else(|| kind.clone(), |number| format!("{kind} {number}"));
        say(format_args!("{shown}: {}; {}", ended.ending, ended.then));
        let detail = json!({
            "kind": kind, "number": number, "incarnation": ended.incarnation, "how": ended.ending.to_string(),
            "then": ended.then.to_string(),
        });
        self.store.log_operation(now, "process_ended", &detail).await?;
        record.state = match ended.then {
            Standing::Pausing { .. } => "pausing".to_owned(),
            then => then.to_string(),
        };
        record.remark = ended.ending.to_string();
        self.store.upsert_process(&record).await?;
        Ok(Some(record))
    }

    /// Signs of life: this process and its walkers give them in the database, labellers by themselves.
    async fn look(&mut self) -> Result<(), Failure> {
        let now = unix_milliseconds();
        self.process.last_seen = now;
        let traffic = self.line.traffic();
        if traffic.dropped > 0 {
            self.process.remark = format!(
                "{} messages dropped; the last: {}",
                traffic.dropped,
                traffic.last_dropped.unwrap_or_default()
            );
        }
        for (number, record) in &mut self.records {
            let heard = self.heard.get(*number as usize).map_or(0, |heard| heard.load(Ordering::Relaxed));
            record.last_seen = record.last_seen.max(heard);
        }
        let records: Vec<_> = self.records.values().chain([&self.process]).cloned().collect();
        self.store.upsert_processes(&records).await?;
        let signs = self.labellers.signs();
        for labeller in self.store.processes(Some(ProcessRecord::LABELLER)).await? {
            let Some(number) = labeller.number.filter(|_| labeller.state == "running") else { continue };
            if self.seen.insert(number, labeller.last_seen) == Some(labeller.last_seen) {
                continue;
            }
            if labeller.last_seen - labeller.started > PROVEN {
                signs.useful(number);
            } else {
                signs.heard(number);
            }
        }
        Ok(())
    }

    /// Nobody of a kind is left to do the work.
    fn failed(&mut self, kind: &str, given_up: Option<String>) {
        if let Some(given_up) = given_up.filter(|_| !self.stopping) {
            self.failure = Some(format!("no {kind} is left: {given_up}"));
            self.stop();
        }
    }
}

/// How the last of them failed, if all were given up.
fn all_given_up(children: &mut Children) -> Option<String> {
    let status = children.status();
    let given_up = status.iter().all(|child| child.standing == Standing::GivenUp);
    let last = status.last().filter(|_| given_up)?;
    let how = last.last_failure.as_ref().map(ToString::to_string).unwrap_or_default();
    Some(format!("each was given up after {} restarts, number {} with {how}", last.restarts, last.number))
}
