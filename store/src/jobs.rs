//! Views of the label queue and of labels.

use std::fmt;

use serde::Serialize;

use crate::database::{FromRow, SqlRow, from_columns};
use crate::error::Result;
use crate::exclude::Exclusion;
use crate::records::{JobState, Label};

/// The running label attempt that started first.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OldestLease {
    /// Id of its job.
    pub job: i64,
    /// The labeller that makes it.
    pub holder: String,
    /// When it started, ms since 1970.
    pub started: i64,
}

from_columns!(OldestLease { job, holder, started });

/// What the store did with a delivered result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CompleteOutcome {
    /// It became the label.
    Label,
    /// There was a label already: the result is stored as a check.
    KeptAsCheck,
}

/// What happened to a job whose attempt failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailOutcome {
    /// It waits for another attempt.
    Requeued,
    /// It has no attempts left.
    Failed,
    /// The lease had been lost before: this attempt no longer decides about the job.
    LeaseLost,
}

/// State of a lease that may have been lost.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LeaseStatus {
    /// The lease is still held.
    Held,
    /// Another holder has leased the job.
    LeasedAgain {
        /// The calculation that the other holder waits for, if it has started or found one.
        calculation: Option<String>,
    },
    /// The job waits in the queue.
    Queued,
    /// The job is labelled, failed or dropped: its result is no longer needed.
    Over,
}

/// The store's record of an attempt's calculation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PastCalculation {
    /// Identifies the calculation.
    pub calculation: Option<String>,
    /// The calculation failed.
    pub failed: bool,
    /// Its result may still be read.
    pub wanted: bool,
}

/// The packed work directory of a calculation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CalculationArchive {
    /// Attempt number.
    pub attempt: u32,
    /// A tar file, compressed with zstd.
    pub bytes: Vec<u8>,
    /// Files left out of it, with their sizes, one per line.
    pub left_out: String,
}

/// Number of imported frames, by what became of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ImportCounts {
    /// Labels.
    pub labels: usize,
    /// Different results for structures that have a label: stored as checks.
    pub checks: usize,
    /// Results that were there already, identical.
    pub known: usize,
}

/// Number of structures that were to be queued, by what became of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct QueuedImports {
    /// New label jobs.
    pub queued: usize,
    /// Structures that have a label or a label job already.
    pub known: usize,
}

/// An entry of the queue.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct QueueEntry {
    /// Id of the job.
    pub job: i64,
    /// Name of the candidate, or `import-N`.
    pub candidate: String,
    /// Name of the protocol.
    pub protocol: String,
    /// Its state.
    pub state: JobState,
    /// Higher first.
    pub priority: i32,
    /// The labeller that holds its lease.
    pub holder: Option<String>,
    /// When the lease expires, ms since 1970.
    pub expires: Option<i64>,
    /// Attempts started.
    pub attempts: u32,
    /// Attempts that failed since the job was last requeued by hand.
    pub failures: u32,
    /// Number of atoms.
    pub atoms: u32,
    /// Formula.
    pub formula: String,
    /// Largest γ under the selector's mixture at the decision, before the update.
    pub selector_gamma: Option<f64>,
    /// Largest γ under the original mixture.
    pub original_gamma: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub original_gamma_nbr: Option<f64>,
    /// `biased`, `control` or `imported`.
    pub origin: String,
    /// Name of the seed structure; empty if it was imported.
    pub seed_structure: String,
    /// The walk that found it; 0 if it was imported.
    pub walk: u32,
    /// Step of the walk, equilibration included.
    pub step: u64,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// The job was requeued by hand: guards let it pass.
    pub overruled: bool,
    /// Why a new label was requested although there is one; cleared when it arrives.
    pub relabel: Option<String>,
    /// What its label is worth; `None` in a queue in the order in which structures were found.
    pub value: Option<f64>,
    /// The factors of the value, a JSON object.
    pub value_factors: Option<serde_json::Value>,
    /// Why its label is excluded from the data set; `None` if it is not.
    pub excluded: Option<String>,
}

impl Attempt {
    /// Whether it ended with a result.
    pub fn made_label(&self) -> bool {
        matches!(self.outcome.as_deref(), Some("labelled" | "check"))
    }
}

