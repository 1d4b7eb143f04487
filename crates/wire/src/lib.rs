//! What actors say to each other: identifiers, the candidate as one block of bytes, small control
//! messages, and the [`transport`] that carries them.

pub mod block;
mod bytes;
pub mod control;
pub mod ids;
pub mod ipc;
pub mod messages;
pub mod mixture;
pub mod place;
pub mod transport;

pub use block::{BlockError, Candidate, CandidateBlock, CandidateView};
pub use ids::{CampaignId, CandidateId, ContentHash, IdError, Origin, WalkId};
pub use mixture::{MixtureReader, SharedMixture, SharedMixtureError};
