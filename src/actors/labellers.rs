//! The labellers of a campaign: processes that outlive their orchestrator and speak to it through the database only.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use orchestrator::launcher::Children;
use orchestrator::supervisor::ChildExit;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};

/// Labellers at work.
pub struct Labellers {
    /// Their processes.
    pub children: Children,
    /// The process of each number: others of that number may still be making their last label.
    pids: BTreeMap<u32, u32>,
    /// The last sign of life of each, and since when it gives them. Its clock may be put right, so it says nothing but that
    /// there is another.
    seen: BTreeMap<u32, (i64, Instant)>,
    /// Attempts before a label counts as failed.
    attempts: u32,
}

impl Labellers {
    /// Labellers, of which those in `adopted` (number and process number) are at work.
    pub fn new(children: Children, adopted: BTreeMap<u32, u32>, attempts: u32) -> Self {
        Self { children, pids: adopted, seen: BTreeMap::new(), attempts }
    }

    /// A process was started.
    pub fn started(&mut self, number: u32, pid: u32) {
        self.pids.insert(number, pid);
        self.seen.remove(&number);
    }

    /// A process ended: what it had leased comes back. Returns its record, if it has one.
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
            // A structure that kills labellers must not do so for ever.
            let log = ended.reason.to_string();
            store.fail_leases_of(&record.id, "crashed", &log, self.attempts, now).await?;
        }
        store.release_leases_of_gone_processes(now).await?;
        Ok(record)
    }

    /// Takes in their signs of life. Those that have given them for longer than `proven` have shown that they are of use.
    pub async fn look(&mut self, store: &Store, proven: Duration) -> Result<(), StoreError> {
        let signs = self.children.heartbeats();
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
                signs.delivered(number);
            } else {
                signs.heartbeat(number);
            }
        }
        Ok(())
    }

    /// Takes all of them for alive: their signs of life cannot be read.
    pub fn all_are_heard(&self) {
        let signs = self.children.heartbeats();
        self.pids.keys().for_each(|number| signs.heartbeat(*number));
    }
}

/// Of several records with one process number the last is that of the process that had it last.
fn is_process(record: &ProcessRecord, pid: Option<u32>) -> bool {
    Some(record.pid) == pid && record.is_local()
}