/// An attempt at a job.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Attempt {
    /// Attempt number, from 1.
    pub attempt: u32,
    /// The labeller that made it.
    pub holder: String,
    /// Identifies the calculation (process, id in a batch system).
    pub calculation: Option<String>,
    /// When it started, ms since 1970.
    pub started: i64,
    /// When it ended.
    pub ended: Option<i64>,
    /// `labelled`, `check`, `failed`, `expired`, `released`, `lost`, `dropped`, `overtaken`; `None` while it runs.
    pub outcome: Option<String>,
    /// Failure class; `lost_too_often` for the loss after which the job failed.
    pub class: Option<String>,
    /// Why it failed, and the end of the program's output.
    pub log: Option<String>,
    /// Its calculation, if another program made it.
    #[serde(flatten)]
    pub made: CalculationRecord,
    /// Core-seconds of its calculation, once that has ended. Without them the duration of the attempt counts.
    pub core_seconds: Option<f64>,
}

/// What is known of a calculation before it starts.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CalculationRecord {
    /// Cores.
    pub cores: Option<u32>,
    /// Adjustments made because of earlier failures: names separated by commas.
    pub remedies: Option<String>,
    /// The changes of its input that they caused: lines with `-` and `+`.
    pub difference: Option<String>,
    /// Number of atoms.
    pub atoms: Option<u32>,
    /// Number of electrons that the program treats.
    pub electrons: Option<f64>,
    /// Number of k-points.
    pub k_points: Option<u32>,
}

impl FromRow for Attempt {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self {
            attempt: row.get("attempt")?,
            holder: row.get("holder")?,
            calculation: row.get("calculation")?,
            started: row.get("started")?,
            ended: row.get("ended")?,
            outcome: row.get("outcome")?,
            class: row.get("class")?,
            log: row.get("log")?,
            made: CalculationRecord {
                cores: row.get_or_default("cores")?,
                remedies: row.get_or_default("remedies")?,
                difference: row.get_or_default("difference")?,
                atoms: row.get_or_default("atoms")?,
                electrons: row.get_or_default("electrons")?,
                k_points: row.get_or_default("k_points")?,
            },
            core_seconds: row.get_or_default("core_seconds")?,
        })
    }
}

/// A job with its attempts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct JobDetails {
    /// The job.
    #[serde(flatten)]
    pub job: QueueEntry,
    /// Every attempt, oldest first.
    pub attempts_made: Vec<Attempt>,
    /// Energies of its structure's labels and checks, oldest first, eV.
    pub energies: Vec<(LabelStatus, f64)>,
    /// Names of the retry adjustments with which each of them was computed.
    pub retry_adjustments: Vec<Vec<String>>,
}

/// Status of a stored result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LabelStatus {
    /// The label.
    Label,
    /// A further result, kept for comparison.
    Check,
    /// The label until a requested new label, or a lower state, replaced it.
    Superseded,
    /// Taken out of the data set by hand; otherwise it would be the label.
    Excluded,
}

impl LabelStatus {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Label => "label",
            Self::Check => "check",
            Self::Superseded => "superseded",
            Self::Excluded => "excluded",
        }
    }

    pub(crate) fn named(name: &str) -> Option<Self> {
        [Self::Label, Self::Check, Self::Superseded, Self::Excluded]
            .into_iter()
            .find(|status| status.name() == name)
    }
}

/// Origin of a label.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LabelSource {
    /// A calculation of this campaign.
    Attempt {
        /// Id of the job.
        job: i64,
        /// Attempt number.
        attempt: u32,
    },
    /// A file.
    Import {
        /// Its name.
        file: String,
        /// The frame in it, from 0.
        frame: u64,
    },
}

impl fmt::Display for LabelSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Attempt { job, attempt } => write!(f, "attempt {attempt} of job {job}"),
            Self::Import { file, frame } => write!(f, "{file}, frame {frame}"),
        }
    }
}

/// A label with its history.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelRecord {
    /// Its status.
    pub status: LabelStatus,
    /// Energy, forces, stress and details.
    pub label: Label,
    /// Its origin.
    pub source: LabelSource,
    /// When it was stored, ms since 1970.
    pub received: i64,
    /// When and why another label replaced it.
    pub superseded: Option<Supersession>,
    /// When and why it was excluded from the data set.
    pub excluded: Option<Exclusion>,
}

/// How a label was superseded.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Supersession {
    /// When another label replaced it, ms since 1970.
    pub time: i64,
    /// Why: as the new label was requested, or that it is of a lower state.
    pub reason: String,
}
