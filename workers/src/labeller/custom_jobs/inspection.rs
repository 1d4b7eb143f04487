//! What is concluded about a job from its directory and from answers of its batch system. Does no input or output.
//!
//! The order matters: an answer is older than what is seen after it. A calculation that has begun after the answers may
//! belong to a job that was submitted late.

use std::collections::VecDeque;
use std::time::Duration;

use ::batch::{JobId, PolledState};

use super::super::calculation_runner::CalculationEnd;
use super::super::calculation_state::CalculationState;
use super::job::JobSubmission;

/// A batch system may not know a job for this long after it was submitted.
pub(super) const NOT_YET_KNOWN: Duration = Duration::from_secs(60);
/// A job whose id was lost is over this long after its time limit.
const LOST_MARGIN: Duration = Duration::from_secs(600);

/// What a look at the directory of a job shows.
#[derive(Debug, PartialEq)]
pub enum CustomDirectory {
    /// There is none, or so little of it that no job can begin.
    Missing,
    /// The job is another user's, or one of another batch system.
    Foreign,
    /// The end of the calculation is recorded.
    Ended(CalculationEnd),
    /// It has not ended, as far as is visible.
    Open {
        /// The submission that calculates, and the time since it began.
        begun: Option<(u32, Duration)>,
        /// The submissions so far that were not refused.
        submissions: Vec<JobSubmission>,
        /// Whether there may be a further submission.
        may_be_submitted: bool,
    },
}

/// An inspection of a job. It begins with a look at the directory.
#[derive(Debug)]
pub struct CustomInspection {
    /// Time within which the job ends after it has begun.
    time_limit: Duration,
    /// The submission that calculates, if the first look found one.
    begun: Option<u32>,
    /// Submissions whose states are not known yet; the first of them was asked for.
    unknown: VecDeque<JobSubmission>,
    /// The job of which an end may be inferred, and its state; there when nothing is left to ask.
    over: Option<(Option<JobId>, PolledState)>,
}

/// What an inspection needs next, or has found.
#[derive(Debug, PartialEq)]
pub enum CustomStep {
    /// Ask for the state of this job, until the batch system answers.
    Ask(JobId),
    /// Make files from other hosts visible, and look at the directory again.
    Settle,
    /// The submission with this number is over, and its runner recorded no end: infer it ([`super::infer_custom_end`]).
    InferEnd {
        /// Number of the submission that calculated.
        number: u32,
        /// The id of its job, if it is known.
        id: Option<JobId>,
        /// What the batch system says of it.
        state: PolledState,
    },
    /// No submission is left: keep the jobs of lost ids, which may still wait, from calculating. The calculation is gone, or runs if
    /// one of them has begun.
    Close,
    /// The state of the calculation.
    Is(CalculationState),
}

impl CustomInspection {
    /// An inspection of a job that ends within this time after it has begun.
    pub fn new(time_limit: Duration) -> Self {
        Self { time_limit, begun: None, unknown: VecDeque::new(), over: None }
    }

    /// Continues with what a look at the directory shows.
    pub fn looked(&mut self, found: CustomDirectory) -> CustomStep {
        let (begun, submissions, may_be_submitted) = match found {
            CustomDirectory::Missing => return CustomStep::Is(CalculationState::Gone),
            CustomDirectory::Foreign => return CustomStep::Is(CalculationState::Elsewhere),
            CustomDirectory::Ended(end) => return CustomStep::Is(CalculationState::Ended(end)),
            CustomDirectory::Open { begun, submissions, may_be_submitted } => {
                (begun, submissions, may_be_submitted)
            }
        };
        match self.over.take() {
            None => self.looked_first(begun, submissions),
            Some((id, state)) => match (self.begun, begun) {
                (Some(number), _) => CustomStep::InferEnd { number, id, state },
                // It has begun meanwhile: the next inspection knows more.
                (None, Some(_)) => CustomStep::Is(CalculationState::Running),
                (None, None) if may_be_submitted => CustomStep::Is(CalculationState::Ready),
                (None, None) => CustomStep::Close,
            },
        }
    }

    fn looked_first(
        &mut self,
        begun: Option<(u32, Duration)>,
        submissions: Vec<JobSubmission>,
    ) -> CustomStep {
        self.begun = begun.map(|(number, _)| number);
        let Some((number, age)) = begun else {
            self.unknown = submissions.into_iter().filter(|submission| submission.id.is_some()).collect();
            return self.ask_next();
        };
        // A submission that was refused, although there is a job, is not among them.
        let submission = submissions.into_iter().find(|submission| submission.number == number);
        match submission.filter(|submission| submission.id.is_some()) {
            Some(submission) => {
                self.unknown.push_back(submission);
                self.ask_next()
            }
            None if age < self.time_limit.saturating_add(LOST_MARGIN) => {
                CustomStep::Is(CalculationState::Running)
            }
            None => {
                self.over = Some((None, PolledState::Vanished));
                CustomStep::Settle
            }
        }
    }

    /// Continues with the state of the job that was asked for.
    pub fn answered(&mut self, state: PolledState) -> CustomStep {
        let Some(submission) = self.unknown.pop_front() else { return CustomStep::Settle };
        let is_young = submission.age < NOT_YET_KNOWN;
        if state.is_alive() || state == PolledState::Vanished && is_young {
            return CustomStep::Is(CalculationState::Running);
        }
        self.over = Some((submission.id, state));
        self.ask_next()
    }

