//! Requests of agents and their answers, encoded as control messages (see [`crate::control`]). Candidates are attached
//! to offers as over shared memory.

use serde::{Deserialize, Serialize};

use super::delta::MixtureDelta;
use crate::protocol::message::{Answer, Envelope, SenderId};

/// Key under which the orchestrator answers.
pub(super) const ORCHESTRATOR: &str = "calmwalk/orchestrator";
/// Prefix of the liveliness tokens of agents: `calmwalk/agents/ID`.
pub(super) const AGENTS: &str = "calmwalk/agents";

/// Id of an agent, 32 hexadecimal digits. Different for each agent on a host and for each start.
pub type AgentId = String;

/// An agent.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AgentInfo {
    /// Random id, created at its start.
    pub id: AgentId,
    /// Name of its host, for display.
    pub host: String,
    /// Process id.
    pub pid: u32,
    /// Version of calmwalk.
    pub program_version: String,
    /// Number of walkers.
    pub walkers: u32,
    /// Number of additional assignments to prefetch.
    pub prefetch: u32,
}

impl AgentInfo {
    /// Maximum number of assignments of the agent.
    pub fn slots(&self) -> u32 {
        self.walkers.saturating_add(self.prefetch)
    }
}

#[derive(Serialize, Deserialize)]
pub(super) enum AgentRequest<'a> {
    /// Joins the campaign.
    Join(AgentInfo),
    /// A walker's message about a slot.
    #[serde(borrow)]
    Envelope(Box<Envelope<'a>>),
    /// Replaces an offer: the walker that worked on the slot's assignment has exited.
    Lost { sender: SenderId, sequence: u64, crashed: bool },
    /// Requests mixture version `wanted`, as a delta to version `have`, without the first `skip` components.
    Mixture { session: u64, have: Option<u64>, wanted: u64, skip: u32 },
    /// Requests a part of a file for walkers.
    File { session: u64, hash: String, offset: u64 },
    /// Asks whether the orchestrator is alive and whether to stop.
    Ping { session: u64 },
    /// Leaves and returns all assignments.
    Leave { session: u64, id: AgentId },
}

#[derive(Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "there is never more than one")]
pub(super) enum AgentReply<'a> {
    #[serde(borrow)]
    Joined(JoinReply<'a>),
    /// Answer to an envelope or a loss.
    Answer(Answer<'a>),
    #[serde(borrow)]
    Mixture(MixtureDelta<'a>),
    File {
        length: u64,
        #[serde(serialize_with = "crate::bytes::serialize")]
        part: &'a [u8],
    },
    Pong {
        stopping: bool,
    },
    Left,
    /// The sender is unknown: the agent was considered lost, or this is another run of the orchestrator. It must join
    /// again.
    RejoinRequired(String),
    /// The request cannot be answered.
    Rejected(String),
}

/// Answer to an agent that has joined.
#[derive(Serialize, Deserialize)]
pub(super) struct JoinReply<'a> {
    pub session: u64,
    /// Number of the first slot; the others follow.
    pub first_slot: u32,
    /// Current mixture version.
    pub mixture_version: u64,
    /// Configuration for starting walkers.
    #[serde(serialize_with = "crate::bytes::serialize")]
    pub setup: &'a [u8],
}
