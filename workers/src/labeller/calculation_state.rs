//! The state of a calculation.

use super::calculation_runner::CalculationEnd;

/// The state of a calculation.
#[derive(Debug, PartialEq)]
pub enum CalculationState {
    /// It has ended, and its results can be read.
    Ended(CalculationEnd),
    /// It runs, or waits in the queue of a batch system.
    Running,
    /// It is prepared and can be started.
    Ready,
    /// It was interrupted, or its directory was removed.
    Gone,
    /// It cannot be observed from this host.
    Elsewhere,
}

/// What a labeller does that waits for the end of a job.
#[derive(Debug, PartialEq)]
pub enum WaitStep {
    /// Read its results.
    Read(CalculationEnd),
    /// Submit it: no batch system knows it, and it has not begun.
    Submit,
    /// Wait further.
    Wait,
    /// Give it up.
    Abandon,
}

/// What a labeller does with a calculation that an earlier attempt recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EarlierStep {
    /// Leave it alone.
    Leave,
    /// End what is left of it and remove its directory.
    Clear,
    /// Wait for it in place of a new calculation.
    Take,
}

impl CalculationState {
    /// What a labeller does that waits for a job in this state.
    pub fn while_waiting(self) -> WaitStep {
        match self {
            Self::Ended(end) => WaitStep::Read(end),
            Self::Ready => WaitStep::Submit,
            Self::Running => WaitStep::Wait,
            Self::Gone | Self::Elsewhere => WaitStep::Abandon,
        }
    }

    /// What a labeller does with an earlier calculation in this state, if it has found a newer one that it can wait for or
    /// not.
    pub fn of_earlier(&self, has_newer: bool) -> EarlierStep {
        match self {
            Self::Elsewhere => EarlierStep::Leave,
            Self::Gone => EarlierStep::Clear,
            Self::Ended(end) if end.is_not_started() => EarlierStep::Clear,
            _ if has_newer => EarlierStep::Clear,
            _ => EarlierStep::Take,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use dft::Exit;

    use super::super::calculation_runner::EndReason;
    use super::*;
    use CalculationState::{Elsewhere, Ended, Gone, Ready, Running};

    fn ended(how: EndReason) -> CalculationEnd {
        CalculationEnd { how, program: PathBuf::new(), seconds: 1.0, memory: 0, node: None, remark: None }
    }

    #[test]
    fn the_newest_calculation_that_can_be_read_is_taken() {
        let read = || Ended(ended(EndReason::Ended(Exit::TimeLimit)));
        for state in [read(), Running, Ready] {
            assert_eq!(state.of_earlier(false), EarlierStep::Take);
            assert_eq!(state.of_earlier(true), EarlierStep::Clear);
        }
        for has_newer in [false, true] {
            assert_eq!(Elsewhere.of_earlier(has_newer), EarlierStep::Leave);
            assert_eq!(Gone.of_earlier(has_newer), EarlierStep::Clear);
            assert_eq!(Ended(ended(EndReason::NotStarted(2))).of_earlier(has_newer), EarlierStep::Clear);
        }
    }

    #[test]
    fn nothing_waits_for_a_job_that_is_gone() {
        let end = ended(EndReason::Ended(Exit::Code(0)));
        assert_eq!(Ended(end.clone()).while_waiting(), WaitStep::Read(end));
        assert_eq!(Running.while_waiting(), WaitStep::Wait);
        assert_eq!(Ready.while_waiting(), WaitStep::Submit);
        assert_eq!([Gone.while_waiting(), Elsewhere.while_waiting()], [WaitStep::Abandon, WaitStep::Abandon]);
    }
}
