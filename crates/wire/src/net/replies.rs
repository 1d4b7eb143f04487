//! Replies to requests of agents.

use tokio::task::JoinSet;
use zenoh::query::Query;

use super::message::{AgentReply, ORCHESTRATOR};
use crate::block::{BlockError, CandidateBlock};
use crate::control::encode;
use crate::protocol::message::{Answer, SenderId};
use crate::protocol::server_session::ServerTransport;

/// What a transport does for the server of agents, besides answers about slots.
pub(super) trait AgentTransport: ServerTransport {
    /// Replies to a request. If the reply is lost, the agent repeats its request.
    fn reply(&mut self, request: &Self::Request, reply: &AgentReply<'_>);
}

/// The replies being sent. A broken link delays only its own.
#[derive(Default)]
pub(super) struct Replies(JoinSet<()>);

impl Replies {
    /// If the reply is lost, the agent repeats its request.
    fn spawn(&mut self, query: &Query, reply: Vec<u8>) {
        while self.0.try_join_next().is_some() {}
        let query = query.clone();
        self.0.spawn(async move { drop(query.reply(ORCHESTRATOR, reply).await) });
    }

    /// Waits until all replies are sent.
    pub(super) async fn finish(mut self) {
        while self.0.join_next().await.is_some() {}
    }
}

impl AgentTransport for Replies {
    fn reply(&mut self, query: &Query, reply: &AgentReply<'_>) {
        self.spawn(query, encode(reply));
    }
}

impl ServerTransport for Replies {
    type Request = Query;

    /// Each query has one reply, which should be the decision.
    const HOLDS_POLLS: bool = true;

    fn encode(answer: Answer<'_>) -> Vec<u8> {
        encode(&AgentReply::Answer(answer))
    }

    fn send(&mut self, _: SenderId, query: &Query, answer: &[u8]) {
        self.spawn(query, answer.to_vec());
    }

    fn candidate(&mut self, _: SenderId, _: &Query, block: &[u8]) -> Result<CandidateBlock, BlockError> {
        CandidateBlock::from_bytes(block)
    }
}
