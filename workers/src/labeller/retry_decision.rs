//! What follows from the failures of a job: the adjustments of its next attempt, and when it fails. Does no input or
//! output.

use std::collections::BTreeSet;

use dft::{Exit, Failure, FailureClass, RetryAdjustment};

use super::failure_classes::failure_classes;

/// The adjustments for the next attempt of a job with these failures so far, oldest first.
///
/// # Errors
/// The job fails: nothing is left to try.
pub fn next_adjustments(failures: &[FailureClass]) -> Result<BTreeSet<RetryAdjustment>, Failure> {
    dft::adjustments(failures).ok_or_else(|| {
        let class = failures.last().copied().unwrap_or(FailureClass::Crashed);
        class.with_message("there is nothing left to try")
    })
}

/// The number of attempts after which a job fails whose earlier failures have these names, and that has failed again:
/// one if nothing is left to try, otherwise `attempts`.
pub fn attempt_limit(earlier: &[String], class: FailureClass, attempts: u32) -> u32 {
    let failures: Vec<_> = failure_classes(earlier).into_iter().chain([class]).collect();
    if dft::adjustments(&failures).is_some() { attempts } else { 1 }
}

/// Whether a failure of this class counts as an attempt: the loss of a node is no fault of the job.
pub fn counts_as_attempt(class: FailureClass) -> bool {
    class != FailureClass::NodeFailure
}

/// The failure of a calculation that ended so and whose files show this one. If it reached a limit, that is the failure.
pub fn failure_at(exit: Exit, shown: Failure) -> Failure {
    match exit {
        Exit::TimeLimit | Exit::OutOfMemory | Exit::LostNode => exit.failure(),
        Exit::Code(_) | Exit::Signal(_) => shown,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use FailureClass::{BadInput, NodeFailure, NotConverged, TimeLimit};

    #[test]
    fn a_job_fails_when_nothing_is_left_to_try() {
        let names = |classes: &[FailureClass]| -> Vec<String> {
            classes.iter().map(|class| class.name().to_owned()).collect()
        };
        assert_eq!(attempt_limit(&[], BadInput, 5), 1);
        assert_eq!(attempt_limit(&[], TimeLimit, 5), 5);
        assert_eq!(attempt_limit(&names(&[TimeLimit]), TimeLimit, 5), 1);
        assert_eq!(attempt_limit(&names(&[NodeFailure, NotConverged]), TimeLimit, 5), 5);
        // A class that only the store knows.
        assert_eq!(attempt_limit(&["lost_too_often".to_owned()], NotConverged, 5), 5);
        let failure = next_adjustments(&[TimeLimit, TimeLimit]).unwrap_err();
        assert_eq!(failure.to_string(), "time limit: there is nothing left to try");
        assert_eq!(next_adjustments(&[]), Ok(BTreeSet::new()));
    }

    #[test]
    fn a_limit_explains_whatever_the_files_show() {
        let shown = NotConverged.with_message("in its file");
        assert_eq!(failure_at(Exit::TimeLimit, shown.clone()).class, TimeLimit);
        assert_eq!(failure_at(Exit::LostNode, shown.clone()).class, NodeFailure);
        assert_eq!(failure_at(Exit::Code(0), shown.clone()), shown);
    }
}
