//! Encoding of control messages, for transports between processes.
//!
//! | bytes | content |
//! | --- | --- |
//! | 4 | `CALM` |
//! | 1 | format version |
//! | 4 | CRC-32 of the rest, little-endian |
//! | rest | the message in [postcard](https://postcard.jamesmunns.com) encoding |
//!
//! Candidates are not part of a control message: the block travels next to the report that names it, in its own
//! encoding.

use std::borrow::Cow;

use atoms::StructureError;
use serde::{Deserialize, Serialize};

use crate::block::CandidateBlock;
use crate::ids::{CandidateId, Origin, WalkId};
use crate::messages::{Assignment, AssignmentReport, AssignmentStart, Outcome, WalkEnd, WalkProgress};
use crate::walk_frame::WalkFrame;
use crate::walk_trace::TracePoint;

const MAGIC: [u8; 4] = *b"CALM";
const VERSION: u8 = 6;
const PREFIX: usize = MAGIC.len() + 1 + 4;

/// Why bytes are not a valid control message.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum ControlError {
    /// Shorter than the header.
    #[error("control message too short: {0} bytes, the header alone has {PREFIX}")]
    Short(usize),
    /// Wrong magic bytes.
    #[error("not a control message: it begins with {0:02x?}, expected {MAGIC:02x?}")]
    Magic([u8; 4]),
    /// Another format version.
    #[error(
        "control message of version {0}, expected version {VERSION}: use the same version of calmwalk in all processes"
    )]
    Version(u8),
    /// Wrong checksum.
    #[error("damaged control message: checksum {found:08x}, expected {expected:08x}")]
    Checksum {
        /// Checksum of the received bytes.
        found: u32,
        /// Checksum in the message.
        expected: u32,
    },
    /// The content cannot be decoded.
    #[error("cannot decode control message: {0}")]
    Content(#[from] postcard::Error),
    /// Extra bytes after the message.
    #[error("{0} extra bytes after the end of a control message")]
    Trailing(usize),
    /// An assignment with an invalid seed structure.
    #[error("invalid seed structure of walk {walk}: {source}")]
    SeedStructure {
        /// The walk.
        walk: WalkId,
        /// What is wrong.
        source: StructureError,
    },
    /// Invalid list of requested frames.
    #[error("{origin} walk {walk}: invalid list of requested frames {frame_steps:?}: expected {expected}")]
    FrameSteps {
        /// The walk.
        walk: WalkId,
        /// Biased or control.
        origin: Origin,
        /// The requested steps.
        frame_steps: Vec<u64>,
        /// What is expected.
        expected: &'static str,
    },
    /// A threshold factor below 1, or not finite.
    #[error("walk {walk}: invalid threshold factor {found}: expected a finite number, 1 or more")]
    ThresholdFactor {
        /// The walk.
        walk: WalkId,
        /// The factor.
        found: f64,
    },
    /// The candidate is missing, or another one than the report names.
    #[error("report of walk {walk} names candidate {}, but the attached block is {}", name(.named), name(.attached))]
    Candidate {
        /// The walk.
        walk: WalkId,
        /// Named in the report.
        named: Option<Box<CandidateId>>,
        /// Id of the attached block.
        attached: Option<Box<CandidateId>>,
    },
    /// A candidate without a report that names it.
    #[error("unexpected candidate of {0} bytes: the message names none")]
    UnexpectedCandidate(usize),
}

/// A [`AssignmentReport`] with the candidate replaced by its id.
#[derive(Serialize, Deserialize)]
pub(crate) struct EncodedReport<'a> {
    walk: WalkId,
    assignment: u64,
    start: Cow<'a, Option<AssignmentStart>>,
    outcome: EncodedOutcome<'a>,
    #[serde(serialize_with = "crate::bytes::serialize")]
    checkpoint: &'a [u8],
    progress: Cow<'a, WalkProgress>,
    trace: Cow<'a, [TracePoint]>,
    frames: Cow<'a, [WalkFrame]>,
}

/// An [`Outcome`] with the candidate replaced by its id.
#[derive(Serialize, Deserialize)]
enum EncodedOutcome<'a> {
    Candidate(CandidateId),
    StepsDone,
    Interrupted,
    Ended(Cow<'a, WalkEnd>),
}

