//! The Slurm cluster started by `.ci/slurm`.

use std::path::Path;
use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::processes::wait_until;
use super::stderr;

/// Only one campaign at a time: tests share the nodes, and some kill slurmctld.
static NODE: Mutex<()> = Mutex::new(());

/// Exclusive use of Slurm while the guard is held.
pub fn hold() -> MutexGuard<'static, ()> {
    assert!(std::env::var_os("SLURM_CONF").is_some(), "SLURM_CONF=$(.ci/slurm start) is needed");
    NODE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps Slurm at its limit of jobs until this is dropped.
pub struct FullQueue;

impl FullQueue {
    pub fn new() -> Self {
        ci("full");
        Self
    }

    /// Waits until slurmctld has refused this number of jobs since its last start.
    pub fn wait_for_refusals(&self, least: usize) {
        let configuration = std::env::var_os("SLURM_CONF").expect("that of the test cluster");
        let log = Path::new(&configuration).with_file_name("slurmctld.log");
        // At startup slurmctld logs a similar message about the jobs that it finds.
        const REFUSED: &str = "job_allocate: MaxJobCount limit from slurm.conf reached";
        wait_until("Slurm has refused enough", || {
            let text = std::fs::read_to_string(&log).unwrap();
            let since = text.rfind("slurmctld version").map_or(&*text, |start| &text[start..]);
            since.matches(REFUSED).count() >= least
        });
    }
}

impl Drop for FullQueue {
    fn drop(&mut self) {
        ci("room");
    }
}

/// Output of a Slurm command, which must succeed.
pub fn slurm(arguments: &[&str]) -> String {
    let output = Command::new(arguments[0]).args(&arguments[1..]).output().expect("Slurm's commands");
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    String::from_utf8(output.stdout).expect("text")
}

/// Runs `.ci/slurm`, which started the test cluster.
pub fn ci(order: &str) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join(".ci/slurm");
    assert!(Command::new(script).arg(order).status().expect("it starts").success(), "{order}");
}
