//! What actors say to each other: identifiers, the candidate as one block of bytes, small control
//! messages, and the [`transport`] that carries them.

// Tests in here draw their candidates where those in `tests` do.
#[cfg(test)]
extern crate self as wire;

pub mod block;
mod bytes;
mod control;
pub mod ids;
pub mod ipc;
pub mod messages;
pub mod mixture;
pub mod net;
mod protocol;
pub mod shm_dir;
pub mod transport;

pub use block::{BlockError, Candidate, CandidateBlock, CandidateView};
pub use ids::{CampaignId, CandidateId, ContentHash, IdError, Origin, WalkId};
pub use mixture::{MixtureReader, SharedMixture, SharedMixtureError};
