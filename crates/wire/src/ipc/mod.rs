//! The transport between processes of one host, on [iceoryx2](https://iceoryx.io): an orchestrator with a [`Server`],
//! walkers with an [`IpcWalker`] each, messages in memory that both map.
//!
//! - **One write.** A walker encodes its candidate into the memory in which the selector and the store read it. Nothing
//!   is copied, unless the server holds more of one walker's candidates than [`config::MAX_IN_PLACE`].
//! - **Delivery is acknowledged.** The answer to a report is sent after its commit; a walker keeps what is unanswered,
//!   asks, and offers it again if it was lost (see [`crate::protocol`]). Offered twice it is decided once.
//! - **No polling.** Each end sleeps until the other rings. A walker that waits wakes every two seconds to ask, which is
//!   its sign of life and finds what was lost.
//! - **Nobody waits for the dead.** A full buffer drops a message and says so; no call blocks on another process.
//! - **Strangers are dropped and counted:** other magic, version, length or checksum, other session, walker or
//!   incarnation. Sockets and segments are the user's alone. A process of the same user that writes into mapped memory
//!   by force can do harm, as it could with a debugger: this is no border between a user's own processes.

mod borrowed_request;
mod config;
mod connections;
mod reencode;
mod server;
mod session;
mod walker;

use std::fmt;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::mixture::SharedMixtureError;
use crate::protocol::message::SenderId;

pub use config::space_needed;
pub use connections::Traffic;
#[doc(hidden)]
pub use reencode::reencode;
pub use server::{Server, ServerHandle};
pub use walker::IpcWalker;

/// How much is expected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// Walkers at work at the same time.
    pub walkers: u32,
    /// The largest report with its candidate, and the largest assignment, bytes. Larger ones are carried all the same,
    /// but not counted in [`space_needed`].
    pub message_bytes: usize,
}

/// All that a walker needs to connect.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConnectInfo {
    directory: PathBuf,
    prefix: String,
    mixture: PathBuf,
    message_bytes: usize,
    #[serde(rename = "caller")]
    sender: SenderId,
}

impl ConnectInfo {
    /// The number of the walker that it is for.
    pub fn walker(&self) -> u32 {
        self.sender.walker
    }
}

/// Why the transport does not work.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// Shared memory or sockets.
    #[error("the transport cannot {what}: {why}")]
    Transport {
        /// What was tried.
        what: &'static str,
        /// What iceoryx2 or the operating system says.
        why: String,
    },
    /// The mixture cannot be shared or read.
    #[error(transparent)]
    Mixture(#[from] SharedMixtureError),
    /// The orchestrator does not answer.
    #[error("the orchestrator has not answered for {seconds} s")]
    Timeout {
        /// How long.
        seconds: u64,
    },
    /// What this walker sends is dropped again and again.
    #[error("the orchestrator refused a report {times} times: this is a defect of calmwalk")]
    Rejected {
        /// How often.
        times: u32,
    },
}

impl IpcError {
    fn new(what: &'static str, why: impl fmt::Display) -> Self {
        Self::Transport { what, why: why.to_string() }
    }
}
