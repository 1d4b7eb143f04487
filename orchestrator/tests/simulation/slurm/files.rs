//! Directories of calculations on a file system that nodes and labellers share. What a node writes is seen by labellers
//! a little later.

use std::collections::{BTreeMap, BTreeSet};

use dft::{FailureClass, RetryAdjustment};
use workers::labeller::decisions::{CalculationEnd, JobDirectory, Traces};

use super::super::fault::Time;

/// Files from other hosts are visible after this time, unless the file system is in trouble.
pub const SETTLE_TIME: Time = 2_000;

/// The directory of a calculation.
#[derive(Default)]
pub struct CalculationFiles {
    pub job: i64,
    pub adjustments: BTreeSet<RetryAdjustment>,
    /// Nodes that its script excludes.
    pub excluded: BTreeSet<String>,
    pub is_removed: bool,
    /// When a job has begun, and when labellers see it.
    pub begun: Option<(Time, Time)>,
    /// The recorded end, when it was recorded, and when labellers see it.
    pub end: Option<(CalculationEnd, Time, Time)>,
    /// Slurm's log, with the time of its last entry.
    pub log: (String, Time),
    /// What the files of the program show: an energy, or a failure.
    pub shown: Option<Result<f64, FailureClass>>,
    /// What became of the calculation, for invariants: it is delivered so.
    pub truth: Option<Result<(), FailureClass>>,
    /// Its result may be lost: files were very late, or removed.
    pub is_damaged: bool,
    /// A job calculates now.
    pub is_running: bool,
}

/// The file system.
#[derive(Default)]
pub struct SharedFiles {
    pub now: Time,
    pub directories: BTreeMap<String, CalculationFiles>,
    /// What labellers noticed that must not be.
    pub broken: Option<String>,
}

impl SharedFiles {
    /// What a labeller sees.
    pub fn look(&self, name: &str) -> JobDirectory {
        match self.directories.get(name).filter(|found| !found.is_removed) {
            None => JobDirectory::Missing,
            Some(found) => JobDirectory::Own {
                begun: found.begun.is_some_and(|(_, seen)| seen <= self.now),
                end: found.end.as_ref().filter(|(.., seen)| *seen <= self.now).map(|(end, ..)| end.clone()),
            },
        }
    }

    pub fn traces(&self, name: &str) -> Traces {
        let found = &self.directories[name];
        let begun = found.begun.map_or(found.log.1, |(begun, _)| begun);
        Traces::new(found.log.0.clone(), found.log.1.saturating_sub(begun) as f64 / 1000.0)
    }

    /// An invariant is broken.
    fn fail(&mut self, what: String) {
        self.broken.get_or_insert(what);
    }

    /// A labeller has inferred an end and records it.
    pub fn record_inferred(&mut self, name: &str, end: CalculationEnd) {
        let now = self.now;
        let Some(found) = self.directories.get_mut(name) else { return };
        let is_running = found.is_running;
        let before = found.end.replace((end, now, now));
        if is_running {
            self.fail(format!("an end of calculation {name} is inferred while it runs"));
        }
        if before.is_some_and(|(_, recorded, seen)| seen <= recorded + SETTLE_TIME) {
            self.fail(format!("an end of calculation {name} is inferred, although it was recorded"));
        }
    }

    /// A labeller submits a job that it considers not begun.
    pub fn check_not_begun(&mut self, name: &str) {
        if matches!(self.look(name), JobDirectory::Own { begun: true, .. }) {
            self.fail(format!("calculation {name} has begun and is submitted again"));
        }
    }

    /// A labeller has read the result of a calculation.
    pub fn check_result(&mut self, name: &str, result: Result<(), FailureClass>) {
        let found = &self.directories[name];
        let is_lost = result == Err(FailureClass::NodeFailure) && found.is_damaged;
        if found.truth != Some(result) && !is_lost {
            let truth = found.truth;
            self.fail(format!("calculation {name} ended as {truth:?}, and is delivered as {result:?}"));
        }
    }

    /// Permits every node; whether that changes something.
    pub fn permit_all_nodes(&mut self, name: &str) -> bool {
        let found = self.directories.get_mut(name);
        found.is_some_and(|found| !std::mem::take(&mut found.excluded).is_empty())
    }

    pub fn remove(&mut self, name: &str) {
        if let Some(found) = self.directories.get_mut(name) {
            found.is_removed = true;
        }
    }
}
