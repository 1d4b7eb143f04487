//! What goes wrong with Slurm and its nodes.

use std::fmt;

use dft::FailureClass;

use super::super::fault::Time;
use super::super::random::Random;

/// States of jobs that end without a word of their runner, with what Slurm writes into the job's log.
pub const ENDS: [(&str, FailureClass, &str); 7] = [
    (
        "TIMEOUT",
        FailureClass::TimeLimit,
        "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now DUE TO TIME LIMIT ***",
    ),
    (
        "OUT_OF_MEMORY",
        FailureClass::OutOfMemory,
        "slurmstepd: error: Detected 1 oom_kill event in StepId=1.batch.",
    ),
    (
        "FAILED",
        FailureClass::OutOfMemory,
        "slurmstepd: error: StepId=1.batch exceeded memory limit (2 > 1), being killed",
    ),
    (
        "NODE_FAIL",
        FailureClass::NodeFailure,
        "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now DUE TO NODE FAILURE ***",
    ),
    ("CANCELLED", FailureClass::NodeFailure, "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now ***"),
    (
        "PREEMPTED",
        FailureClass::NodeFailure,
        "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now DUE TO PREEMPTION ***",
    ),
    ("FAILED", FailureClass::NodeFailure, "Killed"),
];

/// What goes wrong with Slurm and its nodes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SlurmFault {
    /// slurmctld does not answer. Jobs go on, and their ends are known later.
    Away { until: Time },
    /// The queue is full.
    Full { until: Time },
    /// The reply to the next `sbatch` is lost: there is a job all the same.
    ReplyLost,
    /// A labeller is killed during its next `sbatch`, which submits the job later.
    LateSubmission { delay: Time },
    /// A job ends, in one of the ways of [`ENDS`].
    JobEnds { how: usize },
    /// A job that waits is cancelled.
    WaitingJobCancelled,
    /// What nodes write is seen much later.
    FilesLate { until: Time },
    /// The directory of a calculation is removed.
    DirectoryRemoved,
    /// The next labeller that removes a directory is killed meanwhile.
    KilledInRemoval,
}

impl SlurmFault {
    pub fn draw(random: &mut Random, until: Time) -> Self {
        match random.below(16) {
            0..3 => Self::Away { until },
            3 => Self::Full { until },
            4..6 => Self::ReplyLost,
            6..9 => Self::LateSubmission { delay: random.between(2_000, 12_000) },
            9..12 => Self::JobEnds { how: random.below(ENDS.len() as u64) as usize },
            12 => Self::WaitingJobCancelled,
            13..15 => Self::FilesLate { until },
            _ => Self::DirectoryRemoved,
        }
    }

    pub fn end(&self, at: Time) -> Time {
        match self {
            Self::Away { until } | Self::Full { until } | Self::FilesLate { until } => *until,
            _ => at,
        }
    }
}

impl fmt::Display for SlurmFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |time: &Time| *time as f64 / 1000.0;
        match self {
            Self::Away { until } => write!(f, "the batch system does not answer until {} s", seconds(until)),
            Self::Full { until } => write!(f, "the batch system accepts no job until {} s", seconds(until)),
            Self::ReplyLost => f.write_str("the reply to the next submission will be lost"),
            Self::LateSubmission { delay } => write!(
                f,
                "a labeller will be killed during its next submission, which arrives {} s later",
                seconds(delay)
            ),
            Self::JobEnds { how } => write!(f, "a job ends as {}", ENDS[*how].0),
            Self::WaitingJobCancelled => f.write_str("a job that waits is cancelled"),
            Self::FilesLate { until } => {
                write!(f, "files of nodes are seen late until {} s", seconds(until))
            }
            Self::DirectoryRemoved => f.write_str("the directory of a calculation is removed"),
            Self::KilledInRemoval => {
                f.write_str("the next labeller that removes a directory will be killed meanwhile")
            }
        }
    }
}
