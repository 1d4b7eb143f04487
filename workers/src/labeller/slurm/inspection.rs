//! What is concluded about a job from its directory and from Slurm's answer. Does no input or output.
//!
//! The order matters: Slurm's answer is older than what is seen after it. A calculation that had not begun before the
//! question and has begun after the answer may belong to a job that Slurm did not know yet, because the `sbatch` of another
//! labeller was late.

use std::path::Path;

use ::batch::JobPhase;

use super::super::batch_job::SCRATCH_NOT_SHARED;
use super::super::calculation_runner::CalculationEnd;
use super::super::calculation_state::CalculationState;
use super::super::private_directory;
use super::job::{BEGUN, REQUEST, SCRIPT};
use super::squeue::{SqueueJob, most_informative};

/// What a look at the directory of a job shows.
#[derive(Debug, PartialEq)]
pub enum JobDirectory {
    /// There is none.
    Missing,
    /// Another user has made it: after it was removed, or because that user has submitted the job.
    Foreign,
    /// It is this user's.
    Own {
        /// Whether a job has begun to calculate.
        begun: bool,
        /// Whether it has what a job needs to begin. Somebody may have removed a part of it.
        can_begin: bool,
        /// The recorded end.
        end: Option<CalculationEnd>,
    },
}

impl JobDirectory {
    pub(in super::super) fn look(directory: &Path) -> Self {
        if directory.symlink_metadata().is_err() {
            return Self::Missing;
        }
        if !private_directory::is_own(directory) {
            return Self::Foreign;
        }
        Self::Own {
            begun: directory.join(BEGUN).is_dir(),
            can_begin: [SCRIPT, REQUEST].iter().all(|file| directory.join(file).is_file()),
            end: CalculationEnd::read(directory),
        }
    }
}

/// An inspection of a job. It begins with a look at the directory.
#[derive(Debug, Default)]
pub struct Inspection {
    /// Whether the first look found a directory, and a calculation that had begun.
    exists: bool,
    begun: bool,
    /// Slurm's answer.
    answer: Option<Vec<SqueueJob>>,
}

/// What an inspection needs next, or has found.
#[derive(Debug, PartialEq)]
pub enum InspectionStep {
    /// Ask Slurm for every job of that name, those that are over as well, until it answers.
    Ask,
    /// Make files from other hosts visible, and look at the directory again.
    Settle,
    /// The job is over, and its runner recorded no end: infer it from what Slurm reports ([`super::infer_end`]).
    InferEnd(Option<SqueueJob>),
    /// The state of the calculation.
    Is(CalculationState),
    /// Files of the job are not visible here: why.
    NotVisible(String),
}

impl Inspection {
    /// Continues with what a look at the directory shows.
    pub fn looked(&mut self, found: JobDirectory) -> InspectionStep {
        let (exists, begun, can_begin) = match found {
            JobDirectory::Foreign => return InspectionStep::Is(CalculationState::Elsewhere),
            JobDirectory::Own { end: Some(end), .. } => {
                return InspectionStep::Is(CalculationState::Ended(end));
            }
            JobDirectory::Own { begun, can_begin, end: None } => (true, begun, can_begin),
            JobDirectory::Missing => (false, false, false),
        };
        match self.answer.take() {
            None => {
                (self.exists, self.begun) = (exists, begun);
                InspectionStep::Ask
            }
            // It was removed meanwhile.
            Some(_) if !exists => InspectionStep::Is(CalculationState::Gone),
            Some(jobs) => self.finished(&jobs, begun, can_begin),
        }
    }

    /// Continues with the jobs of that name that Slurm knows.
    pub fn answered(&mut self, jobs: Vec<SqueueJob>) -> InspectionStep {
        let living = jobs.iter().find(|reported| reported.phase() != JobPhase::Over);
        match (living, self.exists) {
            (Some(_), true) => InspectionStep::Is(CalculationState::Running),
            (Some(living), false) => InspectionStep::NotVisible(format!(
                "{living}, but its directory is not visible here: {SCRATCH_NOT_SHARED}"
            )),
            (None, false) => InspectionStep::Is(CalculationState::Gone),
            (None, true) => {
                self.answer = Some(jobs);
                InspectionStep::Settle
            }
        }
    }

    /// A job that is over or unknown to Slurm, and of which no end is recorded.
    fn finished(&self, jobs: &[SqueueJob], begun: bool, can_begin: bool) -> InspectionStep {
        match most_informative(jobs) {
            None if !begun && can_begin => InspectionStep::Is(CalculationState::Ready),
            None if !begun => InspectionStep::Is(CalculationState::Gone),
            // Perhaps after Slurm's answer: the next inspection knows more.
            _ if begun && !self.begun => InspectionStep::Is(CalculationState::Running),
            Some(reported) if !begun && reported.ran_to_its_end() => InspectionStep::NotVisible(format!(
                "{reported}, but its files are not visible here: {SCRATCH_NOT_SHARED}"
            )),
            // Slurm forgets it after a while.
            reported => InspectionStep::InferEnd(reported.cloned()),
        }
    }
}

