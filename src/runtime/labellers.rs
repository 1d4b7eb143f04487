//! The labeller processes of a campaign. They outlive the orchestrator and communicate with it through the database
//! only.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use orchestrator::launcher::Children;
use orchestrator::supervisor::ChildExit;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};

/// The labeller processes.
pub struct Labellers {
    /// Their child processes.
    pub children: Children,
    /// Current pid of each labeller number. An earlier process of the same number may still be making its last label.
    pids: BTreeMap<u32, u32>,
    /// The last heartbeat of each labeller, and since when it sends them. The labeller's clock may be adjusted, so a
    /// heartbeat only counts as different from the one before.
    seen: BTreeMap<u32, (i64, Instant)>,
    /// Attempts before a label counts as failed.
    attempts: u32,
}

impl Labellers {
    /// Manages `children`, of which those in `adopted` (number and pid) run already.
    pub fn new(children: Children, adopted: BTreeMap<u32, u32>, attempts: u32) -> Self {
        Self { children, pids: adopted, seen: BTreeMap::new(), attempts }
    }

    /// Records the start of a process.
    pub fn started(&mut self, number: u32, pid: u32) {
        self.pids.insert(number, pid);
        self.seen.remove(&number);
    }

    /// Releases the leases of a process that ended. Returns its record, if it has one.
    pub async fn ended(
        &mut self,
        store: &Store,
        number: u32,
        ended: &ChildExit,
    ) -> Result<Option<ProcessRecord>, StoreError> {
        let pid = self.pids.remove(&number);
        let labellers = store.processes(Some(ProcessRecord::LABELLER)).await?;
        let record = labellers.into_iter().rfind(|record| is_process(record, pid));
        let now = unix_milliseconds();
        if let Some(record) = record.as_ref().filter(|_| ended.reason.is_crash()) {
            // Count the attempt as failed: a structure that kills labellers must not do so for ever.
            let log = ended.reason.to_string();
            store.fail_leases_of(&record.id, "crashed", &log, self.attempts, now).await?;
        }
        store.release_leases_of_dead_processes(now).await?;
        Ok(record)
    }

    /// Reads their heartbeats. A labeller that has sent them for longer than `proven` counts as working.
    pub async fn read_heartbeats(&mut self, store: &Store, proven: Duration) -> Result<(), StoreError> {
        let heartbeats = self.children.heartbeats();
        let records = store.processes(Some(ProcessRecord::LABELLER)).await?;
        for (&number, &pid) in &self.pids {
            let Some(record) = records.iter().rfind(|record| is_process(record, Some(pid))) else {
                continue;
            };
            let before = self.seen.get(&number).copied();
            if before.is_some_and(|(last, _)| last == record.last_seen) {
                continue;
            }
            let since = before.map_or_else(Instant::now, |(_, since)| since);
            self.seen.insert(number, (record.last_seen, since));
            if since.elapsed() > proven {
                heartbeats.delivered(number);
            } else {
                heartbeats.heartbeat(number);
            }
        }
        Ok(())
    }

    /// Treats all labellers as alive while their heartbeats cannot be read.
    pub fn assume_all_alive(&self) {
        let heartbeats = self.children.heartbeats();
        self.pids.keys().for_each(|number| heartbeats.heartbeat(*number));
    }
}

/// Pids are reused: among records with the same pid, the last one belongs to the current process.
fn is_process(record: &ProcessRecord, pid: Option<u32>) -> bool {
    Some(record.pid) == pid && record.is_local()
}
