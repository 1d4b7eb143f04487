//! Mistakes that are made on purpose, to see that the simulation finds them. They are made at the edges, never in the
//! program itself.

use super::scenario::{AGENT_SEEDS, CUSTOM_SEEDS, REFIT_SEEDS, SLURM_SEEDS};

/// A mistake.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PlantedBug {
    /// Walkers are answered while the commit is still being written.
    AnswerBeforeCommit,
    /// The orchestrator takes a commit that failed for one that was made.
    FailedCommitBelieved,
    /// A commit whose answer was lost is made again, without looking whether it was made.
    CommitRepeated,
    /// Labellers do not say which leases they know of: one whose COMMIT answer was lost lasts as long as its holder.
    LostLeaseForgotten,
    /// A lease that is renewed returns to the queue as well.
    LeaseGivenTwice,
    /// A replaced orchestrator may still write.
    FenceForgotten,
    /// A second orchestrator starts although the first one holds the lock.
    LockIgnored,
    /// Every process of a walker has the same incarnation.
    IncarnationIgnored,
    /// Commits with candidates do not contain the checkpoints of their walks.
    CheckpointForgotten,
    /// Walkers see the newest version number of the mixture with the components of the version before.
    TornMixture,
    /// A calculation is started before it is recorded.
    CalculationRecordedLate,
    /// A labeller starts a calculation without looking for an earlier one.
    CalculationNotLookedUp,
    /// The orchestrator reads only once which walks are paused.
    PauseRemembered,
    /// The orchestrator reads only once how long the label queue is.
    QueueLengthRemembered,
    /// A labeller continues although another one has replaced it.
    ReplacedLabellerContinues,
    /// A run ends with the last walk, although structures wait for labels.
    QueueAbandoned,
    /// After a restart the selector does not know which structures were accepted.
    KnownStructuresForgotten,
    /// After a restart the selector begins with the original mixture.
    MixtureForgotten,
    /// Labellers are not told of the budget.
    BudgetForgotten,
    /// The orchestrator does not remove agents that are silent for too long.
    AgentLossForgotten,
    /// Every process of an agent has the same id, so late messages of dead ones are believed.
    AgentIdReused,
    /// An agent takes a late reply for one to its current request.
    LateReplyBelieved,
    /// An agent deals an assignment to a second walker.
    AssignmentDealtTwice,
    /// Walkers of agents get the newest mixture in place of that of their assignment.
    NewestMixture,
    /// A run uses one session for the agents of all versions of the potential.
    SessionOfAllVersions,
    /// An agent that has lost its registration starts again with the slots of the old one.
    OldSlotsKept,
    /// After a restart the orchestrator does not know how many versions may be trained.
    VersionLimitForgotten,
    /// A refit does not look whether an earlier process of it has recorded its version.
    VersionRecordedTwice,
    /// The walks of a newer version start while those of the version before go on.
    OldWalksContinue,
    /// A run ends with its walks, although a refit is left.
    RefitAbandoned,
    /// A version that was refused is taken up.
    RefusedVersionTakenUp,
    /// A labeller does not see whether a Slurm job has begun.
    BegunOverlooked,
    /// A labeller takes a Slurm that does not answer for one that knows no job.
    SilenceTakenAsGone,
    /// A labeller does not wait until files of nodes are visible.
    FilesBelievedAtOnce,
    /// A labeller judges a calculation by an answer of Slurm from before it began.
    OldAnswerBelieved,
    /// A labeller does not read why Slurm ended a job.
    EndsMixedUp,
    /// The loss of a node counts as an attempt.
    NodeFailuresCounted,
    /// Each attempt begins with the first adjustments again.
    LadderRestarted,
    /// A labeller uses the number of a submission that was refused, and may have a job all the same, once more.
    RefusalForgotten,
    /// A labeller removes every directory that another one left, whether its result is needed or not.
    WantedRemoved,
    /// A labeller removes a directory under its own name.
    RemovedInPart,
}

