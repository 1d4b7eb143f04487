//! Records that are written to the store and read from it.

use std::fmt;

use atoms::cell::norm;
use atoms::{Matrix3, Structure, Vec3};
use serde::{Deserialize, Serialize};
use wire::messages::{AssignmentStart, DeclineReason, PathPosition, WalkProgress};
use wire::{
    CampaignId, CandidateBlock, CandidateId, ContentHash, Origin, TracePoint, WalkConditions, WalkFrame,
    WalkId,
};

/// Name of the value with the grades of the training frames under the newest mixture (JSON of
/// `calm::forgetting::GradeDistribution`, with `alarm`).
pub const TRAINING_FRAMES: &str = "training_frames";
/// Name of the value with the histogram of mixture ages at decisions (JSON of `calm::Staleness`).
pub const STALENESS: &str = "staleness";
/// Name of the value with the number of candidates that could not be graded or were control frames with atoms too close.
pub const LEFT_OUT: &str = "left_out";

/// Properties of a campaign, written when it is created.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CampaignRecord {
    /// Its id.
    pub id: CampaignId,
    /// Version of the program that created it.
    pub program_version: String,
    /// `reproducible` or `live`.
    pub mode: String,
    /// The text of the configuration with which it was created.
    pub configuration: String,
    /// The same configuration with every default filled in, JSON.
    pub resolved_configuration: String,
    /// The configuration now in force. It may differ from the original one in settings that do not change the
    /// campaign.
    pub configuration_in_force: String,
}

/// A candidate, by decision and name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct CandidateRef {
    /// Sequence number of the decision on it.
    pub decision: i64,
    /// Its name.
    pub candidate: String,
}

/// A structure where walks start.
#[derive(Clone, Debug, PartialEq)]
pub struct SeedStructure {
    /// Its index in the campaign, from 0.
    pub index: u32,
    /// Its name.
    pub name: String,
    /// The file it came from.
    pub source: String,
    /// The structure.
    pub structure: Structure,
}

/// γ and γ_nbr of every atom under one mixture, [n] each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AtomGrades {
    /// Extrapolation grade.
    pub gamma: Vec<f64>,
    /// Its neighbourhood average.
    pub gamma_nbr: Vec<f64>,
}

/// The decision on a candidate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// In the data set, with a label job.
    Accepted,
    /// Not in the data set.
    Declined(DeclineReason),
}

impl Fate {
    /// `accepted`, or the reason of the decline.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Declined(reason) => reason.name(),
        }
    }
}

/// A candidate with the selector's grades. The walker's own grades are in the block.
#[derive(Clone, Debug)]
pub struct CandidateRecord {
    /// The block as the walker sent it.
    pub block: CandidateBlock,
    /// Accepted or declined.
    pub fate: Fate,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Under the selector's mixture, before the update.
    pub selector: AtomGrades,
    /// Under the original mixture.
    pub original: AtomGrades,
    /// Whether to store the feature vectors (those of declined candidates have a byte budget).
    pub keep_features: bool,
    /// Priority of the label job, if accepted: higher first.
    pub priority: i32,
}

/// A candidate as read from the store.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredCandidate {
    /// Sequence number of the decision on it.
    pub decision: i64,
    /// The block without features.
    pub block: CandidateBlock,
    /// Accepted or declined.
    pub fate: Fate,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Under the selector's mixture, before the update.
    pub selector: AtomGrades,
    /// Under the original mixture.
    pub original: AtomGrades,
    /// Features, [n × D], if they were stored.
    pub features: Option<Vec<f64>>,
}

/// An entry of the decision log. It holds nothing that differs between two runs of the same campaign: no time,
/// process or host.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// Round (reproducible mode) or 0.
    pub round: u64,
    /// `accepted`, `declined`, `control`, `segment` (a roll back to a checkpoint), `ended`, `begun`, `resumed`,
    /// `imported`, `configuration`.
    pub kind: &'static str,
    /// The walk, if the decision concerns one.
    pub walk: Option<WalkId>,
    /// The candidate, if the decision concerns one.
    pub candidate: Option<CandidateId>,
    /// Version of the mixture after the decision.
    pub mixture_version: u64,
    /// The numbers on which it rests, a JSON object with keys in a fixed order.
    pub detail: serde_json::Value,
}

