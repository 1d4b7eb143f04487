//! The transport between processes of one host, on [iceoryx2](https://iceoryx.io). The orchestrator has an [`IpcServer`],
//! each walker an [`IpcWalker`]; messages are in shared memory.
//!
//! - **Zero copy.** A walker encodes its candidate into the memory in which the selector and the store read it. The
//!   server copies a candidate only if it already holds [`config::MAX_IN_PLACE`] of the same walker.
//! - **Acknowledged delivery.** The answer to a report is sent after its commit. A walker keeps an unanswered report,
//!   polls, and sends it again if it was lost (see [`crate::protocol`]). A report that is sent twice is decided once.
//! - **No busy waiting.** Each end sleeps until the other wakes it. A waiting walker polls every two seconds, which is
//!   its heartbeat and detects lost messages.
//! - **No blocking on dead processes.** If a buffer is full, the message is dropped and the sender gets an error; no
//!   call blocks on another process.
//! - **Unexpected messages are rejected and counted:** wrong magic, version, length or checksum, or another session,
//!   walker or incarnation. Only the user has access to sockets and segments. There is no protection between processes
//!   of the same user: a process that writes to the mapped memory on purpose can do harm, as with a debugger.

mod borrowed_request;
mod calls;
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

pub use calls::{CallAddress, CallClient, CallServer, IncomingCall, call_space_needed};
pub use config::space_needed;
pub use connections::Traffic;
#[doc(hidden)]
pub use reencode::reencode;
pub use server::{IpcServer, ServerHandle};
pub use walker::IpcWalker;

/// Expected load.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// Maximum number of concurrent walkers.
    pub walkers: u32,
    /// Size of the largest report with its candidate, and of the largest assignment, bytes. Larger messages work, but
    /// are not counted in [`space_needed`].
    pub message_bytes: usize,
}

/// Everything a walker needs to connect.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConnectInfo {
    directory: PathBuf,
    prefix: String,
    mixture: PathBuf,
    message_bytes: usize,
    sender: SenderId,
}

impl ConnectInfo {
    /// Number of the walker.
    pub fn walker(&self) -> u32 {
        self.sender.walker
    }
}

/// Why the transport failed.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// An error of shared memory or sockets.
    #[error("the transport cannot {what}: {why}")]
    Transport {
        /// The operation.
        what: &'static str,
        /// Error of iceoryx2 or of the operating system.
        why: String,
    },
    /// The mixture cannot be shared or read.
    #[error(transparent)]
    Mixture(#[from] SharedMixtureError),
    /// The orchestrator does not answer.
    #[error("no answer from the orchestrator for {seconds} s")]
    Timeout {
        /// Time since the last answer, s.
        seconds: u64,
    },
    /// Messages of this walker are rejected repeatedly.
    #[error("the orchestrator rejected a report {times} times: this is a bug in calmwalk")]
    Rejected {
        /// Number of attempts.
        times: u32,
    },
}

impl IpcError {
    /// An error of the transport: what could not be done, and why.
    pub fn new(what: &'static str, why: impl fmt::Display) -> Self {
        Self::Transport { what, why: why.to_string() }
    }
}
