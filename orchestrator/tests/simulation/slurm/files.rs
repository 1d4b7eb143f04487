//! Directories of calculations on a file system that nodes and labellers share. What a node writes is seen by labellers
//! a little later.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use batch::JobId;
use dft::{FailureClass, RetryAdjustment};
use workers::labeller::decisions::{
    CalculationEnd, CustomDirectory, JobDirectory, JobSubmission, MAX_NUMBER, MAX_SUBMISSIONS, Traces,
};

use super::super::fault::Time;
use super::super::planted::PlantedBug;

/// Files from other hosts are visible after this time, unless the file system is in trouble.
pub const SETTLE_TIME: Time = 2_000;

/// The directory of a calculation.
#[derive(Default)]
pub struct CalculationFiles {
    pub job: i64,
    pub made: Time,
    pub adjustments: BTreeSet<RetryAdjustment>,
    /// Nodes that its script excludes.
    pub excluded: BTreeSet<String>,
    pub is_removed: bool,
    /// A labeller has begun to remove it under its own name: begin and end are no longer there, what a job needs is.
    pub is_torn: bool,
    /// When a job has begun, and when labellers see it.
    pub begun: Option<(Time, Time)>,
    /// The number of the submission that calculates, of another batch system than Slurm.
    pub begun_by: u32,
    /// Submissions to it, with the ids of their jobs, as far as they are known, and the time.
    pub submissions: BTreeMap<u32, (Option<JobId>, Time)>,
    /// Numbers of submissions that were refused.
    pub refused: BTreeSet<u32>,
    /// No job may calculate any more.
    pub is_closed: bool,
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
    /// The store has its result.
    pub is_delivered: bool,
    /// Its job is over, when a labeller cleaned up.
    pub is_unwanted: bool,
}

impl CalculationFiles {
    /// The number of a further submission, if there may be one.
    fn free_number(&self, bug: Option<PlantedBug>) -> Option<u32> {
        let forgets = bug == Some(PlantedBug::RefusalForgotten);
        let is_used =
            |number: &u32| self.submissions.contains_key(number) || !forgets && self.refused.contains(number);
        (1..=MAX_NUMBER).find(|number| !is_used(number)).filter(|_| self.submissions.len() < MAX_SUBMISSIONS)
    }
}