impl<'a> EncodedReport<'a> {
    /// Encodes a report; `id` gives the id of its candidate.
    pub(crate) fn new<C>(report: &'a AssignmentReport<C>, id: impl FnOnce(&C) -> CandidateId) -> Self {
        let outcome = match &report.outcome {
            Outcome::Candidate(candidate) => EncodedOutcome::Candidate(id(candidate)),
            Outcome::StepsDone => EncodedOutcome::StepsDone,
            Outcome::Interrupted => EncodedOutcome::Interrupted,
            Outcome::Ended(end) => EncodedOutcome::Ended(Cow::Borrowed(end)),
        };
        let (checkpoint, progress) = (report.checkpoint.as_slice(), Cow::Borrowed(&report.progress));
        let (trace, frames) =
            (Cow::Borrowed(report.trace.as_slice()), Cow::Borrowed(report.frames.as_slice()));
        let (walk, assignment, start) = (report.walk, report.assignment, Cow::Borrowed(&report.start));
        Self { walk, assignment, start, outcome, checkpoint, progress, trace, frames }
    }

    /// The report with its candidate, which arrived separately.
    pub(crate) fn attach_candidate(
        self,
        candidate: Option<CandidateBlock>,
    ) -> Result<AssignmentReport, ControlError> {
        let Self { walk, assignment, start, outcome, checkpoint, progress, trace, frames } = self;
        let outcome = checked_outcome(walk, outcome, candidate)?;
        Ok(AssignmentReport {
            walk,
            assignment,
            start: start.into_owned(),
            outcome,
            checkpoint: checkpoint.to_vec(),
            progress: progress.into_owned(),
            trace: trace.into_owned(),
            frames: frames.into_owned(),
        })
    }
}

/// Encodes a message, with header.
pub(crate) fn encode(content: &impl Serialize) -> Vec<u8> {
    let content = postcard::to_stdvec(content).expect("encoding plain data into memory cannot fail");
    let checksum = crc32fast::hash(&content).to_le_bytes();
    [MAGIC.as_slice(), &[VERSION], &checksum, &content].concat()
}

/// Checks the header and decodes the message.
pub(crate) fn decode<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, ControlError> {
    let (message, rest) = postcard::take_from_bytes(content(bytes)?)?;
    if rest.is_empty() { Ok(message) } else { Err(ControlError::Trailing(rest.len())) }
}

/// The content after the header, verified.
fn content(bytes: &[u8]) -> Result<&[u8], ControlError> {
    let short = ControlError::Short(bytes.len());
    let Some((magic, rest)) = bytes.split_first_chunk() else { return Err(short) };
    let Some(([version], rest)) = rest.split_first_chunk() else { return Err(short) };
    let Some((checksum, content)) = rest.split_first_chunk() else { return Err(short) };
    if *magic != MAGIC {
        return Err(ControlError::Magic(*magic));
    }
    if *version != VERSION {
        return Err(ControlError::Version(*version));
    }
    let (found, expected) = (crc32fast::hash(content), u32::from_le_bytes(*checksum));
    if found == expected { Ok(content) } else { Err(ControlError::Checksum { found, expected }) }
}

/// Validates an assignment.
pub(crate) fn checked_assignment(assignment: Assignment) -> Result<Assignment, ControlError> {
    let Assignment { walk, origin, ref frame_steps, ref seed_structure, .. } = assignment;
    seed_structure.validate().map_err(|source| ControlError::SeedStructure { walk, source })?;
    let wrong =
        |expected| Err(ControlError::FrameSteps { walk, origin, frame_steps: frame_steps.clone(), expected });
    if origin == Origin::Biased && !frame_steps.is_empty() {
        return wrong("none of a biased walk");
    }
    if !frame_steps.is_sorted_by(|a, b| a < b) {
        return wrong("ascending steps");
    }
    if !(assignment.threshold_factor.is_finite() && assignment.threshold_factor >= 1.0) {
        return Err(ControlError::ThresholdFactor { walk, found: assignment.threshold_factor });
    }
    Ok(assignment)
}

fn checked_outcome(
    walk: WalkId,
    outcome: EncodedOutcome<'_>,
    candidate: Option<CandidateBlock>,
) -> Result<Outcome, ControlError> {
    match (outcome, candidate) {
        (EncodedOutcome::StepsDone, None) => Ok(Outcome::StepsDone),
        (EncodedOutcome::Interrupted, None) => Ok(Outcome::Interrupted),
        (EncodedOutcome::Ended(end), None) => Ok(Outcome::Ended(end.into_owned())),
        (EncodedOutcome::Candidate(id), Some(block)) if id == block.view().id() && id.walk == walk => {
            Ok(Outcome::Candidate(block))
        }
        (outcome, block) => {
            let named = if let EncodedOutcome::Candidate(id) = outcome { Some(Box::new(id)) } else { None };
            let attached = block.map(|block| Box::new(block.view().id()));
            Err(ControlError::Candidate { walk, named, attached })
        }
    }
}

fn name(candidate: &Option<Box<CandidateId>>) -> String {
    candidate.as_ref().map_or_else(|| "none".to_owned(), |id| id.to_string())
}
