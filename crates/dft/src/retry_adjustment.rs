//! What is changed before a calculation that failed is tried again. Nothing of it touches the accuracy of the protocol:
//! a calculation that converges with a remedy gives the same numbers as one that did without.

use std::collections::BTreeSet;

use crate::FailureClass;

/// One change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RetryAdjustment {
    /// More electronic steps are allowed.
    MoreSteps,
    /// The density is mixed more carefully.
    SlowerMixing,
    /// Another way to minimise.
    OtherAlgorithm,
    /// Other magnetic moments to start from.
    OtherMoments,
    /// Twice the memory.
    MoreMemory,
    /// Twice the time.
    MoreTime,
    /// Not where it failed.
    OtherNode,
}

impl RetryAdjustment {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::MoreSteps,
        Self::SlowerMixing,
        Self::OtherAlgorithm,
        Self::OtherMoments,
        Self::MoreMemory,
        Self::MoreTime,
        Self::OtherNode,
    ];

    /// Short name, as the store keeps it.
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
}

/// The ladder of a class: what each further failure of that class adds.
fn ladder(class: FailureClass) -> &'static [&'static [RetryAdjustment]] {
    use RetryAdjustment::*;
    match class {
        FailureClass::NotConverged => &[&[MoreSteps, SlowerMixing], &[OtherAlgorithm], &[OtherMoments]],
        FailureClass::TimeLimit => &[&[MoreTime]],
        FailureClass::OutOfMemory => &[&[MoreMemory], &[OtherNode]],
        FailureClass::Crashed => &[&[], &[OtherNode]],
        FailureClass::Implausible => &[&[SlowerMixing, OtherMoments]],
        FailureClass::BadInput | FailureClass::LostNode | FailureClass::OtherProgram => &[],
    }
}

/// What to change after the failures of a job so far, oldest first; `None` if its last class has no rung left, and the job
/// is to be given up.
pub fn adjustments(failures: &[FailureClass]) -> Option<BTreeSet<RetryAdjustment>> {
    let mut changes = BTreeSet::new();
    for class in BTreeSet::from_iter(failures) {
        if *class == FailureClass::LostNode {
            changes.insert(RetryAdjustment::OtherNode);
            continue;
        }
        let rungs = failures.iter().filter(|failure| *failure == class).count();
        changes.extend(ladder(*class).get(..rungs)?.iter().copied().flatten());
    }
    Some(changes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_class_has_its_own_ladder() {
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
        assert_eq!(adjustments(&[LostNode; 26]), Some(BTreeSet::from([RetryAdjustment::OtherNode])));
        for class in FailureClass::ALL.into_iter().filter(|class| *class != LostNode) {
            assert_eq!(adjustments(&[class; 26]), None, "{class} is tried for ever");
        }
    }
}
