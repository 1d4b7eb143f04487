//! The transport between hosts, on [zenoh](https://zenoh.io): an orchestrator with a [`AgentServer`], on every other host an
//! agent with an [`AgentClient`].
//!
//! An agent takes part with a number of *slots*: to the reactor each is a walker like those of its own host. What an
//! agent and the orchestrator say to each other about a slot is what a walker says over shared memory
//! (`crate::protocol`): offers that are counted and idempotent, answers that come after the commit.
//!
//! - **zenoh promises nothing across a break**, so everything is a question with an answer, asked again until there is
//!   one. Nothing is published that somebody needs.
//! - **The mixture travels by components:** only those in which the agent's newest version differs from the one that it needs.
//! - **Who is taken for dead stays dead.** An agent whose sign of life (a liveliness token) is gone for longer than the
//!   orchestrator's patience loses its slots, and their walks go to others. Their numbers are never used again: if it comes back, it
//!   joins anew.
//! - **Explicit endpoints, no scouting.** Off loopback nothing listens or connects without TLS with certificates on both sides.

mod address;
mod agent_client;
mod agent_server;
mod certificates;
mod delta;
mod endpoint;
mod files;
mod handshake;
mod message;
mod registry;
mod session;
mod slot;

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

pub use address::{Address, Announcement};
pub use agent_client::{AgentClient, LinkError, Membership};
pub use agent_server::{AgentEvent, AgentServer, AgentServerHandle};
pub use certificates::{CertificateError, CertificateFault, CheckedTls, Tls};
pub use delta::DeltaError;
pub use endpoint::{Endpoint, EndpointError};
pub use handshake::HandshakeError;
pub use message::{Agent, AgentId};
pub use slot::{Slot, SlotReport};

/// What agents need to know of a campaign.
#[derive(Clone, Debug, Default)]
pub struct AgentBootstrap {
    /// What walkers are started with.
    pub setup: Vec<u8>,
    /// Files that they read, by the BLAKE3 hash of their content (64 hexadecimal digits).
    pub files: BTreeMap<String, PathBuf>,
}

/// Why there is no line between hosts.
#[derive(Debug, thiserror::Error)]
pub enum NetError {
    /// Anybody could connect.
    #[error(
        "{endpoint} can be reached from other hosts, and nothing does that without certificates: \
         name a directory with authority.pem, certificate.pem and key.pem (docs/hosts.md says how they are made), or use \
         a loopback address, through an ssh tunnel for instance"
    )]
    Unprotected {
        /// The endpoint.
        endpoint: Endpoint,
    },
    /// A certificate or key of this host.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
    /// A certificate that one side does not accept.
    #[error(transparent)]
    Handshake(#[from] HandshakeError),
    /// The file that says where the orchestrator is.
    #[error("cannot read {}: {source}", path.display())]
    EndpointFile {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// No orchestrator has said where it is.
    #[error("no orchestrator has written yet where it is: there is no file {}", path.display())]
    EndpointFileMissing {
        /// The file.
        path: PathBuf,
    },
    /// The orchestrator has written that there is no more work.
    #[error("the campaign is over")]
    CampaignOver,
    /// A file that does not say where the orchestrator is.
    #[error(
        "{} does not say where the orchestrator is: expected tcp/HOST:PORT, found {found:?}; \
         calmwalk run --announce writes such a file",
        path.display()
    )]
    InvalidAnnouncement {
        /// The file.
        path: PathBuf,
        /// How it begins.
        found: String,
    },
    /// zenoh cannot listen or connect.
    #[error("cannot open {endpoint}: {why}")]
    Open {
        /// The endpoint.
        endpoint: Endpoint,
        /// What zenoh says.
        why: String,
    },
    /// zenoh has ended.
    #[error("the line between hosts has ended: {why}")]
    SessionClosed {
        /// What zenoh says.
        why: String,
    },
}

impl NetError {
    fn open(endpoint: &Endpoint, why: impl fmt::Display) -> Self {
        Self::Open { endpoint: endpoint.clone(), why: why.to_string() }
    }
}
