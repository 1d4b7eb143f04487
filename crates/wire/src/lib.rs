//! Messages between the processes of a campaign: identifiers, the candidate as one block of bytes, control messages,
//! and the [`transport`] that carries them.

// Lets unit tests share the candidate strategies of `tests`.
#[cfg(test)]
extern crate self as wire;

pub mod block;
mod bytes;
pub mod completion;
pub mod conditions;
mod control;
mod device_statistics;
pub mod ids;
pub mod ipc;
pub mod messages;
pub mod mixture;
pub mod net;
mod protocol;
pub mod shm_dir;
pub mod transport;
mod walk_frame;
mod walk_trace;

#[doc(hidden)]
pub use protocol::datagram;

pub use block::{BlockError, Candidate, CandidateBlock, CandidateView};
pub use completion::{CompletionCoefficients, CompletionPredictors};
pub use conditions::{CellConditions, ConstantPressure, WalkConditions};
pub use device_statistics::DeviceStatistics;
pub use ids::{CampaignId, CandidateId, ContentHash, IdError, Origin, WalkId};
pub use mixture::{MixtureReader, SharedMixture, SharedMixtureError};
pub use walk_frame::WalkFrame;
pub use walk_trace::{MAX_KEPT_POINTS, TracePoint, thin};
