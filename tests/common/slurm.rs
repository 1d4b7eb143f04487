//! The Slurm that `.ci/slurm` has started.

use std::path::Path;
use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::stderr;

/// One campaign at a time: they share the nodes, and some tests kill slurmctld.
static NODE: Mutex<()> = Mutex::new(());

/// Slurm, for as long as this is held.
pub fn hold() -> MutexGuard<'static, ()> {
    assert!(std::env::var_os("SLURM_CONF").is_some(), "SLURM_CONF=$(.ci/slurm start) is needed");
    NODE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What one of Slurm's commands writes, which must succeed.
pub fn slurm(arguments: &[&str]) -> String {
    let output = Command::new(arguments[0]).args(&arguments[1..]).output().expect("Slurm's commands");
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    String::from_utf8(output.stdout).expect("text")
}

/// `.ci/slurm`, which started what is tested on.
pub fn ci(order: &str) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join(".ci/slurm");
    assert!(Command::new(script).arg(order).status().expect("it starts").success(), "{order}");
}
