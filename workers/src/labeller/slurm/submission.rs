//! When a job whose submission failed is submitted again. Does no input or output.

use super::super::batch_job::MAX_REFUSALS;
use super::squeue::SqueueJob;

/// A job that is being submitted.
#[derive(Debug, Default)]
pub struct SubmissionRetry {
    /// How often Slurm refused it.
    refused: u32,
}

/// What follows from an `sbatch` that failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SubmissionStep {
    /// Wait for the job: it was submitted all the same, or its directory was removed.
    Wait,
    /// Submit it again.
    Again,
    /// Slurm refuses it.
    Refused,
}

impl SubmissionRetry {
    /// Continues with the jobs of that name that Slurm knows, after `sbatch` has failed. `exists` says whether there is a
    /// directory; `permit` permits every node to the job, and returns whether that changed something.
    ///
    /// # Errors
    /// Those of `permit`.
    pub fn failed<E>(
        &mut self,
        jobs: &[SqueueJob],
        exists: bool,
        permit: impl FnOnce() -> Result<bool, E>,
    ) -> Result<SubmissionStep, E> {
        // The reply was lost, if there is such a job.
        if !jobs.is_empty() || !exists {
            return Ok(SubmissionStep::Wait);
        }
        self.refused += 1;
        // All permitted nodes may be excluded.
        let is_changed = permit()?;
        match self.refused < MAX_REFUSALS || is_changed {
            true => Ok(SubmissionStep::Again),
            false => Ok(SubmissionStep::Refused),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failed(
        submission: &mut SubmissionRetry,
        jobs: &[SqueueJob],
        exists: bool,
        permits: bool,
    ) -> SubmissionStep {
        submission.failed(jobs, exists, || Ok::<_, ()>(permits)).unwrap()
    }

    #[test]
    fn a_refused_job_is_submitted_three_times() {
        use SubmissionStep::{Again, Refused, Wait};
        let known = [SqueueJob::parse("12|PENDING||0:00|None").unwrap()];
        let mut submission = SubmissionRetry::default();
        let steps = [false, false, true, false].map(|permits| failed(&mut submission, &[], true, permits));
        assert_eq!(steps, [Again, Again, Again, Refused]);
        assert_eq!(failed(&mut submission, &known, true, false), Wait);
        assert_eq!(failed(&mut SubmissionRetry::default(), &[], false, false), Wait);
        let mut unreadable = SubmissionRetry::default();
        assert_eq!(unreadable.failed(&[], true, || Err("disk")), Err("disk"));
    }
}
