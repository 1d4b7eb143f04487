//! When a job whose submission failed is submitted again. Does no input or output.

use ::batch::CustomError;

use super::super::batch_job::MAX_REFUSALS;

/// Why a submission failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SubmissionFailure {
    /// There was no answer in time: there may be a job, which may calculate.
    NoAnswer,
    /// The answer has no id, although the command ended well: there is a job.
    NoId,
    /// There is no such command.
    NoCommand,
    /// The command failed, or could not be started.
    Refused,
}

/// A job that is being submitted.
#[derive(Debug, Default)]
pub struct CustomSubmission {
    /// How often the batch system refused it.
    refused: u32,
}

/// What follows from a submission that failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AfterFailure {
    /// The submission counts as refused. If there is a job all the same, it may calculate under the number of this submission, which
    /// is not used again.
    pub forget: bool,
    /// The job is submitted again; otherwise the labeller fails.
    pub again: bool,
}

impl SubmissionFailure {
    pub(super) fn of(error: &CustomError) -> Self {
        match error {
            CustomError::TimedOut { .. } => Self::NoAnswer,
            CustomError::UnexpectedOutput { .. } => Self::NoId,
            error if error.is_missing() => Self::NoCommand,
            _ => Self::Refused,
        }
    }
}

impl CustomSubmission {
    /// Continues after a submission failed.
    pub fn failed(&mut self, why: SubmissionFailure) -> AfterFailure {
        self.refused += u32::from(why == SubmissionFailure::Refused);
        let may_help = match why {
            SubmissionFailure::NoAnswer => true,
            SubmissionFailure::NoId | SubmissionFailure::NoCommand => false,
            SubmissionFailure::Refused => self.refused < MAX_REFUSALS,
        };
        let forget = matches!(why, SubmissionFailure::NoCommand | SubmissionFailure::Refused);
        AfterFailure { forget, again: may_help }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refused_job_is_submitted_three_times() {
        use SubmissionFailure::{NoAnswer, NoCommand, NoId, Refused};
        let (forget, kept) =
            (|again| AfterFailure { forget: true, again }, |again| AfterFailure { forget: false, again });
        let mut submission = CustomSubmission::default();
        let steps = [Refused, NoAnswer, Refused, NoAnswer, Refused].map(|why| submission.failed(why));
        assert_eq!(steps, [forget(true), kept(true), forget(true), kept(true), forget(false)]);
        assert_eq!(CustomSubmission::default().failed(NoCommand), forget(false));
        assert_eq!(CustomSubmission::default().failed(NoId), kept(false));
    }
}
