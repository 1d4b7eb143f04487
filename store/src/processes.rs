//! Processes of a campaign, as far as this host can see them.

use rustix::process::Pid;
use serde::Serialize;

/// A process that works for the campaign.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, sqlx::FromRow)]
pub struct ProcessRecord {
    /// Its own name, never used twice (a UUID).
    pub id: String,
    /// `orchestrator`, `labeller` …
    pub kind: String,
    /// Process number on its host.
    pub pid: u32,
    /// Name of its host, for people.
    pub host: String,
    /// When it started, ms since 1970.
    pub started: i64,
    /// When it was last heard of, ms since 1970.
    pub last_seen: i64,
    /// What it says of itself (`running`, `stopping` …); read back as `gone` if it is of this host and no more.
    pub state: String,
}

impl ProcessRecord {
    /// Whether it ran on this host and does so no longer. A process number that was given to another process
    /// since is taken for the old one.
    pub fn is_gone(&self) -> bool {
        self.host == this_host() && !is_alive(self.pid)
    }
}

/// Name of this host.
pub fn this_host() -> String {
    rustix::system::uname().nodename().to_string_lossy().into_owned()
}

fn is_alive(pid: u32) -> bool {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    // A process of another user answers EPERM: it is there.
    pid.is_some_and(|pid| rustix::process::test_kill_process(pid) != Err(rustix::io::Errno::SRCH))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn living_and_dead_processes_are_told_apart() {
        assert!(is_alive(std::process::id()));
        assert!(!is_alive(0) && !is_alive(u32::MAX));
        let mut child = std::process::Command::new("true").spawn().unwrap();
        child.wait().unwrap();
        assert!(!is_alive(child.id()));
    }
}
