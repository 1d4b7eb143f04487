//! Why a message is not listened to.

use super::frame::FrameError;
use super::sequence::SenderMismatch;
use crate::block::BlockError;
use crate::control::ControlError;

/// Whoever sent it is told, where it can be; the last four are of questions that only agents ask.
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
    #[error("there is no version {0} of the mixture any more")]
    Version(u64),
    #[error("no file with the hash {0} belongs to this campaign")]
    File(String),
    #[error("cannot read a file that walkers need: {0}")]
    Read(#[from] std::io::Error),
    #[error("no numbers are left for so many walkers")]
    Numbers,
}
