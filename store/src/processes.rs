//! Processes of a campaign, as this process sees them.

use serde::Serialize;

use crate::database::{FromRow, SqlRow};
use crate::error::Result;
use crate::process_start::{self, process_start_time};

/// How long a process of this system may be silent (ms) and still keep its leases: the system may have been
/// suspended, or its clock adjusted. A process that hangs for longer loses its jobs.
const MAX_LOCAL_SILENCE: i64 = 24 * 3600 * 1000;
/// A process on another host counts as unresponsive after this silence (ms). Heartbeats are seconds apart.
const UNRESPONSIVE_AFTER: i64 = 60 * 1000;

/// A process that works for the campaign.
///
/// Columns that schema version 1 lacks are filled in when such a database is read, and `start_time` is read by the
/// name that it had before version 14.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ProcessRecord {
    /// Unique name, never reused and without `/`.
    pub id: String,
    /// [`Self::ORCHESTRATOR`], [`Self::WALKER`], [`Self::AGENT`], [`Self::LABELLER`] or [`Self::REFITTER`].
    pub kind: String,
    /// Index of the walker or labeller; `None` for an orchestrator.
    pub number: Option<u32>,
    /// Process id on its host.
    pub pid: u32,
    /// See [`process_start_time`]; empty if unknown.
    pub start_time: String,
    /// Host name, for display only.
    pub host: String,
    /// When it started, ms since 1970.
    pub started: i64,
    /// Last heartbeat, ms since 1970.
    pub last_seen: i64,
    /// Its state (`running`, `stopping`, `backing_off`, `failed` …), see [`crate::Store::status`].
    pub state: String,
    /// How often it was restarted in this run of the campaign.
    pub restarts: u32,
    /// Hash of the setup that a labeller was started with. A run does not adopt labellers with another setup.
    pub setup: Option<String>,
    /// A remark for the user: the last failure, rejected messages.
    pub remark: String,
    /// Time since its last heartbeat, ms by the clock of the database server. `None` for a database of one host.
    /// Not written.
    #[serde(skip)]
    pub silence: Option<i64>,
}

impl FromRow for ProcessRecord {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self {
            id: row.get("id")?,
            kind: row.get("kind")?,
            number: row.get_or_default("number")?,
            pid: row.get("pid")?,
            start_time: row.get_renamed("start_time", "birth")?,
            host: row.get("host")?,
            started: row.get("started")?,
            last_seen: row.get("last_seen")?,
            state: row.get("state")?,
            restarts: row.get_or_default("restarts")?,
            setup: row.get_or_default("setup")?,
            remark: row.get_or_default("remark")?,
            silence: row.get_or_default("silence")?,
        })
    }
}

impl ProcessRecord {
    /// The process that runs a campaign.
    pub const ORCHESTRATOR: &str = "orchestrator";
    /// A process that advances walks. It ends with its orchestrator, which also writes its record.
    pub const WALKER: &str = "walker";
    /// A process that starts walkers on another host. The orchestrator writes its record.
    pub const AGENT: &str = "agent";
    /// A process that makes labels. It outlives its orchestrator and writes its own record.
    pub const LABELLER: &str = "labeller";
    /// A process that trains a new version of the potential. It ends with its orchestrator, and writes its own record.
    pub const REFITTER: &str = "refitter";

    /// A record for the process `pid` in this process's PID namespace, `running` since `now`.
    pub fn new(kind: &str, number: Option<u32>, pid: u32, now: i64) -> Self {
        let host = this_host();
        Self {
            id: format!("{host}-{pid}-{now}"),
            kind: kind.to_owned(),
            number,
            pid,
            start_time: process_start_time(pid).unwrap_or_default(),
            host,
            started: now,
            last_seen: now,
            state: "running".to_owned(),
            ..Self::default()
        }
    }

    /// Whether its process id is valid here: both processes started since the last boot of this system and in the
    /// same container. Host names may change, so they decide only if there is no start time (schema version 1).
    pub fn is_local(&self) -> bool {
        process_start::is_local(&self.start_time).unwrap_or_else(|| self.host == this_host())
    }

    /// Whether the process has ended, as far as this host can tell. Without a start time, any process with the same
    /// id counts as this one. If several hosts share the database, a start time from another boot may belong to
    /// another host; then only a day of silence counts as the end.
    pub fn is_dead(&self) -> bool {
        match (self.is_local(), self.silence) {
            (true, _) => !process_start::is_running(self.pid, &self.start_time),
            (false, Some(silence)) => silence >= MAX_LOCAL_SILENCE,
            (false, None) => process_start::is_from_another_boot(&self.start_time),
        }
    }

    /// Whether it runs where this host cannot see it and has sent no heartbeat for a minute.
    pub fn is_unresponsive(&self) -> bool {
        !self.is_local() && self.silence.is_some_and(|silence| silence >= UNRESPONSIVE_AFTER)
    }

    /// Whether it may still work on something that it leased for `seconds` although the lease has expired, see
    /// [`crate::Store::lease`].
    pub(crate) fn may_be_working(&self, now: i64, seconds: u32) -> bool {
        let allowed = if self.is_local() { MAX_LOCAL_SILENCE } else { 1000 * i64::from(seconds) };
        let silence = self.silence.unwrap_or_else(|| now.saturating_sub(self.last_seen));
        !self.is_dead() && silence < allowed
    }

