//! The label queue and its labels, as they are shown.

use serde::Serialize;

use crate::database::{FromRow, Row, from_columns};
use crate::error::Result;
use crate::exclude::Exclusion;
use crate::records::{JobState, Label};

/// The label attempt under way that began first.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OldestLease {
    /// Number of its job.
    pub job: i64,
    /// Who makes it.
    pub holder: String,
    /// When it began, ms since 1970.
    pub started: i64,
}

from_columns!(OldestLease { job, holder, started });

/// What became of a result that was brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CompleteOutcome {
    /// It is the label.
    Label,
    /// There was a label already: it is kept beside it.
    KeptAsCheck,
}

/// What became of a job whose attempt failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailOutcome {
    /// It waits for another attempt.
    Requeued,
    /// It has used up its attempts.
    GivenUp,
    /// The lease was lost before: what became of the job was decided without this attempt.
    LeaseLost,
}

/// What has become of a job whose lease was lost.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LeaseStatus {
    /// The lease still lasts.
    Held,
    /// Somebody else has leased it.
    LeasedAgain {
        /// The calculation that they wait for, if they have started or found one.
        calculation: Option<String>,
    },
    /// It waits for somebody.
    Queued,
    /// It has its label, was given up or dropped: nobody waits for a result.
    Over,
}

/// A calculation of an attempt, as far as the store knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PastCalculation {
    /// What finds it again.
    pub calculation: Option<String>,
    /// It was a failure.
    pub failed: bool,
    /// Somebody may still read what it gives.
    pub wanted: bool,
}

/// The packed directory of a calculation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Archive {
    /// Number of the attempt.
    pub attempt: u32,
    /// A tar file, compressed with zstd.
    pub bytes: Vec<u8>,
    /// Files that are not in it, with their sizes, a line each.
    pub left_out: String,
}

/// How many of the frames of an import became what.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ImportCounts {
    /// Labels.
    pub labels: usize,
    /// Other numbers for structures that have a label: kept beside it.
    pub checks: usize,
    /// The very same numbers were there.
    pub known: usize,
}

/// A line of the queue.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Job {
    /// Number of the job.
    pub job: i64,
    /// Name of the candidate.
    pub candidate: String,
    /// Name of the protocol.
    pub protocol: String,
    /// Its state.
    pub state: JobState,
    /// Higher first.
    pub priority: i32,
    /// Who labels it now.
    pub holder: Option<String>,
    /// When the lease ends, ms since 1970.
    pub expires: Option<i64>,
    /// Attempts begun.
    pub attempts: u32,
    /// Those that failed since the job was last put into the queue by hand.
    pub failures: u32,
    /// Number of atoms.
    pub atoms: u32,
    /// Formula.
    pub formula: String,
    /// Largest γ under the original mixture.
    pub original_gamma: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub original_gamma_nbr: Option<f64>,
    /// `biased` or `control`.
    pub origin: String,
    /// Name of the seed structure.
    pub seed_structure: String,
    /// The walk that found it.
    pub walk: u32,
    /// Step of the walk, equilibration included.
    pub step: u64,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// Somebody has put it into the queue by hand: guards let it pass.
    pub overruled: bool,
    /// Why another label was asked for in the place of the one that there is, until it has come.
    pub relabel: Option<String>,
    /// Why its label is excluded from the data set; none if it is not.
    pub excluded: Option<String>,
}

/// An attempt at a job.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Attempt {
    /// Its number, from 1.
    pub attempt: u32,
    /// Who made it.
    pub holder: String,
    /// What finds the calculation again (process group, number in a batch system).
    pub calculation: Option<String>,
    /// When it started, ms since 1970.
    pub started: i64,
    /// When it ended.
    pub ended: Option<i64>,
    /// `labelled`, `check`, `failed`, `expired`, `released`, `lost`, `dropped`, `overtaken`; none while it lasts.
    pub outcome: Option<String>,
    /// Class of a failure; `lost_too_often` with the loss after which the job was given up.
    pub class: Option<String>,
    /// Why it failed, and the end of what its program said.
    pub log: Option<String>,
    /// What its calculation was, if it was one of another program.
    #[serde(flatten)]
    pub made: CalculationRecord,
    /// Core-seconds of its calculation, if that has ended. Without them the attempt counts with its own time.
    pub core_seconds: Option<f64>,
}

/// What a calculation is, as far as it is known before it starts.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CalculationRecord {
    /// Cores that it has.
    pub cores: Option<u32>,
    /// What was changed because of earlier failures: names separated by commas.
    pub remedies: Option<String>,
    /// What that changed in its input: lines with `-` and `+`.
    pub difference: Option<String>,
    /// Atoms.
    pub atoms: Option<u32>,
    /// Electrons that the program treats.
    pub electrons: Option<f64>,
    /// Points of its k-point mesh.
    pub k_points: Option<u32>,
}

impl FromRow for Attempt {
    fn from_row(row: &Row) -> Result<Self> {
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
    pub job: Job,
    /// Every attempt, oldest first.
    pub attempts_made: Vec<Attempt>,
    /// Energies of its structure's labels and checks, oldest first, eV.
    pub energies: Vec<(LabelStatus, f64)>,
}

/// What a stored result is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LabelStatus {
    /// The label.
    Label,
    /// A further result, for comparison.
    Check,
    /// It was the label until another came that was asked for anew.
    Superseded,
    /// It would be the label, but somebody has taken it out of the data set.
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
            .find(|standing| standing.name() == name)
    }
}

/// Where a label came from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LabelSource {
    /// A calculation of this campaign.
    Attempt {
        /// Number of the job.
        job: i64,
        /// Number of the attempt.
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

/// A label with its history.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelRecord {
    /// What it is now.
    pub status: LabelStatus,
    /// Its numbers.
    pub label: Label,
    /// Where it came from.
    pub source: LabelSource,
    /// When it came, ms since 1970.
    pub received: i64,
    /// When and why another came in its place.
    pub superseded: Option<Supersession>,
    /// When and why it was taken out of the data set.
    pub excluded: Option<Exclusion>,
}

/// How a label was superseded.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Supersession {
    /// When the label came that is in its place, ms since 1970.
    pub time: i64,
    /// Why another was asked for.
    pub reason: String,
}
