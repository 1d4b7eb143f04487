//! Why a message was rejected.

use super::frame::FrameError;
use super::sequence::SenderMismatch;
use crate::block::BlockError;
use crate::control::ControlError;

/// The server reports the reason to the sender where possible. The last four apply only to requests of agents.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RejectedMessage {
    #[error(transparent)]
    Frame(#[from] FrameError),
    #[error(transparent)]
    Control(#[from] ControlError),
    #[error(transparent)]
    SenderMismatch(#[from] SenderMismatch),
    #[error(transparent)]
    Block(#[from] BlockError),
    #[error("version {0} of the mixture is no longer available")]
    Version(u64),
    #[error("the campaign has no file with hash {0}")]
    File(String),
    #[error("cannot read a file requested by an agent: {0}")]
    Read(#[from] std::io::Error),
    #[error("no slot numbers are left for this many walkers")]
    Numbers,
}