    /// Whether it runs the campaign and is neither dead nor unresponsive.
    pub fn is_leading(&self) -> bool {
        self.kind == Self::ORCHESTRATOR && !self.is_dead() && !self.is_unresponsive()
    }

    /// Whether it started after `other` with the same role on this host, and is alive.
    pub fn replaces(&self, other: &Self) -> bool {
        let place = |process: &Self| (process.kind.clone(), process.number, process.is_local());
        let age =
            |process: &Self| (process_start::ticks(&process.start_time), process.started, process.id.clone());
        let is_later = age(self) > age(other);
        self.number.is_some() && self.is_local() && place(self) == place(other) && is_later && !self.is_dead()
    }

    /// Whether `holder` names a lease of this process: `id` or `id/part`.
    pub fn is_holder(&self, holder: &str) -> bool {
        holder.split('/').next() == Some(&self.id)
    }
}

/// Name of this host.
pub fn this_host() -> String {
    rustix::system::uname().nodename().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn own(kind: &str) -> ProcessRecord {
        ProcessRecord::new(kind, Some(3), std::process::id(), 10)
    }

    /// The same process in another container of this system.
    fn elsewhere(record: &ProcessRecord) -> ProcessRecord {
        let (boot, ticks) =
            (record.start_time.split('/').next().unwrap(), record.start_time.rsplit('/').next().unwrap());
        ProcessRecord { start_time: format!("{boot}/1/{ticks}"), ..record.clone() }
    }

    #[test]
    fn processes_from_before_the_last_boot_are_dead() {
        let record = own(ProcessRecord::LABELLER);
        assert!(!record.is_dead());
        let elsewhere = ProcessRecord { pid: u32::MAX, ..elsewhere(&record) };
        assert!(!elsewhere.is_local() && !elsewhere.is_dead(), "unknown on another host");
        let renamed = ProcessRecord { host: "another name".into(), ..record.clone() };
        assert!(renamed.is_local() && !renamed.is_dead());
        assert!(ProcessRecord { pid: u32::MAX, ..renamed.clone() }.is_dead());
        assert!(ProcessRecord { start_time: "another-boot/1/1".into(), ..record.clone() }.is_dead());
        let version_1 =
            |record: &ProcessRecord| ProcessRecord { start_time: String::new(), ..record.clone() };
        assert!(version_1(&record).is_local() && !version_1(&record).is_dead());
        assert!(!version_1(&renamed).is_local());
        let reused = ProcessRecord { start_time: format!("{}0", record.start_time), ..record };
        assert!(reused.is_dead());
    }

    #[test]
    fn processes_on_another_host_are_dead_after_a_day_of_silence() {
        let record =
            ProcessRecord { start_time: "another-boot/1/1".into(), ..own(ProcessRecord::ORCHESTRATOR) };
        let silent_for = |silence| ProcessRecord { silence: Some(silence), ..record.clone() };
        assert!(record.is_dead(), "where there is one host");
        assert!(
            silent_for(UNRESPONSIVE_AFTER - 1).is_leading()
                && !silent_for(UNRESPONSIVE_AFTER - 1).is_unresponsive()
        );
        assert!(
            silent_for(UNRESPONSIVE_AFTER).is_unresponsive() && !silent_for(UNRESPONSIVE_AFTER).is_leading()
        );
        assert!(!silent_for(MAX_LOCAL_SILENCE - 1).is_dead() && silent_for(MAX_LOCAL_SILENCE).is_dead());
        let here = ProcessRecord { silence: Some(MAX_LOCAL_SILENCE), ..own(ProcessRecord::ORCHESTRATOR) };
        assert!(!here.is_dead() && !here.is_unresponsive() && here.is_leading(), "it can be seen to run");
    }

    #[test]
    fn a_process_replaces_an_earlier_one_of_its_number() {
        let first = own(ProcessRecord::LABELLER);
        let second = ProcessRecord { id: "later".into(), started: 11, ..first.clone() };
        assert!(second.replaces(&first) && !first.replaces(&second) && !first.replaces(&first));
        // The clock was set back in between.
        let (place, ticks) = first.start_time.rsplit_once('/').unwrap();
        let earlier = format!("{place}/{}", ticks.parse::<u64>().unwrap() - 1);
        let earlier = ProcessRecord { start_time: earlier, started: 3_600_000, ..first.clone() };
        assert!(!earlier.replaces(&first));
        let gone = ProcessRecord { pid: u32::MAX, ..second.clone() };
        assert!(!gone.replaces(&first), "the first one is needed again");
        assert!(!elsewhere(&second).replaces(&first) && !second.replaces(&elsewhere(&first)));
        assert!(!ProcessRecord { number: Some(4), ..second.clone() }.replaces(&first));
        assert!(!ProcessRecord { number: None, ..second.clone() }.replaces(&first));
        assert!(!ProcessRecord { kind: "walker".into(), ..second }.replaces(&first));
    }
}
