//! Records the processes of a campaign in the database: in `status` and in the operations log.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use orchestrator::supervisor::{ChildExit, ChildState};
use serde_json::json;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use wire::ipc::Traffic;

use crate::output::log_and_warn;

/// The records of this process and its children. A running labeller keeps its own.
pub struct ProcessRecords<'a> {
    store: &'a Store,
    /// The record of this process.
    process: ProcessRecord,
    /// The records of the walkers, as `status` shows them.
    walkers: BTreeMap<u32, ProcessRecord>,
    /// When the last message of each walker arrived, ms since 1970.
    heard: Arc<[AtomicI64]>,
    /// Number of rejected messages reported so far.
    rejected: u64,
}

impl<'a> ProcessRecords<'a> {
    /// The records of the orchestrator `process` and of `walkers` walkers.
    pub fn new(store: &'a Store, process: ProcessRecord, walkers: usize) -> Self {
        let heard = (0..walkers).map(|_| AtomicI64::default()).collect();
        Self { store, process, walkers: BTreeMap::new(), heard, rejected: 0 }
    }

    /// A callback for the number of a walker that sent a message.
    pub fn listener(&self) -> impl Fn(u32) + Send + 'static {
        let heard = Arc::clone(&self.heard);
        move |walker| {
            if let Some(heard) = heard.get(walker as usize) {
                heard.store(unix_milliseconds(), Ordering::Relaxed);
            }
        }
    }

    /// Records the start of a walker process.
    pub async fn walker_started(
        &mut self,
        number: u32,
        incarnation: u32,
        pid: u32,
    ) -> Result<(), StoreError> {
        let restarts = incarnation.saturating_sub(1);
        let record = ProcessRecord { restarts, ..new_record(ProcessRecord::WALKER, number, pid) };
        self.walkers.insert(number, record.clone());
        self.store.upsert_process(&record).await
    }

    /// Records the end of a walker process.
    pub async fn walker_ended(&mut self, number: u32, ended: &ChildExit) -> Result<(), StoreError> {
        let record = self.walkers.remove(&number);
        // A process that could not be started has no record.
        let record = record.unwrap_or_else(|| new_record(ProcessRecord::WALKER, number, 0));
        if ended.then != ChildState::Exited {
            self.walkers.insert(number, with_end(record.clone(), ended));
        }
        log_end(ProcessRecord::WALKER, number, ended);
        write_end(self.store, record, ended).await
    }

    /// Records the end of a labeller process, which left `record` if it had one.
    pub async fn labeller_ended(
        &self,
        number: u32,
        record: Option<ProcessRecord>,
        ended: &ChildExit,
    ) -> Result<(), StoreError> {
        let record = record.unwrap_or_else(|| new_record(ProcessRecord::LABELLER, number, 0));
        log_end(ProcessRecord::LABELLER, number, ended);
        write_end(self.store, record, ended).await
    }

    /// Writes the heartbeats of this process and its walkers, and reports rejected messages.
    pub async fn write_heartbeats(&mut self, traffic: Traffic) -> Result<(), StoreError> {
        let now = unix_milliseconds();
        self.process.last_seen = now;
        for (number, record) in &mut self.walkers {
            let heard = self.heard.get(*number as usize).map_or(0, |heard| heard.load(Ordering::Relaxed));
            record.last_seen = record.last_seen.max(heard);
        }
        let rejected = (traffic.rejected > self.rejected).then(|| {
            let last = traffic.last_rejected.unwrap_or_default();
            format!("{} messages rejected; the last: {last}", traffic.rejected)
        });
        if let Some(rejected) = &rejected {
            self.process.remark.clone_from(rejected);
        }
        let records: Vec<_> = self.walkers.values().chain([&self.process]).cloned().collect();
        self.store.upsert_processes(&records).await?;
        if let Some(rejected) = rejected {
            log_and_warn(&rejected);
            let detail = json!({ "rejected": traffic.rejected, "remark": rejected });
            self.store.log_operation(now, "messages_rejected", &detail).await?;
            self.rejected = traffic.rejected;
        }
        Ok(())
    }
}

/// Records how a process ended.
pub async fn write_end(store: &Store, record: ProcessRecord, ended: &ChildExit) -> Result<(), StoreError> {
    if ended.then == ChildState::Exited {
        return store.remove_process(&record.id).await;
    }
    let record = with_end(record, ended);
    store.upsert_process(&record).await?;
    let detail = json!({
        "kind": record.kind, "number": record.number, "incarnation": ended.incarnation,
        "how": ended.reason.to_string(), "then": ended.then.to_string(),
    });
    store.log_operation(unix_milliseconds(), "process_ended", &detail).await
}

fn log_end(kind: &str, number: u32, ended: &ChildExit) {
    if ended.then != ChildState::Exited {
        log_and_warn(format_args!("{kind} {number}: {}; {}", ended.reason, ended.then));
    }
}

fn new_record(kind: &str, number: u32, pid: u32) -> ProcessRecord {
    ProcessRecord::new(kind, Some(number), pid, unix_milliseconds())
}

/// The record of a process with its end.
fn with_end(mut record: ProcessRecord, ended: &ChildExit) -> ProcessRecord {
    record.state = match ended.then {
        ChildState::BackingOff { .. } => "backing_off".to_owned(),
        then => then.to_string(),
    };
    record.remark = ended.reason.to_string();
    record
}
