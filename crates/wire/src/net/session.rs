//! State of the server: handles requests of agents and decisions about their slots.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use calm::Mixture;
use tokio_util::sync::CancellationToken;

use super::AgentBootstrap;
use super::agent_event::AgentEvent;
use super::delta::{self, MixtureDelta};
use super::files::Files;
use super::message::{AgentInfo, AgentReply, AgentRequest, JoinReply};
use super::registry::{AgentRegistry, RegisteredAgent};
use super::replies::{AgentTransport, Replies};
use crate::control::decode;
use crate::mixture::ORIGINAL;
use crate::protocol::frame;
use crate::protocol::rejected::RejectedMessage;
use crate::protocol::sequence::SenderMismatch;
use crate::protocol::server_session::{OfferDecision, ServerSession};
use crate::transport::WorkItem;

/// Each slot has one incarnation.
const INCARNATION: u32 = 1;
/// Number of recent mixture versions to keep as bases of deltas.
const MAX_VERSIONS: usize = 64;

pub(super) struct AgentSession<T: AgentTransport> {
    /// The slots of all agents.
    pub(super) slots: ServerSession<T>,
    /// Events to be reported.
    pub(super) events: Vec<AgentEvent>,
    session: u64,
    setup: Vec<u8>,
    files: Files,
    /// Whether agents should stop.
    stopping: CancellationToken,
    registry: AgentRegistry,
    mixtures: AgentMixtures,
}

/// The mixtures that agents may fetch, besides those of their assignments.
pub(super) struct AgentMixtures {
    /// As [`ORIGINAL`].
    original: Arc<Mixture>,
    /// The newest version last.
    versions: VecDeque<Arc<Mixture>>,
}

impl AgentMixtures {
    pub(super) fn new(newest: Arc<Mixture>, original: &Mixture) -> Self {
        Self { original: Arc::new(original.at_version(ORIGINAL)), versions: VecDeque::from([newest]) }
    }

    fn newest(&self) -> &Arc<Mixture> {
        self.versions.back().expect("the first version is not removed before another is added")
    }

    /// Adds a version if it is a newer one.
    fn add(&mut self, mixture: &Arc<Mixture>) {
        if mixture.version() > self.newest().version() {
            self.versions.push_back(Arc::clone(mixture));
            self.versions.drain(..self.versions.len().saturating_sub(MAX_VERSIONS));
        }
    }
}

impl<T: AgentTransport> AgentSession<T> {
    pub(super) fn new(
        session: u64,
        transport: T,
        agent_timeout: Duration,
        AgentBootstrap { setup, files }: AgentBootstrap,
        mixtures: AgentMixtures,
        stopping: CancellationToken,
    ) -> Self {
        Self {
            slots: ServerSession::new(session, transport),
            events: Vec::new(),
            session,
            setup,
            files: Files::new(files),
            stopping,
            registry: AgentRegistry::new(agent_timeout),
            mixtures,
        }
    }

    /// Handles a request.
    pub(super) fn receive(&mut self, query: &T::Request, payload: &[u8]) {
        let Err(why) = self.dispatch(query, payload) else { return };
        let reason = why.to_string();
        if let RejectedMessage::SenderMismatch(_) = why {
            // The agent will join again.
            self.reply(query, &AgentReply::RejoinRequired(reason));
        } else {
            self.reply(query, &AgentReply::Rejected(reason.clone()));
            self.events.push(AgentEvent::MessageRejected(reason));
        }
    }

    fn dispatch(&mut self, query: &T::Request, payload: &[u8]) -> Result<(), RejectedMessage> {
        let (control, block) = frame::split(payload)?;
        match decode(control)? {
            AgentRequest::Join(agent) => self.join(query, agent)?,
            AgentRequest::Envelope(envelope) => self.slots.receive(*envelope, query, block)?,
            AgentRequest::Lost { sender, sequence, crashed } => {
                self.slots.receive_loss(sender, sequence, crashed, query)?;
            }
            AgentRequest::Mixture { session, have, wanted, skip } => {
                self.check_session(session)?;
                self.mixture(query, have, wanted, skip)?;
            }
            AgentRequest::File { session, hash, offset } => {
                self.check_session(session)?;
                let part = self.files.part(&hash, offset)?;
                let (length, part) = part.ok_or(RejectedMessage::File(hash))?;
                self.reply(query, &AgentReply::File { length, part: &part });
            }
            AgentRequest::Ping { session } => {
                self.check_session(session)?;
                let stopping = self.stopping.is_cancelled();
                self.reply(query, &AgentReply::Pong { stopping });
            }
            AgentRequest::Leave { session, id } => {
                self.check_session(session)?;
                if let Some(member) = self.registry.leave(&id) {
                    self.agent_lost(&member);
                    self.events.push(AgentEvent::Left(member.agent));
                }
                self.reply(query, &AgentReply::Left);
            }
        }
        Ok(())
    }

