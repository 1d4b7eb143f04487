//! What walkers and server say to each other, as control messages (see [`crate::control`]).
//!
//! A walker counts its offers: 1, 2, 3 … An offer is what came of a turn (nothing at first) and asks for the next. The
//! answer is the acknowledgement: the report is committed. Until it comes the walker asks every so often, and learns
//! that its offer waits for a decision, what the answer was, or that the offer never came and must be sent again.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::control::{ControlError, EncodedReport, checked_assignment, unseal};
use crate::ids::WalkId;
use crate::messages::{Assignment, Progress};

/// Who speaks: a process that is to be heard, and no other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Caller {
    /// Of this run of the orchestrator.
    pub session: u64,
    /// The walker's number.
    pub walker: u32,
    /// Counts the processes that were this walker.
    pub incarnation: u32,
}

/// From a walker.
#[derive(Serialize, Deserialize)]
pub(super) struct Letter<'a> {
    pub caller: Caller,
    #[serde(borrow)]
    pub words: Words<'a>,
}

#[derive(Serialize, Deserialize)]
pub(super) enum Words<'a> {
    /// What came of the last turn, and: what next?
    Offer {
        sequence: u64,
        #[serde(borrow)]
        report: Option<EncodedReport<'a>>,
    },
    /// What became of that offer?
    Ask { sequence: u64 },
    /// Where a walk stands.
    Progress(WalkId, Cow<'a, Progress>),
}

/// To a walker, about its offer `sequence`.
#[derive(Serialize, Deserialize)]
pub(super) struct Answer<'a> {
    pub sequence: u64,
    pub decision: Decision<'a>,
}

#[derive(Serialize, Deserialize)]
pub(super) enum Decision<'a> {
    /// Committed; this is the next turn.
    Turn { mixture_version: u64, assignment: Cow<'a, Assignment> },
    /// Committed if it could be; there is no more work.
    Home,
    /// Still being decided.
    Wait,
    /// It never came: offer it again.
    Unknown,
}

impl Answer<'static> {
    /// Decodes and checks an answer.
    pub(super) fn decode(bytes: &[u8]) -> Result<Self, ControlError> {
        let Answer { sequence, decision } = unseal(bytes)?;
        let decision = match decision {
            Decision::Turn { mixture_version, assignment } => {
                let assignment = Cow::Owned(checked_assignment(assignment.into_owned())?);
                Decision::Turn { mixture_version, assignment }
            }
            Decision::Home => Decision::Home,
            Decision::Wait => Decision::Wait,
            Decision::Unknown => Decision::Unknown,
        };
        Ok(Self { sequence, decision })
    }
}
