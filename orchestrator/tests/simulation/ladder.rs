//! Retries: what jobs need to give a label, and what must hold of their ladders of adjustments.

use std::collections::{BTreeMap, BTreeSet};

use dft::{FailureClass, RetryAdjustment};
use store::records::Lease;
use workers::labeller::decisions::{failure_classes, next_adjustments};

use super::labeller::ATTEMPTS;
use super::planted::PlantedBug;
use super::random::Random;
use super::world::World;

/// Attempts where jobs are of different difficulty: more than the longest ladder has.
const MANY_ATTEMPTS: u32 = 6;

/// What a job needs to give a label.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Difficulty {
    Easy,
    /// Its calculations fail so without this adjustment.
    Needs(FailureClass, RetryAdjustment),
    /// All of its calculations fail so.
    Never(FailureClass),
    /// Its first calculation fails so.
    Once(FailureClass),
}

impl Difficulty {
    /// That of a job of a seed.
    pub fn of(seed: u64, job: i64) -> Self {
        use FailureClass::*;
        match Random::new(seed.rotate_left(20) ^ job.cast_unsigned()).below(18) {
            0 => Self::Needs(NotConverged, RetryAdjustment::SlowerMixing),
            1 => Self::Needs(NotConverged, RetryAdjustment::OtherAlgorithm),
            2 => Self::Needs(NotConverged, RetryAdjustment::OtherMoments),
            3 => Self::Needs(OutOfMemory, RetryAdjustment::MoreMemory),
            4 => Self::Needs(TimeLimit, RetryAdjustment::MoreTime),
            5 => Self::Needs(Implausible, RetryAdjustment::OtherMoments),
            6 => Self::Needs(Crashed, RetryAdjustment::OtherNode),
            7 => Self::Never(NotConverged),
            8 => Self::Never(BadInput),
            9 => Self::Never(Crashed),
            10 => Self::Once(OtherProgram),
            _ => Self::Easy,
        }
    }

    /// How a calculation with these adjustments fails.
    pub fn failure(self, adjustments: &BTreeSet<RetryAdjustment>, is_first: bool) -> Option<FailureClass> {
        match self {
            Self::Easy => None,
            Self::Needs(class, adjustment) => (!adjustments.contains(&adjustment)).then_some(class),
            Self::Never(class) => Some(class),
            Self::Once(class) => is_first.then_some(class),
        }
    }
}

/// The failures that a class permits before its ladder is exhausted, and what was tried then, counted independently of the
/// program.
fn ladder(class: FailureClass) -> (usize, &'static [RetryAdjustment]) {
    use RetryAdjustment::*;
    match class {
        FailureClass::NotConverged => (3, &[MoreSteps, SlowerMixing, OtherAlgorithm, OtherMoments]),
        FailureClass::OutOfMemory => (2, &[MoreMemory, OtherNode]),
        FailureClass::Crashed => (2, &[OtherNode]),
        FailureClass::TimeLimit => (1, &[MoreTime]),
        FailureClass::Implausible => (1, &[SlowerMixing, OtherMoments]),
        FailureClass::BadInput | FailureClass::OtherProgram => (0, &[]),
        FailureClass::NodeFailure => (usize::MAX, &[]),
    }
}

/// What is known of the ladders of jobs: the number of failures and the adjustments at the last lease.
#[derive(Default)]
pub struct Ladders(BTreeMap<i64, (usize, BTreeSet<RetryAdjustment>)>);

impl Ladders {
    /// A person has requested labels again: every job may begin again.
    pub fn forget(&mut self) {
        self.0.clear();
    }
}

impl World {
    /// Attempts before a label counts as failed.
    pub fn attempts(&self) -> u32 {
        if self.scenario.slurm { MANY_ATTEMPTS } else { ATTEMPTS }
    }

    /// The adjustments of the next attempt, or the class of failure with which the job ends.
    pub fn adjustments_of(&mut self, lease: &Lease) -> Result<BTreeSet<RetryAdjustment>, FailureClass> {
        let failures = match self.bug {
            Some(PlantedBug::LadderRestarted) => Vec::new(),
            _ => failure_classes(&lease.failures),
        };
        let adjustments = next_adjustments(&failures).map_err(|failure| failure.class)?;
        let (job, count) = (lease.job, lease.failures.len());
        let before = self.slurm.ladders.0.insert(job, (count, adjustments.clone()));
        if let Some((failures, before)) = before.filter(|_| !self.handled.contains(&job)) {
            if count < failures {
                self.fail(format!("job {job} had {failures} failures, and now {count}"));
            }
            if !before.is_subset(&adjustments) {
                self.fail(format!("adjustments of job {job} are gone: {before:?}, then {adjustments:?}"));
            }
        }
        Ok(adjustments)
    }

    /// A job has failed: its ladder or its attempts are exhausted. A calculation counts once, however many attempts waited
    /// for it, and an exhausted ladder was tried with all of its adjustments.
    pub fn check_failed_job(&mut self, job: i64) {
        if self.handled.contains(&job) {
            return;
        }
        let (attempts,): (String,) = self.ask(&format!(
            "SELECT coalesce(group_concat(class || ':' || outcome || ':' || coalesce(calculation, ''), ','), '')
             FROM attempt WHERE job = {job} AND class IS NOT NULL AND outcome IN ('failed', 'lost')"
        ));
        let (mut seen, mut failed, mut classes) = (BTreeSet::new(), 0, Vec::new());
        let mut calculated = Vec::new();
        for attempt in attempts.split(',') {
            let mut parts = attempt.split(':');
            let [class, outcome, calculation] = [(); 3].map(|()| parts.next().unwrap_or_default());
            let calculation = calculation.split('@').next().unwrap_or_default();
            if calculation.is_empty() || seen.insert(calculation) {
                failed += u32::from(outcome == "failed");
                classes.push(class);
                calculated.extend((!calculation.is_empty()).then_some(class));
            }
        }
        let exhausted = |names: &[&str]| {
            let count = |class: FailureClass| names.iter().filter(|name| **name == class.name()).count();
            FailureClass::ALL.into_iter().find(|class| count(*class) > ladder(*class).0)
        };
        let is_exhausted = exhausted(&classes).is_some();
        if !is_exhausted && failed < self.attempts() && !classes.contains(&"lost_too_often") {
            self.fail(format!("job {job} has failed, although something is left to try: {attempts}"));
        }
        // Without Slurm, calculations do not know their adjustments.
        let tried = self.slurm.adjustments_tried(job);
        let Some(class) = exhausted(&calculated).filter(|_| self.scenario.slurm) else { return };
        if let Some(missing) = ladder(class).1.iter().find(|adjustment| !tried.contains(adjustment)) {
            self.fail(format!("job {job} has failed ({class}), and {missing:?} was never tried"));
        }
    }
}