/// An entry of the decision log, as stored.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedDecision {
    /// Sequence number, from 1, without gaps.
    pub sequence: i64,
    /// See [`Decision`].
    pub round: u64,
    /// See [`Decision`].
    pub kind: String,
    /// See [`Decision`].
    pub walk: Option<u32>,
    /// Name of the candidate.
    pub candidate: Option<String>,
    /// See [`Decision`].
    pub mixture_version: u64,
    /// See [`Decision`].
    pub detail: serde_json::Value,
}

/// An entry of the operations log.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedOperation {
    /// Its number.
    pub number: i64,
    /// ms since 1970.
    pub time: i64,
    /// What happened.
    pub kind: String,
    /// Details, a JSON object.
    pub detail: serde_json::Value,
}

/// A component of the mixture that changed.
#[derive(Clone, Debug, PartialEq)]
pub struct ComponentRecord {
    /// Element index.
    pub element: u32,
    /// Slot of the component.
    pub slot: u32,
    /// Encoded component.
    pub bytes: Vec<u8>,
}

/// The mixture after a decision.
#[derive(Clone, Debug, PartialEq)]
pub struct NewestMixture {
    /// Sequence number of the decision, 0 before the first.
    pub decision: i64,
    /// Version of the mixture after it.
    pub version: u64,
    /// Every component that has changed since the mixture was last restarted, by element and slot.
    pub components: Vec<ComponentRecord>,
}

/// The state of a walk.
#[derive(Clone, Debug, PartialEq)]
pub struct WalkRecord {
    /// The walk.
    pub walk: WalkId,
    /// Biased or control.
    pub origin: Origin,
    /// The biased walk that a control matches.
    pub partner: Option<WalkId>,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Its conditions; those of the default in campaigns of early versions.
    pub conditions: WalkConditions,
    /// `waiting`, `running`, or the name of its [`wire::messages::WalkEnd`].
    pub state: String,
    /// Why it ended, as text; empty while it runs.
    pub reason: String,
    /// Number of its assignments that were reported.
    pub assignments: u64,
    /// Structures accepted from it.
    pub accepted: u32,
    /// Its progress.
    pub progress: WalkProgress,
    /// The selector's own state of the walk (undelivered decision, requested steps …), JSON.
    pub selector_state: String,
    /// The walker's checkpoint; `None` before the first assignment.
    pub checkpoint: Option<Vec<u8>>,
}

/// Whether a walk in this state has more steps to make.
pub(crate) fn is_active_state(state: &str) -> bool {
    matches!(state, "waiting" | "running")
}

impl WalkRecord {
    /// Whether it has more steps to make.
    pub fn is_active(&self) -> bool {
        is_active_state(&self.state)
    }
}

/// Everything that one transaction commits before the walkers get their replies.
#[derive(Clone, Debug, Default)]
pub struct Commit {
    /// In decision order.
    pub decisions: Vec<Decision>,
    /// The candidates that the decisions concern, in the same order.
    pub candidates: Vec<CandidateRecord>,
    /// Components that changed, newest last.
    pub components: Vec<ComponentRecord>,
    /// Restart the whole mixture (update protocol "per_seed_structure"): stored components are deleted first.
    pub restart_mixture: bool,
    /// Walks whose state changed.
    pub walks: Vec<WalkRecord>,
    /// Small named values of the selector (round, mixture version, used byte budget, [`TRAINING_FRAMES`] …).
    pub values: Vec<(String, String)>,
    /// New points of walks' traces, in order; a walk may have several entries.
    pub traces: Vec<(WalkId, Vec<TracePoint>)>,
    /// Assignments of walks, in order.
    pub assignments: Vec<AssignmentRecord>,
    /// The frames of these assignments.
    pub trajectories: Vec<TrajectoryPart>,
}

/// An assignment of a walk, or a part of one that was interrupted: with it, the walk can be run again.
#[derive(Clone, Debug, PartialEq)]
pub struct AssignmentRecord {
    /// The walk.
    pub walk: WalkId,
    /// Number of this record in the walk, from 0.
    pub part: u64,
    /// Number of the assignment. Parts of one that was interrupted have the same.
    pub number: u64,
    /// With what it began.
    pub start: AssignmentStart,
    /// Where it ended.
    pub end: PathPosition,
}

/// The frames of a walk's trajectory in an assignment, or in a part of one.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryPart {
    /// The walk.
    pub walk: WalkId,
    /// [`AssignmentRecord::part`].
    pub part: u64,
    /// In order.
    pub frames: Vec<WalkFrame>,
}

