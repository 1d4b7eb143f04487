//! The transport between hosts, on [zenoh](https://zenoh.io). The orchestrator has an [`AgentServer`]; every other host
//! runs an agent with an [`AgentClient`].
//!
//! An agent has a number of *slots*. To the reactor, each slot is a walker like those of its own host. Agent and
//! orchestrator exchange the same messages about a slot as walkers do over shared memory (`crate::protocol`): numbered,
//! idempotent offers, and answers after the commit.
//!
//! - **Every message is a request** that is repeated until it is answered, since zenoh guarantees nothing across a
//!   broken link. Published messages are never relied on.
//! - **The mixture is sent as a delta:** only the components in which the agent's newest version differs from the one
//!   it needs.
//! - **A lost agent stays lost.** If an agent's heartbeat (a liveliness token) is missing for longer than the timeout,
//!   the agent loses its slots, and their walks go to others. Slot numbers are never reused: an agent that comes back
//!   joins again.
//! - **Explicit endpoints, no scouting.** Except on loopback, listening and connecting require TLS with certificates on
//!   both sides.

mod address;
mod agent_client;
mod agent_event;
mod agent_server;
mod certificates;
#[doc(hidden)]
pub mod datagram;
mod delta;
mod endpoint;
mod files;
mod handshake;
mod link_error;
mod message;
mod mixture_fetch;
mod registry;
mod replies;
mod session;
mod side;
mod slot;

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

pub use address::{Address, Announcement};
pub use agent_client::{AgentClient, Membership};
pub use agent_event::AgentEvent;
pub use agent_server::{AgentServer, StopTokens};
pub use certificates::{CertificateError, CertificateFault, CheckedTls, Tls};
pub use delta::DeltaError;
pub use endpoint::{Endpoint, EndpointError};
pub use handshake::HandshakeError;
pub use link_error::LinkError;
pub use message::{AgentId, AgentInfo};
pub use slot::{Slot, SlotReport};

/// What agents need to know about a campaign.
#[derive(Clone, Debug, Default)]
pub struct AgentBootstrap {
    /// Configuration for starting walkers.
    pub setup: Vec<u8>,
    /// Files that walkers read, by the BLAKE3 hash of their content (64 hexadecimal digits).
    pub files: BTreeMap<String, PathBuf>,
}

/// Why two hosts cannot communicate.
#[derive(Debug, thiserror::Error)]
pub enum NetError {
    /// The endpoint is reachable by anyone.
    #[error(
        "{endpoint} can be reached from other hosts, which requires certificates: \
         name a directory with authority.pem, certificate.pem and key.pem (see docs/hosts.md), or use \
         a loopback address, for example through an ssh tunnel"
    )]
    Unprotected {
        /// The endpoint.
        endpoint: Endpoint,
    },
    /// An unusable certificate or key of this host.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
    /// A certificate that one side rejects.
    #[error(transparent)]
    Handshake(#[from] HandshakeError),
    /// The endpoint file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    EndpointFile {
        /// The file.
        path: PathBuf,
        /// The error.
        source: std::io::Error,
    },
    /// The endpoint file does not exist.
    #[error("endpoint file not found: {}; has `calmwalk run --announce` started?", path.display())]
    EndpointFileMissing {
        /// The file.
        path: PathBuf,
    },
    /// The endpoint file says that the campaign is over.
    #[error("the campaign is over")]
    CampaignOver,
    /// The endpoint file has invalid content.
    #[error(
        "{} is not an endpoint file: expected tcp/HOST:PORT, found {found:?}; \
         calmwalk run --announce writes such a file",
        path.display()
    )]
    InvalidAnnouncement {
        /// The file.
        path: PathBuf,
        /// The beginning of its content.
        found: String,
    },
    /// zenoh cannot listen or connect.
    #[error("cannot open {endpoint}: {why}")]
    Open {
        /// The endpoint.
        endpoint: Endpoint,
        /// The error of zenoh.
        why: String,
    },
    /// The zenoh session was closed.
    #[error("the connection between hosts was closed: {why}")]
    SessionClosed {
        /// The error of zenoh.
        why: String,
    },
}

impl NetError {
    fn open(endpoint: &Endpoint, why: impl fmt::Display) -> Self {
        Self::Open { endpoint: endpoint.clone(), why: why.to_string() }
    }
}
