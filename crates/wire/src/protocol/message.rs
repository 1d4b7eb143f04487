//! What walkers and server say to each other, as control messages (see [`crate::control`]).
//!
//! A walker counts its offers: 1, 2, 3 … An offer is what came of a turn (nothing at first) and asks for the next. The
//! answer is the acknowledgement: the report is committed. Until it comes the walker asks every so often, and learns
//! that its offer waits for a decision, what the answer was, or that the offer never came and must be sent again.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::block::{Candidate, CandidateBlock};
use crate::control::{ControlError, EncodedReport, checked_assignment, decode};
use crate::ids::WalkId;
use crate::messages::{Assignment, Outcome, Progress, Report};

/// Who speaks: a process that is to be heard, and no other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct SenderId {
    /// Of this run of the orchestrator.
    pub session: u64,
    /// The walker's number.
    pub walker: u32,
    /// Counts the processes that were this walker.
    pub incarnation: u32,
}

/// From a walker.
#[derive(Serialize, Deserialize)]
pub(crate) struct Envelope<'a> {
    pub sender: SenderId,
    #[serde(borrow)]
    pub payload: Payload<'a>,
}

#[derive(Serialize, Deserialize)]
pub(crate) enum Payload<'a> {
    /// What came of the last turn, and: what next?
    Offer {
        sequence: u64,
        #[serde(borrow)]
        report: Option<EncodedReport<'a>>,
    },
    /// What became of that offer?
    Poll { sequence: u64 },
    /// Where a walk stands.
    Progress(WalkId, Cow<'a, Progress>),
}

impl<'a> Payload<'a> {
    /// An offer of what came of a turn, and the candidate that travels beside it.
    pub(crate) fn offer(
        sequence: u64,
        report: Option<&'a Report<Candidate>>,
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

/// The report of an offer with the candidate that came beside it.
pub(crate) fn attach_candidate(
    report: Option<EncodedReport<'_>>,
    candidate: Option<CandidateBlock>,
) -> Result<Option<Report>, ControlError> {
    match (report, candidate) {
        (Some(report), candidate) => report.attach_candidate(candidate).map(Some),
        (None, None) => Ok(None),
        (None, Some(block)) => Err(ControlError::UnexpectedCandidate(block.as_bytes().len())),
    }
}

/// To a walker, about its offer `sequence`.
#[derive(Serialize, Deserialize)]
pub(crate) struct Answer<'a> {
    pub sequence: u64,
    pub body: AnswerBody<'a>,
}

#[derive(Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "there is never more than one")]
pub(crate) enum AnswerBody<'a> {
    /// Committed; this is the next turn.
    Assignment { mixture_version: u64, assignment: Cow<'a, Assignment> },
    /// Committed if it could be; there is no more work.
    Shutdown,
    /// Still being decided.
    Pending,
    /// It never came: offer it again.
    Unknown,
}

impl Answer<'static> {
    /// Decodes and checks an answer.
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
