//! Control messages. Walkers are stateless between messages: an [`Assignment`] is all a walker needs to continue a
//! walk, and an [`AssignmentReport`] is the complete result. The same checkpoint gives the same report on any walker,
//! any number of times, which makes a campaign crash-only.

use std::cmp::Ordering;

use atoms::Structure;
use serde::{Deserialize, Serialize};

use crate::block::CandidateBlock;
use crate::conditions::WalkConditions;
use crate::ids::{CampaignId, Origin, WalkId};
use crate::walk_frame::WalkFrame;
use crate::walk_trace::TracePoint;

/// A piece of one walk, for any idle walker.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// Campaign, used in candidate ids.
    pub campaign: CampaignId,
    /// The walk.
    pub walk: WalkId,
    /// Number of this assignment within the walk, from 0. Reports with another number are stale.
    pub number: u64,
    /// Biased or control.
    pub origin: Origin,
    /// The walk whose random numbers are used: this walk, or the biased walk that a control walk matches.
    pub random_walk: WalkId,
    /// Starting structure.
    pub seed_structure: Structure,
    /// Temperature, τ and volume ramp.
    pub conditions: WalkConditions,
    /// The walker's checkpoint of the walk; `None` at the start.
    #[serde(with = "crate::bytes::optional")]
    pub checkpoint: Option<Vec<u8>>,
    /// The decision on the candidate that ended the previous assignment.
    pub verdict: Option<Verdict>,
    /// Last step of this assignment.
    pub last_step: u64,
    /// Control walks: steps whose frames are collected, ascending. Empty for biased walks.
    pub frame_steps: Vec<u64>,
    /// Factor on the threshold of the collection rule: 1, or larger while many structures wait for labels.
    pub threshold_factor: f64,
}

/// The decision on a candidate, as the walker receives it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Added to the data set; the updated mixture covers it.
    Accepted,
    /// Rejected, with the reason.
    Declined(DeclineReason),
}

/// Why a candidate was declined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeclineReason {
    /// The newest mixture covers it: another walk found a similar structure first.
    Covered,
    /// An identical structure is already known.
    Duplicate,
    /// The selector's guard: atoms are too close.
    TooClose,
    /// The seed structure or the campaign has reached its maximum number of structures.
    Budget,
    /// The grade is below the threshold, which was raised because many structures wait for labels.
    Backlog,
    /// The calculation of its label would probably fail.
    UnlikelyToComplete,
    /// It cannot be graded, or the mixture cannot be updated with it, or it is a control frame with atoms too close.
    LeftOut,
    /// Its grade under the original mixture is above the bound of the guard.
    GradeTooLarge,
}

impl DeclineReason {
    /// All reasons, in the order of summaries.
    pub const ALL: [Self; 8] = [
        Self::Covered,
        Self::Duplicate,
        Self::TooClose,
        Self::Budget,
        Self::Backlog,
        Self::UnlikelyToComplete,
        Self::GradeTooLarge,
        Self::LeftOut,
    ];

    /// The serialized name: `"covered"`, `"duplicate"`, `"too_close"`, `"budget"`, `"backlog"`, `"unlikely_to_complete"`,
    /// `"grade_too_large"` or `"left_out"`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Covered => "covered",
            Self::Duplicate => "duplicate",
            Self::TooClose => "too_close",
            Self::Budget => "budget",
            Self::Backlog => "backlog",
            Self::UnlikelyToComplete => "unlikely_to_complete",
            Self::LeftOut => "left_out",
            Self::GradeTooLarge => "grade_too_large",
        }
    }
}

impl Verdict {
    /// `"accepted"`, or the reason of the decline.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Declined(reason) => reason.name(),
        }
    }

    /// The verdict with this name.
    pub fn named(name: &str) -> Option<Self> {
        if name == Self::Accepted.name() {
            return Some(Self::Accepted);
        }
        DeclineReason::ALL.into_iter().find(|reason| reason.name() == name).map(Self::Declined)
    }
}

/// How an assignment ended. A walker holds its candidate as a [`crate::Candidate`]; the transport encodes it directly
/// into the memory where it is read, so the reactor receives a block.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome<C = CandidateBlock> {
    /// With a candidate (in a control walk: a requested frame).
    Candidate(C),
    /// All steps of the assignment are done.
    StepsDone,
    /// The process was asked to stop; the same assignment continues later.
    Interrupted,
    /// The walk has ended.
    Ended(WalkEnd),
}

/// Why a walk ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WalkEnd {
    /// All steps are done.
    Completed,
    /// The maximum number of structures of this walk, or of its seed structure, was collected.
    QuotaReached,
    /// The campaign has reached its maximum number of structures.
    Budget,
    /// It made room for a new version of the potential.
    Superseded,
    /// The biased walks together made their maximum number of steps without a new structure.
    NothingNew,
    /// It has collected enough and touches a boundary of its volume again and again.
    VolumeBoundary,
    /// A guard rejected it too often, after the allowed number of rollbacks.
    Trapped {
        /// Name of the guard.
        guard: String,
    },
    /// Non-finite forces, an unphysical temperature, or lost atoms.
    Diverged {
        /// Details.
        reason: String,
    },
    /// The walk cannot start from its seed structure.
    InvalidStart {
        /// Details.
        reason: String,
    },
}

