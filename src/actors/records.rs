//! What is said of the processes of a campaign: in `status`, in the operations log.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use orchestrator::supervisor::{ChildExit, ChildState};
use serde_json::json;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use wire::ipc::Traffic;

use crate::output::warn;

/// The records of a crew. Labellers keep their own while they live.
pub struct Records<'a> {
    store: &'a Store,
    /// Of this process.
    process: ProcessRecord,
    /// Of walkers, as `status` shows them.
    walkers: BTreeMap<u32, ProcessRecord>,
    /// When each walker was last heard, ms since 1970.
    heard: Arc<[AtomicI64]>,
    /// Messages dropped that were spoken of.
    dropped: u64,
}

impl<'a> Records<'a> {
    /// Those of the orchestrator `process` and of its walkers, of which there are so many.
    pub fn new(store: &'a Store, process: ProcessRecord, walkers: usize) -> Self {
        let heard = (0..walkers).map(|_| AtomicI64::default()).collect();
        Self { store, process, walkers: BTreeMap::new(), heard, dropped: 0 }
    }

    /// To be told which walker was heard.
    pub fn listener(&self) -> impl Fn(u32) + Send + 'static {
        let heard = Arc::clone(&self.heard);
        move |walker| {
            if let Some(heard) = heard.get(walker as usize) {
                heard.store(unix_milliseconds(), Ordering::Relaxed);
            }
        }
    }

    /// A walker's process was started.
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

    /// A walker's process ended.
    pub async fn walker_ended(&mut self, number: u32, ended: &ChildExit) -> Result<(), StoreError> {
        let record = self.walkers.remove(&number);
        // One that could not even be started has none.
        let record = record.unwrap_or_else(|| new_record(ProcessRecord::WALKER, number, 0));
        if ended.then != ChildState::Exited {
            self.walkers.insert(number, judged(record.clone(), ended));
        }
        tell(ProcessRecord::WALKER, number, ended);
        write_down(self.store, record, ended).await
    }

    /// A labeller's process ended, and left this record if it had one.
    pub async fn labeller_ended(
        &self,
        number: u32,
        record: Option<ProcessRecord>,
        ended: &ChildExit,
    ) -> Result<(), StoreError> {
        let record = record.unwrap_or_else(|| new_record(ProcessRecord::LABELLER, number, 0));
        tell(ProcessRecord::LABELLER, number, ended);
        write_down(self.store, record, ended).await
    }

    /// Gives the signs of life of this process and of its walkers, and says which messages were dropped.
    pub async fn look(&mut self, traffic: Traffic) -> Result<(), StoreError> {
        let now = unix_milliseconds();
        self.process.last_seen = now;
        for (number, record) in &mut self.walkers {
            let heard = self.heard.get(*number as usize).map_or(0, |heard| heard.load(Ordering::Relaxed));
            record.last_seen = record.last_seen.max(heard);
        }
        let strangers = (traffic.rejected > self.dropped).then(|| {
            let last = traffic.last_rejected.unwrap_or_default();
            format!("{} messages dropped; the last: {last}", traffic.rejected)
        });
        if let Some(strangers) = &strangers {
            self.process.remark.clone_from(strangers);
        }
        let records: Vec<_> = self.walkers.values().chain([&self.process]).cloned().collect();
        self.store.upsert_processes(&records).await?;
        if let Some(strangers) = strangers {
            warn(&strangers);
            let detail = json!({ "dropped": traffic.rejected, "remark": strangers });
            self.store.log_operation(now, "messages_dropped", &detail).await?;
            self.dropped = traffic.rejected;
        }
        Ok(())
    }
}

/// Writes down how a process ended that has this record.
pub async fn write_down(store: &Store, record: ProcessRecord, ended: &ChildExit) -> Result<(), StoreError> {
    if ended.then == ChildState::Exited {
        return store.remove_process(&record.id).await;
    }
    let record = judged(record, ended);
    store.upsert_process(&record).await?;
    let detail = json!({
        "kind": record.kind, "number": record.number, "incarnation": ended.incarnation,
        "how": ended.reason.to_string(), "then": ended.then.to_string(),
    });
    store.log_operation(unix_milliseconds(), "process_ended", &detail).await
}

fn tell(kind: &str, number: u32, ended: &ChildExit) {
    if ended.then != ChildState::Exited {
        warn(format_args!("{kind} {number}: {}; {}", ended.reason, ended.then));
    }
}

fn new_record(kind: &str, number: u32, pid: u32) -> ProcessRecord {
    ProcessRecord::new(kind, Some(number), pid, unix_milliseconds())
}

/// The record of a process that ended.
fn judged(mut record: ProcessRecord, ended: &ChildExit) -> ProcessRecord {
    record.state = match ended.then {
        ChildState::BackingOff { .. } => "pausing".to_owned(),
        then => then.to_string(),
    };
    record.remark = ended.reason.to_string();
    record
}
