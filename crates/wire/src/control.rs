//! Control messages as bytes, for transports between processes.
//!
//! | bytes | content |
//! | --- | --- |
//! | 4 | `CALM` |
//! | 1 | format version |
//! | 4 | CRC-32 of the rest, little-endian |
//! | rest | the message in [postcard](https://postcard.jamesmunns.com) encoding |
//!
//! A candidate is not inside: its block travels beside the report that names it, as the bytes that it has already.

use std::borrow::Cow;

use atoms::StructureError;
use serde::{Deserialize, Serialize};

use crate::block::CandidateBlock;
use crate::ids::{CandidateId, Origin, WalkId};
use crate::messages::{Assignment, Outcome, Progress, Report, WalkEnd};

const MAGIC: [u8; 4] = *b"CALM";
const VERSION: u8 = 2;
const PREFIX: usize = MAGIC.len() + 1 + 4;

/// Why bytes are not a control message.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum ControlError {
    /// Fewer bytes than the fixed part.
    #[error("a control message of {0} bytes: its fixed part alone has {PREFIX}")]
    Short(usize),
    /// Something else.
    #[error("not a control message: it begins with {0:02x?}, expected {MAGIC:02x?}")]
    Magic([u8; 4]),
    /// A message of another version of this program.
    #[error(
        "a control message of version {0}; this program reads version {VERSION}: run the same program everywhere"
    )]
    Version(u8),
    /// Damaged.
    #[error("a damaged control message: checksum {found:08x}, expected {expected:08x}")]
    Checksum {
        /// Of the bytes at hand.
        found: u32,
        /// In the message.
        expected: u32,
    },
    /// Bytes that do not spell a message.
    #[error("a control message that cannot be decoded: {0}")]
    Content(#[from] postcard::Error),
    /// More bytes than the message has.
    #[error("{0} bytes behind the end of a control message")]
    Trailing(usize),
    /// An assignment whose seed structure cannot be used.
    #[error("the seed structure of walk {walk}: {source}")]
    SeedStructure {
        /// The walk.
        walk: WalkId,
        /// What is wrong with it.
        source: StructureError,
    },
    /// Wanted frames that are not in order, or of a walk that has none.
    #[error("the {origin} walk {walk} is to give the frames of steps {frame_steps:?}: expected {expected}")]
    FrameSteps {
        /// The walk.
        walk: WalkId,
        /// Biased or control.
        origin: Origin,
        /// The steps.
        frame_steps: Vec<u64>,
        /// What they should be.
        expected: &'static str,
    },
    /// A threshold that is lowered, or none.
    #[error("walk {walk} is to multiply its threshold by {found}: expected a finite number, 1 or more")]
    ThresholdFactor {
        /// The walk.
        walk: WalkId,
        /// The factor.
        found: f64,
    },
    /// A report without the candidate that it names, or with another.
    #[error("a report of walk {walk} names candidate {}, the block beside it is {}", name(.named), name(.beside))]
    Candidate {
        /// The walk.
        walk: WalkId,
        /// In the report.
        named: Option<Box<CandidateId>>,
        /// Of the block.
        beside: Option<Box<CandidateId>>,
    },
    /// A candidate that nothing names.
    #[error("{0} bytes of a candidate beside a message that names none")]
    UnexpectedCandidate(usize),
}

/// A [`Report`] with the name of the candidate in its place.
#[derive(Serialize, Deserialize)]
pub(crate) struct EncodedReport<'a> {
    walk: WalkId,
    assignment: u64,
    outcome: EncodedOutcome<'a>,
    #[serde(serialize_with = "crate::bytes::serialize")]
    checkpoint: &'a [u8],
    progress: Cow<'a, Progress>,
}

/// An [`Outcome`] with the name of the candidate in its place.
#[derive(Serialize, Deserialize)]
enum EncodedOutcome<'a> {
    Candidate(CandidateId),
    StepsDone,
    Interrupted,
    Ended(Cow<'a, WalkEnd>),
}

impl<'a> EncodedReport<'a> {
    /// The report without its candidate, which has this id.
    pub(crate) fn new<C>(report: &'a Report<C>, id: impl FnOnce(&C) -> CandidateId) -> Self {
        let outcome = match &report.outcome {
            Outcome::Candidate(candidate) => EncodedOutcome::Candidate(id(candidate)),
            Outcome::StepsDone => EncodedOutcome::StepsDone,
            Outcome::Interrupted => EncodedOutcome::Interrupted,
            Outcome::Ended(end) => EncodedOutcome::Ended(Cow::Borrowed(end)),
        };
        let (checkpoint, progress) = (report.checkpoint.as_slice(), Cow::Borrowed(&report.progress));
        Self { walk: report.walk, assignment: report.assignment, outcome, checkpoint, progress }
    }

    /// The report with the candidate that came beside it.
    pub(crate) fn attach_candidate(self, candidate: Option<CandidateBlock>) -> Result<Report, ControlError> {
        let Self { walk, assignment, outcome, checkpoint, progress } = self;
        let outcome = checked_outcome(walk, outcome, candidate)?;
        Ok(Report {
            walk,
            assignment,
            outcome,
            checkpoint: checkpoint.to_vec(),
            progress: progress.into_owned(),
        })
    }
}

/// Encodes plain data and puts the fixed part before it.
pub(crate) fn encode(content: &impl Serialize) -> Vec<u8> {
    let content = postcard::to_stdvec(content).expect("plain data is encoded into memory");
    let checksum = crc32fast::hash(&content).to_le_bytes();
    [MAGIC.as_slice(), &[VERSION], &checksum, &content].concat()
}

/// Checks the fixed part and decodes what is behind it.
pub(crate) fn decode<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, ControlError> {
    let (message, rest) = postcard::take_from_bytes(content(bytes)?)?;
    if rest.is_empty() { Ok(message) } else { Err(ControlError::Trailing(rest.len())) }
}

/// The checked bytes behind the fixed part.
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

/// An assignment that can be worked on.
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
            let beside = block.map(|block| Box::new(block.view().id()));
            Err(ControlError::Candidate { walk, named, beside })
        }
    }
}

fn name(candidate: &Option<Box<CandidateId>>) -> String {
    candidate.as_ref().map_or_else(|| "none".to_owned(), |id| id.to_string())
}
