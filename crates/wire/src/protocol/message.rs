//! Messages between walkers and server, encoded as control messages (see [`crate::control`]).
//!
//! A walker numbers its offers 1, 2, 3, … An offer contains the report on the last assignment (none at first) and
//! requests the next one. The answer acknowledges that the report is committed. Until it arrives, the walker polls
//! periodically and learns that its offer is pending, what the answer was, or that the offer was lost and must be sent
//! again.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::block::{Candidate, CandidateBlock};
use crate::control::{ControlError, EncodedReport, checked_assignment, decode};
use crate::ids::WalkId;
use crate::messages::{Assignment, AssignmentReport, Outcome, WalkProgress};

/// Identifies the sender of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct SenderId {
    /// Session of the orchestrator: one per run.
    pub session: u64,
    /// Number of the walker.
    pub walker: u32,
    /// Start count of the walker's process.
    pub incarnation: u32,
}

/// A message of a walker.
#[derive(Serialize, Deserialize)]
pub(crate) struct Envelope<'a> {
    pub sender: SenderId,
    #[serde(borrow)]
    pub payload: Payload<'a>,
}

#[derive(Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "there is never more than one")]
pub(crate) enum Payload<'a> {
    /// Report on the last assignment, and request for the next.
    Offer {
        sequence: u64,
        #[serde(borrow)]
        report: Option<EncodedReport<'a>>,
    },
    /// Asks for the state of an offer.
    Poll { sequence: u64 },
    /// Current state of a walk.
    Progress(WalkId, Cow<'a, WalkProgress>),
}

impl<'a> Payload<'a> {
    /// An offer with this report, and the candidate to send with it.
    pub(crate) fn offer(
        sequence: u64,
        report: Option<&'a AssignmentReport<Candidate>>,
    ) -> (Self, Option<&'a Candidate>) {
        let candidate = report.and_then(|report| match &report.outcome {
            Outcome::Candidate(candidate) => Some(candidate),
            _ => None,
        });
        (
            Self::Offer {
                sequence,
                report: report.map(|report| EncodedReport::new(report, |candidate| candidate.id)),
            },
            candidate,
        )
    }
}

/// The report of an offer with its candidate, which arrived separately.
pub(crate) fn attach_candidate(
    report: Option<EncodedReport<'_>>,
    candidate: Option<CandidateBlock>,
) -> Result<Option<AssignmentReport>, ControlError> {
    match (report, candidate) {
        (Some(report), candidate) => report.attach_candidate(candidate).map(Some),
        (None, None) => Ok(None),
        (None, Some(block)) => Err(ControlError::UnexpectedCandidate(block.as_bytes().len())),
    }
}

/// Answer to offer `sequence` of a walker.
#[derive(Serialize, Deserialize)]
pub(crate) struct Answer<'a> {
    pub sequence: u64,
    pub body: AnswerBody<'a>,
}

#[derive(Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "there is never more than one")]
pub(crate) enum AnswerBody<'a> {
    /// The report is committed; this is the next assignment.
    Assignment { mixture_version: u64, assignment: Cow<'a, Assignment> },
    /// There is no more work. The report is committed if that was possible.
    Shutdown,
    /// The decision is pending.
    Pending,
    /// The offer was not received: send it again.
    Unknown,
}

impl Answer<'static> {
    /// Decodes and validates an answer.
    pub(crate) fn decode(bytes: &[u8]) -> Result<Self, ControlError> {
        let Answer { sequence, body } = decode(bytes)?;
        let body = match body {
            AnswerBody::Assignment { mixture_version, assignment } => {
                let assignment = Cow::Owned(checked_assignment(assignment.into_owned())?);
                AnswerBody::Assignment { mixture_version, assignment }
            }
            AnswerBody::Shutdown => AnswerBody::Shutdown,
            AnswerBody::Pending => AnswerBody::Pending,
            AnswerBody::Unknown => AnswerBody::Unknown,
        };
        Ok(Self { sequence, body })
    }
}
