//! What changes before a failed calculation is tried again. No adjustment affects the accuracy of the protocol:
//! a calculation that converges with one gives the same numbers as without.

use std::collections::BTreeSet;

use crate::FailureClass;

/// One adjustment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RetryAdjustment {
    /// Allow more electronic steps.
    MoreSteps,
    /// Mix densities more cautiously.
    SlowerMixing,
    /// Use another minimisation algorithm.
    OtherAlgorithm,
    /// Start from other magnetic moments.
    OtherMoments,
    /// Request twice the memory.
    MoreMemory,
    /// Allow twice the time.
    MoreTime,
    /// Avoid the nodes on which it failed.
    OtherNode,
}

impl RetryAdjustment {
    /// All adjustments.
    pub const ALL: [Self; 7] = [
        Self::MoreSteps,
        Self::SlowerMixing,
        Self::OtherAlgorithm,
        Self::OtherMoments,
        Self::MoreMemory,
        Self::MoreTime,
        Self::OtherNode,
    ];

    /// Name in the store.
    pub fn name(self) -> &'static str {
        match self {
            Self::MoreSteps => "more_steps",
            Self::SlowerMixing => "slower_mixing",
            Self::OtherAlgorithm => "other_algorithm",
            Self::OtherMoments => "other_moments",
            Self::MoreMemory => "more_memory",
            Self::MoreTime => "more_time",
            Self::OtherNode => "other_node",
        }
    }

    /// Whether it changes what the calculation may use or where it runs, not the calculation itself.
    pub fn is_of_resources(self) -> bool {
        matches!(self, Self::MoreMemory | Self::MoreTime | Self::OtherNode)
    }
}

/// The adjustments that each further failure of a class adds.
fn escalation(class: FailureClass) -> &'static [&'static [RetryAdjustment]] {
    use RetryAdjustment::*;
    match class {
        FailureClass::NotConverged => &[&[MoreSteps, SlowerMixing], &[OtherAlgorithm], &[OtherMoments]],
        FailureClass::TimeLimit => &[&[MoreTime]],
        FailureClass::OutOfMemory => &[&[MoreMemory], &[OtherNode]],
        FailureClass::Crashed => &[&[], &[OtherNode]],
        FailureClass::Implausible => &[&[SlowerMixing, OtherMoments]],
        FailureClass::BadInput | FailureClass::NodeFailure | FailureClass::OtherProgram => &[],
    }
}

/// The adjustments for the next attempt, from the failures of a job so far, oldest first. `None` if nothing is
/// left to try for the last failure's class and the job has failed.
pub fn adjustments(failures: &[FailureClass]) -> Option<BTreeSet<RetryAdjustment>> {
    let mut changes = BTreeSet::new();
    for class in BTreeSet::from_iter(failures) {
        if *class == FailureClass::NodeFailure {
            changes.insert(RetryAdjustment::OtherNode);
            continue;
        }
        let rungs = failures.iter().filter(|failure| *failure == class).count();
        changes.extend(escalation(*class).get(..rungs)?.iter().copied().flatten());
    }
    Some(changes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_class_has_its_own_escalation() {
        use FailureClass::*;
        assert_eq!(adjustments(&[]), Some(BTreeSet::new()));
        assert_eq!(adjustments(&[BadInput]), None);
        let mixed = adjustments(&[NotConverged, TimeLimit, NotConverged]).unwrap();
        let expected = [
            RetryAdjustment::MoreSteps,
            RetryAdjustment::SlowerMixing,
            RetryAdjustment::OtherAlgorithm,
            RetryAdjustment::MoreTime,
        ];
        assert_eq!(mixed, BTreeSet::from(expected));
        assert_eq!(adjustments(&[NodeFailure; 26]), Some(BTreeSet::from([RetryAdjustment::OtherNode])));
        for class in FailureClass::ALL.into_iter().filter(|class| *class != NodeFailure) {
            assert_eq!(adjustments(&[class; 26]), None, "{class} is tried for ever");
        }
    }
}