/// A label: the result of a reference calculation for a structure.
#[derive(Clone, Debug, PartialEq)]
pub struct Label {
    /// Energy, eV (the free energy if the calculation uses smearing).
    pub energy: f64,
    /// Forces, [n], eV/Å.
    pub forces: Vec<Vec3>,
    /// Stress, eV/Å³, tension positive; `None` for a cluster or if the source gives none.
    pub stress: Option<Matrix3>,
    /// Further results of the calculation.
    pub details: LabelDetails,
}

impl Label {
    /// Largest force on an atom, eV/Å; 0 without atoms.
    pub fn max_force(&self) -> f64 {
        self.forces.iter().map(|force| norm(*force)).fold(0.0, f64::max)
    }
}

/// Name of the retry adjustment that starts a calculation from other magnetic moments.
pub const OTHER_MOMENTS: &str = "other_moments";

/// Results of a label besides energy, forces and stress, and how its calculation was adjusted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LabelDetails {
    /// The energy extrapolated to zero smearing, eV.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub energy_without_smearing: Option<f64>,
    /// Magnetic moment of each atom, [n], μ_B.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub magnetic_moments: Option<Vec<f64>>,
    /// Magnetic moment of the cell, μ_B.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub magnetisation: Option<f64>,
    /// Number of electronic (SCF) steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub electronic_steps: Option<u32>,
    /// Names of the retry adjustments with which its calculation ran, because earlier ones had failed. Empty for imported
    /// labels and for those of early versions.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub retry_adjustments: Vec<String>,
    /// Whether the queue chose its structure by value (`label.order`), not in the order in which structures were found.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub ordered_by_value: bool,
}

impl LabelDetails {
    /// Whether the calculation started from other magnetic moments than the protocol's, and may therefore have found
    /// another magnetic state.
    pub fn has_changed_moments(&self) -> bool {
        self.retry_adjustments.iter().any(|name| name == OTHER_MOMENTS)
    }
}

/// The settings that make labels comparable, and their hash.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Protocol {
    /// BLAKE3 of everything that changes a label's value, 64 hexadecimal digits.
    pub hash: ContentHash,
    /// Short name, unique in a campaign.
    pub name: String,
    /// The settings in readable form (JSON).
    pub settings: serde_json::Value,
}

/// A leased label job.
#[derive(Clone, Debug)]
pub struct Lease {
    /// Id of the job.
    pub job: i64,
    /// Number of this attempt, from 1.
    pub attempt: u32,
    /// The holder of the lease.
    pub holder: String,
    /// The protocol to label with.
    pub protocol: ContentHash,
    /// Calculations that earlier attempts recorded ([`crate::Store::record_calculation`]), newest first, back to
    /// the last attempt that ended with a result. Look for them before starting another calculation.
    pub earlier_calculations: Vec<String>,
    /// Failure classes of the attempts that failed since the job was last requeued by hand, and of lost attempts
    /// that have a class, oldest first.
    pub failures: Vec<String>,
    /// The last records of the calculations of failed attempts.
    pub failed_calculations: Vec<String>,
    /// The job was requeued by hand: guards let it pass.
    pub overruled: bool,
    /// The queue chose it by value ([`crate::Store::set_label_values`]).
    pub ordered_by_value: bool,
    /// The structure to label.
    pub structure: Structure,
    /// Name of its candidate.
    pub candidate: String,
    /// Its energy by the potential, eV, if it is finite.
    pub model_energy: Option<f64>,
}

/// State of a label job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waiting for a labeller.
    Queued,
    /// Held by a labeller.
    Leased,
    /// Its label is there.
    Labelled,
    /// Failed in all allowed attempts.
    Failed,
    /// Removed by hand.
    Dropped,
    /// Replaced by a job of another protocol.
    Superseded,
}

impl JobState {
    /// Every state, in the order of a job's life.
    pub const ALL: [Self; 6] =
        [Self::Queued, Self::Leased, Self::Labelled, Self::Failed, Self::Dropped, Self::Superseded];

    /// `"queued"`, `"leased"`, `"labelled"`, `"failed"`, `"dropped"`, `"superseded"`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Leased => "leased",
            Self::Labelled => "labelled",
            Self::Failed => "failed",
            Self::Dropped => "dropped",
            Self::Superseded => "superseded",
        }
    }

    /// The state with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.name() == name)
    }
}

impl fmt::Display for JobState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