impl PlantedBug {
    pub const ALL: [Self; 41] = [
        Self::AnswerBeforeCommit,
        Self::FailedCommitBelieved,
        Self::CommitRepeated,
        Self::LostLeaseForgotten,
        Self::LeaseGivenTwice,
        Self::FenceForgotten,
        Self::LockIgnored,
        Self::IncarnationIgnored,
        Self::CheckpointForgotten,
        Self::TornMixture,
        Self::CalculationRecordedLate,
        Self::CalculationNotLookedUp,
        Self::PauseRemembered,
        Self::QueueLengthRemembered,
        Self::ReplacedLabellerContinues,
        Self::QueueAbandoned,
        Self::KnownStructuresForgotten,
        Self::MixtureForgotten,
        Self::BudgetForgotten,
        Self::AgentLossForgotten,
        Self::AgentIdReused,
        Self::LateReplyBelieved,
        Self::OldSlotsKept,
        Self::AssignmentDealtTwice,
        Self::NewestMixture,
        Self::SessionOfAllVersions,
        Self::VersionLimitForgotten,
        Self::VersionRecordedTwice,
        Self::OldWalksContinue,
        Self::RefitAbandoned,
        Self::RefusedVersionTakenUp,
        Self::BegunOverlooked,
        Self::SilenceTakenAsGone,
        Self::FilesBelievedAtOnce,
        Self::OldAnswerBelieved,
        Self::EndsMixedUp,
        Self::NodeFailuresCounted,
        Self::LadderRestarted,
        Self::RefusalForgotten,
        Self::WantedRemoved,
        Self::RemovedInPart,
    ];
}

impl PlantedBug {
    /// The first seed of those that can find it.
    pub fn first_seed(self) -> u64 {
        match self {
            Self::AgentLossForgotten
            | Self::AgentIdReused
            | Self::LateReplyBelieved
            | Self::OldSlotsKept
            | Self::AssignmentDealtTwice
            | Self::NewestMixture => AGENT_SEEDS,
            Self::SessionOfAllVersions
            | Self::VersionLimitForgotten
            | Self::VersionRecordedTwice
            | Self::OldWalksContinue
            | Self::RefitAbandoned
            | Self::RefusedVersionTakenUp => REFIT_SEEDS,
            Self::BegunOverlooked
            | Self::SilenceTakenAsGone
            | Self::FilesBelievedAtOnce
            | Self::OldAnswerBelieved
            | Self::EndsMixedUp
            | Self::NodeFailuresCounted
            | Self::LadderRestarted
            | Self::RemovedInPart => SLURM_SEEDS,
            Self::RefusalForgotten | Self::WantedRemoved => CUSTOM_SEEDS,
            _ => 0,
        }
    }

    /// A seed that finds it, with which the search begins.
    pub fn found_by(self) -> u64 {
        match self {
            Self::AnswerBeforeCommit
            | Self::LeaseGivenTwice
            | Self::CheckpointForgotten
            | Self::TornMixture
            | Self::QueueAbandoned
            | Self::MixtureForgotten => 0,
            Self::CalculationNotLookedUp | Self::ReplacedLabellerContinues => 1,
            Self::FailedCommitBelieved
            | Self::LostLeaseForgotten
            | Self::LockIgnored
            | Self::QueueLengthRemembered
            | Self::KnownStructuresForgotten => 2,
            Self::CommitRepeated => 4,
            Self::FenceForgotten => 6,
            Self::BudgetForgotten => 7,
            Self::IncarnationIgnored => 32,
            Self::PauseRemembered => 50,
            Self::CalculationRecordedLate => 57,
            Self::AgentLossForgotten => AGENT_SEEDS,
            Self::LateReplyBelieved | Self::OldSlotsKept => AGENT_SEEDS + 1,
            Self::RefusalForgotten => CUSTOM_SEEDS + 9,
            Self::WantedRemoved => CUSTOM_SEEDS + 4,
            Self::AssignmentDealtTwice => AGENT_SEEDS,
            Self::NewestMixture => AGENT_SEEDS + 15,
            Self::SessionOfAllVersions => REFIT_SEEDS + 35,
            Self::AgentIdReused | Self::RefitAbandoned | Self::RefusedVersionTakenUp => self.first_seed(),
            Self::VersionLimitForgotten | Self::VersionRecordedTwice | Self::OldWalksContinue => {
                REFIT_SEEDS + 1
            }
            Self::NodeFailuresCounted | Self::LadderRestarted | Self::EndsMixedUp => SLURM_SEEDS,
            Self::BegunOverlooked => SLURM_SEEDS + 2,
            Self::FilesBelievedAtOnce => SLURM_SEEDS + 12,
            Self::RemovedInPart => SLURM_SEEDS + 18,
            Self::SilenceTakenAsGone => SLURM_SEEDS + 7,
            Self::OldAnswerBelieved => SLURM_SEEDS + 8,
        }
    }
}
