//! Control messages. A walker holds nothing between two of them: an [`Assignment`] is all that it needs to
//! go on with a walk, a [`Report`] is all that came of it. The same checkpoint gives the same report,
//! whoever works on it and however often, which is what makes a campaign crash-only.

use atoms::Structure;
use serde::{Deserialize, Serialize};

use crate::block::CandidateBlock;
use crate::ids::{CampaignId, Origin, WalkId};

/// A turn of one walk, for whichever walker is free.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// Campaign, for the ids of candidates.
    pub campaign: CampaignId,
    /// The walk.
    pub walk: WalkId,
    /// Counts the turns of the walk; a report of another turn is out of date.
    pub number: u64,
    /// What kind of walk.
    pub origin: Origin,
    /// The walk whose random numbers it uses: itself, or the biased walk that a control matches.
    pub random_walk: WalkId,
    /// Where it starts.
    pub seed_structure: Structure,
    /// The walker's own state of the walk; none at the start of it.
    #[serde(with = "crate::bytes::optional")]
    pub checkpoint: Option<Vec<u8>>,
    /// What became of the candidate that its last turn ended with.
    pub verdict: Option<Verdict>,
    /// Stop at this step at the latest.
    pub last_step: u64,
    /// A control walk: the steps whose frames are wanted, ascending. Otherwise empty.
    pub frame_steps: Vec<u64>,
    /// Factor on the threshold of the collection rule: 1, or more while many structures wait for labels.
    pub threshold_factor: f64,
}

/// The answer to a candidate.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Taken into the data set; the mixture covers it from now on.
    Accepted,
    /// Not taken.
    Declined(DeclineReason),
}

/// Why a candidate is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeclineReason {
    /// The newest mixture covers it: another walk found its like meanwhile.
    Covered,
    /// The very same structure is known already.
    Duplicate,
    /// The selector's guard: atoms too close.
    Guard,
    /// The seed structure or the campaign has as many as it may have.
    Budget,
    /// So many structures wait for labels that the threshold was raised, above it.
    Backlog,
}

impl DeclineReason {
    /// Every reason, in the order of summaries.
    pub const ALL: [Self; 5] = [Self::Covered, Self::Duplicate, Self::Guard, Self::Budget, Self::Backlog];

    /// `"covered"`, `"duplicate"`, `"guard"`, `"budget"`, `"backlog"`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Covered => "covered",
            Self::Duplicate => "duplicate",
            Self::Guard => "guard",
            Self::Budget => "budget",
            Self::Backlog => "backlog",
        }
    }
}

/// How a turn ended. A walker gives its candidate as a [`crate::Candidate`], which the transport encodes where it is
/// to be read; it arrives as a block.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome<C = CandidateBlock> {
    /// With a candidate (or, in a control walk, a wanted frame).
    Candidate(C),
    /// At its last step.
    StepsDone,
    /// Before that, because the process was asked to stop: the same turn goes on later.
    Interrupted,
    /// The walk is over.
    Ended(WalkEnd),
}

/// Why a walk is over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WalkEnd {
    /// It made all its steps.
    Steps,
    /// Its seed structure has given as many structures as it may.
    Collected,
    /// The campaign has as many structures as it may have.
    Budget,
    /// A guard refused it too often, after the allowed number of returns to a checkpoint.
    Trapped {
        /// The guard.
        guard: String,
    },
    /// Non-finite forces, an absurd temperature, lost atoms.
    BlewUp {
        /// What was seen.
        reason: String,
    },
    /// The seed structure itself cannot be walked from.
    BadStart {
        /// What was seen.
        reason: String,
    },
}

impl WalkEnd {
    /// `"steps"`, `"collected"`, `"budget"`, `"trapped"`, `"blew_up"`, `"bad_start"`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Steps => "steps",
            Self::Collected => "collected",
            Self::Budget => "budget",
            Self::Trapped { .. } => "trapped",
            Self::BlewUp { .. } => "blew_up",
            Self::BadStart { .. } => "bad_start",
        }
    }
}

/// What came of a turn.
#[derive(Clone, Debug, PartialEq)]
pub struct Report<C = CandidateBlock> {
    /// The walk.
    pub walk: WalkId,
    /// The turn it answers.
    pub assignment: u64,
    /// How it ended.
    pub outcome: Outcome<C>,
    /// The walker's state of the walk from which the next turn goes on.
    pub checkpoint: Vec<u8>,
    /// Where the walk stands.
    pub progress: Progress,
}

impl<C> Report<C> {
    /// The same report with its candidate in another form.
    pub fn map_candidate<D>(self, form: impl FnOnce(C) -> D) -> Report<D> {
        let outcome = match self.outcome {
            Outcome::Candidate(candidate) => Outcome::Candidate(form(candidate)),
            Outcome::StepsDone => Outcome::StepsDone,
            Outcome::Interrupted => Outcome::Interrupted,
            Outcome::Ended(end) => Outcome::Ended(end),
        };
        let Self { walk, assignment, checkpoint, progress, .. } = self;
        Report { walk, assignment, outcome, checkpoint, progress }
    }
}

/// Where a walk stands; also sent while a turn lasts, for those who watch.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Step, equilibration included.
    pub step: u64,
    /// Segment.
    pub segment: u32,
    /// Uncertainty-force scale τ in force.
    pub tau: f64,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// V / V₀.
    pub relative_volume: f64,
    /// Largest γ of the last graded step.
    pub gamma_max: f64,
    /// Refusals by the walker's own guard so far.
    pub refused: u64,
    /// Returns to a checkpoint so far.
    pub returns: u32,
    /// The steps from which and to which it last returned, for the decision log; not stored beside it.
    pub last_return: Option<(u64, u64)>,
}