/// Why a directory is removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DirectoryRemoval {
    /// The store has the result.
    Delivered,
    /// The result is not needed.
    NotNeeded,
    /// Nothing can be waited for there, or a newer calculation is.
    Lost { has_newer: bool },
    /// A killed labeller left it.
    LeftOver,
    /// It was calculated by another program.
    OtherProgram,
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
                begun: !found.is_torn && found.begun.is_some_and(|(_, seen)| seen <= self.now),
                can_begin: true,
                end: self.seen_end(name),
            },
        }
    }

    /// What a labeller sees of a job of another batch system than Slurm.
    pub fn look_custom(&self, name: &str, bug: Option<PlantedBug>) -> CustomDirectory {
        let found = match self.directories.get(name).filter(|found| !found.is_removed) {
            None => return CustomDirectory::Missing,
            Some(found) => found,
        };
        if let Some(end) = self.seen_end(name) {
            return CustomDirectory::Ended(end);
        }
        let age = |time: Time| Duration::from_millis(self.now.saturating_sub(time));
        let begun = found.begun.filter(|(_, seen)| *seen <= self.now && !found.is_torn);
        let submissions = found
            .submissions
            .iter()
            .filter(|_| !found.is_torn)
            .map(|(number, (id, time))| JobSubmission { number: *number, id: id.clone(), age: age(*time) });
        CustomDirectory::Open {
            begun: begun.map(|(time, _)| (found.begun_by, age(time))),
            submissions: submissions.collect(),
            may_be_submitted: found.is_torn || found.free_number(bug).is_some(),
        }
    }

    /// Keeps every job from calculating; `false` if one has begun.
    pub fn close(&mut self, name: &str) -> bool {
        let found = self.directories.get_mut(name).filter(|found| !found.is_removed);
        found.is_none_or(|found| {
            found.is_closed = found.begun.is_none();
            found.is_closed
        })
    }

    pub fn is_closed(&self, name: &str) -> bool {
        self.directories.get(name).is_some_and(|found| found.is_closed && !found.is_removed)
    }

    /// The recorded end, if labellers see it.
    pub fn seen_end(&self, name: &str) -> Option<CalculationEnd> {
        let found = self.directories.get(name).filter(|found| !found.is_removed && !found.is_torn)?;
        found.end.as_ref().filter(|(.., seen)| *seen <= self.now).map(|(end, ..)| end.clone())
    }

    /// Notes a submission before it is made; `None` if there were too many, or there is no directory.
    pub fn begin_submission(&mut self, name: &str, bug: Option<PlantedBug>) -> Option<u32> {
        let found = self.directories.get_mut(name).filter(|found| !found.is_removed)?;
        let number = found.free_number(bug)?;
        found.submissions.insert(number, (None, self.now));
        Some(number)
    }

    pub fn end_submission(&mut self, name: &str, number: u32, id: JobId) {
        if let Some((noted, _)) =
            self.directories.get_mut(name).and_then(|found| found.submissions.get_mut(&number))
        {
            *noted = Some(id);
        }
    }

    pub fn forget_submission(&mut self, name: &str, number: u32) {
        if let Some(found) = self.directories.get_mut(name) {
            found.refused.insert(number);
            found.submissions.remove(&number);
        }
    }

    /// The ids of the jobs of a calculation, as far as they are known.
    pub fn submitted_ids(&self, name: &str) -> Vec<JobId> {
        let submissions = self.directories.get(name).into_iter().flat_map(|found| found.submissions.values());
        submissions.filter_map(|(id, _)| id.clone()).collect()
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
        if self.directories.get(name).is_some_and(|found| found.is_torn && !found.is_removed) {
            self.fail(format!("calculation {name}, a part of whose directory was removed, is submitted"));
        }
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

    /// Begins to remove a directory, which gets another name first, so that nothing is left under its own. Its calculation must not
    /// run, and its result must be delivered or lost.
    pub fn begin_removal(&mut self, name: &str, why: DirectoryRemoval, bug: Option<PlantedBug>) {
        let Some(found) = self.directories.get_mut(name).filter(|found| !found.is_removed) else { return };
        let keeps_name = bug == Some(PlantedBug::RemovedInPart);
        found.is_removed = !keeps_name;
        if std::mem::replace(&mut found.is_torn, keeps_name) || found.is_damaged {
            return;
        }
        let has_result = found.truth.is_some_and(|truth| truth != Err(FailureClass::NodeFailure));
        let is_left = has_result && !found.is_delivered;
        let is_needed = match why {
            DirectoryRemoval::NotNeeded | DirectoryRemoval::OtherProgram => return,
            // What runs was cancelled, or ends without its directory.
            DirectoryRemoval::Lost { has_newer: true } => {
                found.is_running = false;
                return;
            }
            DirectoryRemoval::LeftOver => found.is_running || is_left && !found.is_unwanted,
            DirectoryRemoval::Delivered | DirectoryRemoval::Lost { has_newer: false } => {
                found.is_running || is_left
            }
        };
        if is_needed {
            let running = if found.is_running { "runs" } else { "is not delivered" };
            self.fail(format!("the directory of calculation {name}, which {running}, is removed: {why:?}"));
        }
    }

    /// Nothing is left of a directory.
    pub fn end_removal(&mut self, name: &str) {
        if let Some(found) = self.directories.get_mut(name) {
            found.is_removed = true;
        }
    }

    /// Directories that were made some time ago.
    pub fn older_than(&self, age: Time) -> Vec<String> {
        let is_old = |found: &CalculationFiles| !found.is_removed && found.made + age <= self.now;
        self.directories.iter().filter(|(_, found)| is_old(found)).map(|(name, _)| name.clone()).collect()
    }
}
