//! What goes into the store and comes out of it.

use std::fmt;

use atoms::cell::norm;
use atoms::{Matrix3, Structure, Vec3};
use serde::{Deserialize, Serialize};
use wire::messages::{DeclineReason, Progress};
use wire::{CampaignId, CandidateBlock, CandidateId, ContentHash, Origin, WalkId};

/// What a campaign is, as written when it is begun.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Campaign {
    /// Its id.
    pub id: CampaignId,
    /// Version of the program that began it.
    pub program_version: String,
    /// `reproducible` or `live`.
    pub mode: String,
    /// The text of the configuration with which it was begun.
    pub configuration: String,
    /// The same with every default filled in, JSON.
    pub resolved_configuration: String,
    /// The configuration by which it runs now: it may differ in what does not change the campaign.
    pub configuration_in_force: String,
}

/// Where walks start.
#[derive(Clone, Debug, PartialEq)]
pub struct SeedStructure {
    /// Its number in the campaign, from 0.
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

/// What became of a candidate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// In the data set, with a label job.
    Accepted,
    /// Not taken.
    Declined(DeclineReason),
}

impl Fate {
    /// `accepted`, or why not.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Declined(reason) => reason.name(),
        }
    }
}

/// A candidate with what the selector found. The walker's own grades are in the block.
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
    /// Whether the feature vectors are to be kept (declined ones have a byte budget).
    pub keep_features: bool,
    /// Priority of the label job, if accepted: higher first.
    pub priority: i32,
}

/// A candidate as it comes out of the store again.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredCandidate {
    /// Number of the decision about it.
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
    /// Features, [n × D], if they were kept.
    pub features: Option<Vec<f64>>,
}

/// One entry of the decision log. Holds nothing that differs between two runs of the same campaign: no time, no
/// process, no host.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// Round (reproducible mode) or 0.
    pub round: u64,
    /// `accepted`, `declined`, `control`, `segment` (a return to a checkpoint), `ended`, `begun`, `resumed`, `imported`,
    /// `configuration`.
    pub kind: &'static str,
    /// The walk, if it is about one.
    pub walk: Option<WalkId>,
    /// The candidate, if it is about one.
    pub candidate: Option<CandidateId>,
    /// Version of the mixture after it.
    pub mixture_version: u64,
    /// The numbers behind it, a JSON object with keys in a fixed order.
    pub detail: serde_json::Value,
}

/// A line of the decision log, as stored.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedDecision {
    /// Its number, from 1, without gaps.
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

/// A line of the operations log.
#[derive(Clone, Debug, PartialEq)]
pub struct Operation {
    /// Its number.
    pub number: i64,
    /// ms since 1970.
    pub time: i64,
    /// What happened.
    pub kind: String,
    /// More of it, a JSON object.
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
    /// Number of the decision, 0 before the first.
    pub decision: i64,
    /// Version of the mixture after it.
    pub version: u64,
    /// The components that ever changed (since the mixture last began anew), by element and slot.
    pub components: Vec<ComponentRecord>,
}

/// How a walk stands, as the store keeps it.
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
    /// `waiting`, `running`, or the name of its [`wire::messages::End`].
    pub state: String,
    /// Why it ended, in words; empty while it runs.
    pub reason: String,
    /// Turns done.
    pub turn: u64,
    /// Structures accepted from it.
    pub accepted: u32,
    /// Where it stands.
    pub progress: Progress,
    /// The selector's own memory of the walk (verdict still to be delivered, wanted steps …), JSON.
    pub selector_state: String,
    /// The walker's checkpoint; `None` before the first turn.
    pub checkpoint: Option<Vec<u8>>,
}

/// What is committed in one transaction, and only then answered.
#[derive(Clone, Debug, Default)]
pub struct Commit {
    /// In decision order.
    pub decisions: Vec<Decision>,
    /// Candidates that the decisions are about, in the same order.
    pub candidates: Vec<CandidateRecord>,
    /// Components that changed, newest last.
    pub components: Vec<ComponentRecord>,
    /// The whole mixture begins anew (update protocol "restarted"): stored components are dropped first.
    pub restart_mixture: bool,
    /// Walks that moved.
    pub walks: Vec<WalkRecord>,
    /// Small named values of the selector (round, mixture version, byte budget used …).
    pub values: Vec<(String, String)>,
}

/// A label: what a reference calculation gives for a structure.
#[derive(Clone, Debug, PartialEq)]
pub struct Label {
    /// Energy, eV (the free energy where there is smearing).
    pub energy: f64,
    /// Forces, [n], eV/Å.
    pub forces: Vec<Vec3>,
    /// Stress, eV/Å³, tension positive; none for a cluster or where the source gives none.
    pub stress: Option<Matrix3>,
    /// What else the calculation says.
    pub details: LabelDetails,
}

impl Label {
    /// Largest force on an atom, eV/Å; 0 without atoms.
    pub fn max_force(&self) -> f64 {
        self.forces.iter().map(|force| norm(*force)).fold(0.0, f64::max)
    }
}

/// What is known of a label besides its numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LabelDetails {
    /// The energy extrapolated to no smearing, eV.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub energy_without_smearing: Option<f64>,
    /// Magnetic moment of each atom, [n], μ_B.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub magnetic_moments: Option<Vec<f64>>,
    /// Magnetic moment of the cell, μ_B.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub magnetisation: Option<f64>,
    /// Electronic steps that it took.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub electronic_steps: Option<u32>,
}

/// The settings that make labels comparable, and their hash.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Protocol {
    /// BLAKE3 of everything that changes a label's value, 64 hexadecimal digits.
    pub hash: ContentHash,
    /// Short name, unique in a campaign.
    pub name: String,
    /// The settings, for people (JSON).
    pub settings: serde_json::Value,
}

/// A leased label job.
#[derive(Clone, Debug)]
pub struct Lease {
    /// Number of the job.
    pub job: i64,
    /// Number of this attempt, from 1.
    pub attempt: u32,
    /// Whose lease it is.
    pub holder: String,
    /// The protocol by which to label.
    pub protocol: ContentHash,
    /// What the last attempts said of their own calculations ([`crate::Store::record_calculation`]), newest first, as far
    /// back as they ended without a result: look there before starting another.
    pub earlier_calculations: Vec<String>,
    /// Classes of the attempts that failed since the job was last put into the queue by hand, and of those that were lost
    /// with a class, oldest first.
    pub failures: Vec<String>,
    /// What the attempts that failed said of their own calculations, in the end.
    pub failed_calculations: Vec<String>,
    /// Somebody has put the job into the queue by hand: guards let it pass.
    pub overruled: bool,
    /// The structure to label.
    pub structure: Structure,
    /// Its candidate's name.
    pub candidate: String,
    /// Its energy by the potential, eV, if that is a finite number.
    pub model_energy: Option<f64>,
}

/// State of a label job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waits for a labeller.
    Queued,
    /// A labeller holds it.
    Leased,
    /// Done.
    Labelled,
    /// Given up after the allowed attempts.
    Failed,
    /// Taken out by hand.
    Dropped,
    /// A job of another protocol is in its place.
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

    /// The state of that name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.name() == name)
    }
}

impl fmt::Display for JobState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