    fn reply(&mut self, query: &T::Request, reply: &AgentReply<'_>) {
        self.slots.transport.reply(query, reply);
    }

    fn check_session(&self, found: u64) -> Result<(), SenderMismatch> {
        let expected = self.session;
        if found == expected { Ok(()) } else { Err(SenderMismatch::Session { found, expected }) }
    }

    /// An agent that repeats its request because the answer was lost gets new slots.
    fn join(&mut self, query: &T::Request, agent: AgentInfo) -> Result<(), RejectedMessage> {
        if let Some(member) = self.registry.leave(&agent.id) {
            self.agent_lost(&member);
        }
        self.events.push(AgentEvent::Joined(agent.clone()));
        let member = self.registry.join(agent).ok_or(RejectedMessage::Numbers)?;
        for slot in member.slots() {
            self.slots.expect(slot, INCARNATION);
        }
        let (first_slot, mixture_version) = (member.first_slot, self.mixtures.newest().version());
        let joined = JoinReply { session: self.session, first_slot, mixture_version, setup: &self.setup };
        self.slots.transport.reply(query, &AgentReply::Joined(joined));
        Ok(())
    }

    fn mixture(
        &mut self,
        query: &T::Request,
        have: Option<u64>,
        wanted: u64,
        skip: u32,
    ) -> Result<(), RejectedMessage> {
        let to = Arc::clone(self.version(wanted).ok_or(RejectedMessage::Version(wanted))?);
        let from = have.and_then(|have| self.version(have)).map(Arc::clone);
        let (total, keys, bytes) = delta::part(from.as_deref(), &to, skip);
        let (version, shape) = (to.version(), delta::shape(&to));
        let from = from.map(|from| from.version());
        let part = MixtureDelta { version, from, shape, total, skip, keys, bytes: &bytes };
        self.reply(query, &AgentReply::Mixture(part));
        Ok(())
    }

    /// A version that agents may need: a recent one, one of a current assignment, or the original.
    fn version(&self, version: u64) -> Option<&Arc<Mixture>> {
        let AgentMixtures { original, versions } = &self.mixtures;
        let mut all = versions.iter().rev().chain(self.slots.mixtures()).chain([original]);
        all.find(|mixture| mixture.version() == version)
    }

    /// Answers the pending offer of a slot.
    pub(super) fn handle_decision(&mut self, decision: OfferDecision<T::Request>) {
        if let Some(WorkItem { mixture, .. }) = &decision.work {
            self.mixtures.add(mixture);
        }
        self.slots.answer(decision);
    }

    /// Handles the appearance or disappearance of an agent's heartbeat.
    pub(super) fn set_alive(&mut self, id: &str, alive: bool, now: Instant) {
        let event = if alive { AgentEvent::Recovered } else { AgentEvent::Unresponsive };
        self.events.extend(self.registry.set_alive(id, alive, now).cloned().map(event));
    }

    /// Removes agents that were unresponsive for too long.
    pub(super) fn expire(&mut self, now: Instant) {
        for member in self.registry.expire(now) {
            self.agent_lost(&member);
            self.events.push(AgentEvent::Lost(member.agent));
        }
    }

    fn agent_lost(&mut self, member: &RegisteredAgent) {
        for slot in member.slots() {
            self.slots.remove(slot, false);
        }
    }

    /// Whether no agent is registered.
    pub(super) fn has_no_agents(&self) -> bool {
        self.registry.is_empty()
    }
}

impl AgentSession<Replies> {
    /// Waits until all answers are sent.
    pub(super) async fn finish(self) {
        self.slots.transport.finish().await;
    }
}