    /// Asks for the next job, or looks again if all are over.
    fn ask_next(&mut self) -> CustomStep {
        match self.unknown.front().and_then(|submission| submission.id.clone()) {
            Some(id) => CustomStep::Ask(id),
            None => {
                self.over.get_or_insert((None, PolledState::Vanished));
                CustomStep::Settle
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use dft::Exit;

    use super::super::super::calculation_runner::EndReason;
    use super::*;
    use CalculationState::{Elsewhere, Ended, Gone, Ready, Running};

    const LIMIT: Duration = Duration::from_secs(100);

    fn submission(number: u32, id: Option<u64>, age: u64) -> JobSubmission {
        let (id, age) = (id.map(JobId::from), Duration::from_secs(age));
        JobSubmission { number, id, age }
    }

    fn open(begun: Option<(u32, u64)>, submissions: &[JobSubmission]) -> CustomDirectory {
        let begun = begun.map(|(number, age)| (number, Duration::from_secs(age)));
        CustomDirectory::Open { begun, submissions: submissions.to_vec(), may_be_submitted: true }
    }

    fn end() -> CalculationEnd {
        let how = EndReason::Ended(Exit::Code(0));
        CalculationEnd { how, program: PathBuf::new(), seconds: 1.0, memory: 0, node: None, remark: None }
    }

    /// Looks, asks with these answers, and looks again.
    fn inspect(before: CustomDirectory, answers: &[PolledState], after: CustomDirectory) -> CustomStep {
        let mut inspection = CustomInspection::new(LIMIT);
        let mut step = inspection.looked(before);
        let mut answers = answers.iter();
        while let CustomStep::Ask(_) = step {
            step = inspection.answered(*answers.next().expect("an answer"));
        }
        assert_eq!(answers.next(), None, "no further question");
        if step == CustomStep::Settle { inspection.looked(after) } else { step }
    }

    #[test]
    fn what_the_directory_shows_needs_no_answer() {
        let same = [
            (CustomDirectory::Missing, Gone),
            (CustomDirectory::Foreign, Elsewhere),
            (CustomDirectory::Ended(end()), Ended(end())),
        ];
        for (found, state) in same {
            assert_eq!(inspect(found, &[], CustomDirectory::Missing), CustomStep::Is(state));
        }
    }

    #[test]
    fn the_job_that_calculates_is_asked_for() {
        use PolledState::{Completed, Pending, Vanished};
        let all = [submission(1, Some(7), 90), submission(2, Some(8), 80), submission(3, None, 70)];
        let mut inspection = CustomInspection::new(LIMIT);
        assert_eq!(inspection.looked(open(Some((2, 9)), &all)), CustomStep::Ask(JobId::from(8)));
        let begun = |answer, after| inspect(open(Some((2, 9)), &all), &[answer], after);
        assert_eq!(begun(Pending, open(None, &[])), CustomStep::Is(Running));
        for state in [Completed, Vanished] {
            let inferred = CustomStep::InferEnd { number: 2, id: Some(JobId::from(8)), state };
            assert_eq!(begun(state, open(Some((2, 11)), &all)), inferred);
            assert_eq!(begun(state, CustomDirectory::Ended(end())), CustomStep::Is(Ended(end())));
            assert_eq!(begun(state, CustomDirectory::Missing), CustomStep::Is(Gone));
        }
        // Its id was lost, or its submission was refused although there was a job.
        for number in [3, 4] {
            let lost = |age| inspect(open(Some((number, age)), &all), &[], open(Some((number, age)), &all));
            assert_eq!(lost(699), CustomStep::Is(Running));
            let inferred = CustomStep::InferEnd { number, id: None, state: Vanished };
            assert_eq!(lost(700), inferred);
        }
    }

    #[test]
    fn a_job_is_submitted_again_only_if_all_its_submissions_are_over() {
        use PolledState::{Cancelled, Completed, Pending, Vanished};
        let all = [submission(1, Some(7), 90), submission(2, None, 80), submission(3, Some(9), 60)];
        let waiting = |answers: &[PolledState], after| inspect(open(None, &all), answers, after);
        assert_eq!(waiting(&[Cancelled, Vanished], open(None, &all)), CustomStep::Is(Ready));
        assert_eq!(waiting(&[Pending], open(None, &all)), CustomStep::Is(Running));
        assert_eq!(waiting(&[Completed, Pending], open(None, &all)), CustomStep::Is(Running));
        assert_eq!(waiting(&[Completed, Completed], open(Some((2, 0)), &all)), CustomStep::Is(Running));
        assert_eq!(inspect(open(None, &[]), &[], open(None, &[])), CustomStep::Is(Ready));
        let used_up =
            |begun| CustomDirectory::Open { begun, submissions: Vec::new(), may_be_submitted: false };
        assert_eq!(inspect(used_up(None), &[], used_up(None)), CustomStep::Close);
        let has_begun = Some((2, Duration::ZERO));
        assert_eq!(inspect(used_up(None), &[], used_up(has_begun)), CustomStep::Is(Running));
        // The batch system may not know it yet.
        let young = [submission(1, Some(7), 59)];
        assert_eq!(inspect(open(None, &young), &[Vanished], open(None, &young)), CustomStep::Is(Running));
        assert_eq!(inspect(open(None, &young), &[Completed], open(None, &young)), CustomStep::Is(Ready));
    }
}