impl WalkEnd {
    /// The serialized name: `"completed"`, `"quota_reached"`, `"budget"`, `"superseded"`, `"nothing_new"`, `"volume_boundary"`,
    /// `"trapped"`, `"diverged"` or `"invalid_start"`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Completed => "completed",
            Self::QuotaReached => "quota_reached",
            Self::Budget => "budget",
            Self::Superseded => "superseded",
            Self::NothingNew => "nothing_new",
            Self::VolumeBoundary => "volume_boundary",
            Self::Trapped { .. } => "trapped",
            Self::Diverged { .. } => "diverged",
            Self::InvalidStart { .. } => "invalid_start",
        }
    }
}

/// The result of an assignment.
#[derive(Clone, Debug, PartialEq)]
pub struct AssignmentReport<C = CandidateBlock> {
    /// The walk.
    pub walk: WalkId,
    /// Number of the assignment that this report answers.
    pub assignment: u64,
    /// With what it began; `None` if the walk made no step.
    pub start: Option<AssignmentStart>,
    /// How it ended.
    pub outcome: Outcome<C>,
    /// The walker's checkpoint of the walk, from which the next assignment continues.
    pub checkpoint: Vec<u8>,
    /// Current state of the walk.
    pub progress: WalkProgress,
    /// The points of the walk's trace since the last report, thinned ([`crate::thin`]).
    pub trace: Vec<TracePoint>,
    /// The frames of the walk's trajectory since the last report.
    pub frames: Vec<WalkFrame>,
}

impl<C> AssignmentReport<C> {
    /// Converts the candidate of the report.
    pub fn map_candidate<D>(self, form: impl FnOnce(C) -> D) -> AssignmentReport<D> {
        let outcome = match self.outcome {
            Outcome::Candidate(candidate) => Outcome::Candidate(form(candidate)),
            Outcome::StepsDone => Outcome::StepsDone,
            Outcome::Interrupted => Outcome::Interrupted,
            Outcome::Ended(end) => Outcome::Ended(end),
        };
        let Self { walk, assignment, start, checkpoint, progress, trace, frames, .. } = self;
        AssignmentReport { walk, assignment, start, outcome, checkpoint, progress, trace, frames }
    }
}

/// Current state of a walk. Walkers also send it while they work, for display.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WalkProgress {
    /// Step, including equilibration.
    pub step: u64,
    /// Segment.
    pub segment: u32,
    /// Current uncertainty-force scale τ.
    pub tau: f64,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// V / V₀.
    pub relative_volume: f64,
    /// Largest γ of the last graded step.
    pub gamma_max: f64,
    /// Number of rejections by the walker's guard.
    pub rejected: u64,
    /// Number of rollbacks.
    pub rollbacks: u32,
    /// Start and target step of the last rollback, for the decision log; not stored with the progress.
    pub last_rollback: Option<(u64, u64)>,
    /// Step of the reference run, as long as it lasts; not stored with the progress.
    pub reference_step: Option<u64>,
    /// V₀ of a walk at constant pressure from its first step on, Å³ (Å² for a slab, Å for a wire); another table has it.
    pub reference_volume: Option<f64>,
}

impl WalkProgress {
    /// Where the walk is.
    pub fn position(&self) -> PathPosition {
        let Self { segment, step, reference_step, .. } = *self;
        PathPosition { segment, step, reference_step }
    }
}

/// A place on the path of a walk. One that the walk comes to later is larger.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PathPosition {
    /// Segment.
    pub segment: u32,
    /// Step, including equilibration.
    pub step: u64,
    /// Step of the reference run, as long as it lasts.
    pub reference_step: Option<u64>,
}

impl Ord for PathPosition {
    fn cmp(&self, other: &Self) -> Ordering {
        let key = |at: &Self| (at.segment, at.reference_step.is_none(), at.reference_step, at.step);
        key(self).cmp(&key(other))
    }
}

impl PartialOrd for PathPosition {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// What a walker began an assignment with. The store keeps it, so that the walk can be run again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AssignmentStart {
    /// Where the walk was.
    pub position: PathPosition,
    /// Version of the walker's mixture.
    pub mixture_version: u64,
    /// [`Assignment::threshold_factor`].
    pub threshold_factor: f64,
    /// [`Assignment::verdict`].
    pub verdict: Option<Verdict>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn later_places_on_a_path_are_larger() {
        let at = |segment, reference_step, step| PathPosition { segment, step, reference_step };
        let path = [
            at(0, Some(0), 0),
            at(0, Some(3200), 0),
            at(0, None, 0),
            at(0, None, 150),
            // A roll back goes to an earlier step, in a new segment.
            at(1, None, 100),
            at(1, None, 101),
        ];
        assert!(path.windows(2).all(|pair| pair[0] < pair[1]));
    }

    #[test]
    fn verdicts_are_found_by_their_names() {
        let declined = DeclineReason::ALL.map(Verdict::Declined);
        for verdict in declined.into_iter().chain([Verdict::Accepted]) {
            assert_eq!(Verdict::named(verdict.name()), Some(verdict));
        }
        assert_eq!(Verdict::named("declined"), None);
    }
}
