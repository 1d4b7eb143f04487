//! What agents ask the orchestrator, and its answers: control messages (see [`crate::control`]), a candidate beside an
//! offer as over shared memory.

use serde::{Deserialize, Serialize};

use super::delta::MixtureDelta;
use crate::protocol::message::{Answer, Envelope, SenderId};

/// The orchestrator answers under this key.
pub(super) const ORCHESTRATOR: &str = "calmwalk/orchestrator";
/// The signs of life of agents: `calmwalk/agents/ID`.
pub(super) const AGENTS: &str = "calmwalk/agents";

/// Tells an agent from all others, also from one of the same host or before a restart: 32 hexadecimal digits.
pub type AgentId = String;

/// Who wants to take part.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Agent {
    /// Made up at its start.
    pub id: AgentId,
    /// Name of its host, for people.
    pub host: String,
    /// Its process there.
    pub pid: u32,
    /// Version of its program.
    pub program_version: String,
    /// Turns that it works on at the same time.
    pub walkers: u32,
    /// Turns that it takes beyond those.
    pub prefetch: u32,
}

impl Agent {
    /// Turns that it may have in hand.
    pub fn slots(&self) -> u32 {
        self.walkers.saturating_add(self.prefetch)
    }
}

#[derive(Serialize, Deserialize)]
pub(super) enum Request<'a> {
    /// May I take part?
    Join(Agent),
    /// About a slot: what a walker says.
    #[serde(borrow)]
    Envelope(Envelope<'a>),
    /// About a slot, in place of an offer: the walker that worked on its turn is no more.
    Lost { sender: SenderId, sequence: u64, crashed: bool },
    /// The mixture of this version: what differs from the one that is there already, but for the first so many components.
    Mixture { session: u64, have: Option<u64>, wanted: u64, skip: u32 },
    /// A part of a file that walkers need.
    File { session: u64, hash: String, offset: u64 },
    /// Are you there, and am I to go on?
    Ping { session: u64 },
    /// I leave; turns in my hands are free.
    Leave { session: u64, id: AgentId },
}

#[derive(Serialize, Deserialize)]
pub(super) enum Reply<'a> {
    #[serde(borrow)]
    Joined(JoinReply<'a>),
    /// To a envelope or a loss.
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
    /// Not from you: you have been taken for dead, or this is another run of the orchestrator. Join anew.
    RejoinRequired(String),
    /// This cannot be answered.
    Rejected(String),
}

/// A place among the walkers.
#[derive(Serialize, Deserialize)]
pub(super) struct JoinReply<'a> {
    pub session: u64,
    /// Number of the first slot; the others follow.
    pub first_slot: u32,
    /// The mixture now.
    pub mixture_version: u64,
    /// What walkers are started with.
    #[serde(serialize_with = "crate::bytes::serialize")]
    pub setup: &'a [u8],
}