#[cfg(test)]
mod tests {
    use dft::Exit;

    use super::super::super::calculation_runner::EndReason;
    use super::super::squeue::infer_end;
    use super::*;
    use CalculationState::{Elsewhere, Ended, Gone, Ready, Running};

    fn own(begun: bool) -> JobDirectory {
        JobDirectory::Own { begun, can_begin: true, end: None }
    }

    fn end() -> CalculationEnd {
        infer_end(None, &Default::default())
    }

    fn reported(state: &str) -> Vec<SqueueJob> {
        vec![SqueueJob::parse(&format!("12|{state}|node7|1:01|None")).unwrap()]
    }

    /// Looks, asks, and looks again.
    fn inspect(before: JobDirectory, jobs: Vec<SqueueJob>, after: JobDirectory) -> InspectionStep {
        let mut inspection = Inspection::default();
        match inspection.looked(before) {
            InspectionStep::Ask => {}
            step => return step,
        }
        match inspection.answered(jobs) {
            InspectionStep::Settle => inspection.looked(after),
            step => step,
        }
    }

    #[test]
    fn a_recorded_end_needs_no_answer_of_slurm() {
        let mut inspection = Inspection::default();
        let ended = JobDirectory::Own { begun: true, can_begin: true, end: Some(end()) };
        assert_eq!(inspection.looked(ended), InspectionStep::Is(Ended(end())));
        assert_eq!(Inspection::default().looked(JobDirectory::Foreign), InspectionStep::Is(Elsewhere));
        let late = JobDirectory::Own { begun: true, can_begin: true, end: Some(end()) };
        assert_eq!(inspect(own(true), reported("COMPLETED"), late), InspectionStep::Is(Ended(end())));
    }

    #[test]
    fn slurm_knows_jobs_that_live() {
        let states = ["PENDING", "RUNNING", "COMPLETING"];
        for begun in [false, true] {
            for state in states {
                assert_eq!(inspect(own(begun), reported(state), own(begun)), InspectionStep::Is(Running));
            }
        }
        let InspectionStep::NotVisible(why) =
            inspect(JobDirectory::Missing, reported("RUNNING"), JobDirectory::Missing)
        else {
            panic!()
        };
        assert!(why.starts_with("job 12 is RUNNING on node7, but its directory"), "{why}");
    }

    #[test]
    fn a_job_that_slurm_does_not_know_is_submitted_only_before_it_has_begun() {
        assert_eq!(inspect(own(false), Vec::new(), own(false)), InspectionStep::Is(Ready));
        assert_eq!(inspect(own(true), Vec::new(), own(true)), InspectionStep::InferEnd(None));
        assert_eq!(
            inspect(JobDirectory::Missing, Vec::new(), JobDirectory::Missing),
            InspectionStep::Is(Gone)
        );
        assert_eq!(inspect(own(true), Vec::new(), JobDirectory::Missing), InspectionStep::Is(Gone));
    }

    #[test]
    fn a_directory_from_which_a_part_was_removed_is_not_ready() {
        let home = tempfile::tempdir().unwrap();
        let look = || JobDirectory::look(home.path());
        for file in [SCRIPT, REQUEST] {
            assert_eq!(look(), JobDirectory::Own { begun: false, can_begin: false, end: None });
            assert_eq!(inspect(look(), Vec::new(), look()), InspectionStep::Is(Gone));
            std::fs::write(home.path().join(file), "").unwrap();
        }
        assert_eq!(inspect(look(), Vec::new(), look()), InspectionStep::Is(Ready));
        let begun = JobDirectory::Own { begun: true, can_begin: false, end: None };
        let later = JobDirectory::Own { begun: true, can_begin: false, end: None };
        assert_eq!(inspect(begun, Vec::new(), later), InspectionStep::InferEnd(None));
    }

    /// The `sbatch` of a labeller that was killed may arrive after Slurm's answer.
    #[test]
    fn an_answer_says_nothing_about_a_calculation_that_has_begun_since() {
        for jobs in [Vec::new(), reported("CANCELLED"), reported("COMPLETED")] {
            assert_eq!(inspect(own(false), jobs, own(true)), InspectionStep::Is(Running));
        }
    }

    #[test]
    fn the_end_of_a_job_that_is_over_is_inferred() {
        for (state, exit) in [("TIMEOUT", Exit::TimeLimit), ("CANCELLED", Exit::LostNode)] {
            for begun in [false, true] {
                let InspectionStep::InferEnd(found) = inspect(own(begun), reported(state), own(begun)) else {
                    panic!("{state}")
                };
                assert_eq!(found.as_ref(), reported(state).first());
                let end = infer_end(found.as_ref(), &Default::default());
                assert_eq!(end.how, EndReason::Ended(exit));
            }
        }
        // It must have made its directory.
        let invisible = inspect(own(false), reported("COMPLETED"), own(false));
        assert!(matches!(invisible, InspectionStep::NotVisible(why) if why.contains("label.scratch")));
    }
}
