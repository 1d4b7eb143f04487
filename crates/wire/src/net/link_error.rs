//! Why an agent cannot work with the orchestrator, and replies that say so.

use super::delta::DeltaError;
use super::message::AgentReply;
use crate::control::{ControlError, decode};

/// Why an agent cannot work with the orchestrator.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The agent was considered lost, or the orchestrator was restarted. The agent can join again and deliver its
    /// reports.
    #[error("{0}")]
    RejoinRequired(String),
    /// The orchestrator rejected a message.
    #[error("the orchestrator rejected a message: {0}")]
    Rejected(String),
    /// The orchestrator does not answer.
    #[error("no answer from the orchestrator for {minutes:.1} min")]
    Timeout {
        /// Time since the last answer, min.
        minutes: f64,
    },
    /// An answer cannot be decoded, most likely because the versions of calmwalk differ.
    #[error("invalid answer of the orchestrator: {0}")]
    InvalidReply(String),
}

impl From<ControlError> for LinkError {
    fn from(why: ControlError) -> Self {
        Self::InvalidReply(why.to_string())
    }
}

impl From<DeltaError> for LinkError {
    fn from(why: DeltaError) -> Self {
        Self::InvalidReply(why.to_string())
    }
}

/// Decodes an answer; rejections are errors.
pub(super) fn decode_reply(answer: &[u8]) -> Result<AgentReply<'_>, LinkError> {
    match decode(answer)? {
        AgentReply::RejoinRequired(why) => Err(LinkError::RejoinRequired(why)),
        AgentReply::Rejected(why) => Err(LinkError::Rejected(why)),
        reply => Ok(reply),
    }
}

/// The error of a reply of another kind than that of the request.
pub(super) fn unexpected(to: &str) -> LinkError {
    LinkError::InvalidReply(format!("it does not match the request ({to})"))
}
