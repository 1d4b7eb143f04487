//! The PostgreSQL server, and campaigns stored on it.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::common::Running;
use crate::common::campaign::{Counters, Outcome, Small, outcome_at};
use crate::common::hosts::Hosts;
use crate::common::processes::{assert_no_leftovers, wait_until};

/// Controls the server: `restart` in order, `crash` and restart, `halt`, `resume`.
pub fn control(action: &str) {
    let command = std::env::var("CALMWALK_POSTGRES_CONTROL")
        .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/.ci/postgres").into());
    let done = Command::new("sh").args(["-c", &format!("{command} {action}")]).status().unwrap();
    assert!(done.success(), "{command} {action}");
}

/// A server that is down, until this is dropped: the tests after one that fails need it.
pub struct Halted(());

impl Halted {
    pub fn now() -> Self {
        control("halt");
        Self(())
    }
}

impl Drop for Halted {
    fn drop(&mut self) {
        control("resume");
    }
}

/// URL of a schema that no other test uses.
pub fn location(name: &str) -> String {
    let server = std::env::var("CALMWALK_POSTGRES")
        .expect("CALMWALK_POSTGRES must be the URL of a PostgreSQL server; '.ci/postgres start' makes one");
    format!("{server}?schema=faults_{name}_{}_{}", std::process::id(), store::unix_milliseconds())
}

/// A campaign stored on the server, with `others` hosts besides the orchestrator's.
pub struct Campaign {
    pub hosts: Hosts,
    pub location: String,
}

impl Campaign {
    /// Adds keys to the section `[run]`.
    pub fn new(small: &Small, name: &str, others: usize, keys: &str) -> Self {
        let location = location(name);
        let keys = format!("store = \"{location}\"\n{keys}");
        Self { hosts: Hosts::new(small, others, &keys), location }
    }

    pub fn home(&self) -> &Path {
        self.hosts.home.path()
    }

    pub fn counters(&self) -> Counters {
        Counters::read(&self.location, self.home())
    }

    /// Waits until a condition holds while the orchestrator runs.
    pub fn wait_until(&self, orchestrator: &mut Running, what: &str, mut is_so: impl FnMut() -> bool) {
        wait_until(what, || {
            let is_so = is_so();
            let ended = if is_so { None } else { orchestrator.0.try_wait().unwrap() };
            assert!(ended.is_none(), "{ended:?} before {what}: {}", self.hosts.orchestrator_stderr());
            is_so
        });
    }

    /// Checks that nothing is lost or duplicated, and that all processes have exited.
    pub fn outcome(&self) -> Outcome {
        let outcome = outcome_at(&self.location, self.home());
        fs::remove_file(self.home().join("dataset.extxyz")).expect("the exported data set");
        assert_no_leftovers(self.home());
        outcome
    }
}
