//! The protocol of agents over any carrier of single messages: both ends, without ports, threads or a clock. A simulation
//! carries the messages. It stands here because messages and sessions are private to this package.

use std::collections::VecDeque;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};

use calm::Mixture;
use tokio_util::sync::CancellationToken;
use zerocopy::IntoBytes;

use super::link_error::{decode_reply, unexpected};
use super::message::{AgentReply, AgentRequest};
use super::mixture_fetch::MixtureFetch;
use super::replies::AgentTransport;
use super::session::{AgentMixtures, AgentSession};
use super::slot::SlotAnswer;
use super::{AgentBootstrap, AgentEvent, AgentInfo, LinkError, Slot, SlotReport};
use crate::block::{BlockError, CandidateBlock};
use crate::control::encode;
use crate::messages::Assignment;
use crate::protocol::frame;
use crate::protocol::message::{Answer, SenderId};
use crate::protocol::server_session::ServerTransport;
use crate::transport::{Incoming, WorkItem};

/// The orchestrator's end: a session with the agents of one run. Requests have numbers, and so have their replies.
pub struct AgentDatagramServer(AgentSession<ReplyQueue>);

/// Replies that are not carried away yet, with the numbers of their requests.
#[derive(Default)]
struct ReplyQueue(VecDeque<(u64, Vec<u8>)>);

impl AgentTransport for ReplyQueue {
    fn reply(&mut self, request: &u64, reply: &AgentReply<'_>) {
        self.0.push_back((*request, encode(reply)));
    }
}

impl ServerTransport for ReplyQueue {
    type Request = u64;

    const HOLDS_POLLS: bool = true;

    fn encode(answer: Answer<'_>) -> Vec<u8> {
        encode(&AgentReply::Answer(answer))
    }

    fn send(&mut self, _: SenderId, request: &u64, answer: &[u8]) {
        self.0.push_back((*request, answer.to_vec()));
    }

    fn candidate(&mut self, _: SenderId, _: &u64, block: &[u8]) -> Result<CandidateBlock, BlockError> {
        CandidateBlock::from_bytes(block)
    }
}

impl AgentDatagramServer {
    /// The server of a run, which `session` distinguishes from others. Agents without heartbeat for `agent_timeout` are
    /// lost.
    pub fn new(
        session: u64,
        agent_timeout: Duration,
        bootstrap: AgentBootstrap,
        mixture: Arc<Mixture>,
        original: &Mixture,
        stopping: CancellationToken,
    ) -> Self {
        let mixtures = AgentMixtures::new(mixture, original);
        Self(AgentSession::new(session, ReplyQueue::default(), agent_timeout, bootstrap, mixtures, stopping))
    }

    /// Handles a request.
    pub fn receive(&mut self, request: u64, datagram: &[u8]) {
        self.0.receive(&request, datagram);
    }

    /// Handles the appearance or disappearance of an agent's heartbeat.
    pub fn set_alive(&mut self, id: &str, alive: bool, now: Instant) {
        self.0.set_alive(id, alive, now);
    }

    /// Removes agents that were unresponsive for too long.
    pub fn expire(&mut self, now: Instant) {
        self.0.expire(now);
    }

    /// Whether no agent is registered.
    pub fn has_no_agents(&self) -> bool {
        self.0.has_no_agents()
    }

    /// Encodes the answers to the offers that the reactor has decided. `work` sees each assignment first.
    pub fn answer_decided(&mut self, mut work: impl FnMut(&WorkItem)) {
        let mut context = Context::from_waker(Waker::noop());
        while let Poll::Ready(decision) = self.0.slots.poll_decision(&mut context) {
            decision.work.iter().for_each(&mut work);
            self.0.handle_decision(decision);
        }
    }

    /// The messages for the reactor that arrived since the last call.
    pub fn take_incoming(&mut self) -> Vec<Incoming> {
        self.0.slots.outbox.drain(..).collect()
    }

    /// The replies since the last call, with the numbers of their requests.
    pub fn take_replies(&mut self) -> Vec<(u64, Vec<u8>)> {
        self.0.slots.transport.0.drain(..).collect()
    }

    /// What happened to agents since the last call.
    pub fn take_events(&mut self) -> Vec<AgentEvent> {
        std::mem::take(&mut self.0.events)
    }
}

/// A registration of an agent.
#[derive(Debug)]
pub struct AgentRegistration {
    /// Session of the orchestrator.
    pub session: u64,
    /// Current mixture version.
    pub mixture_version: u64,
    /// The slots of the agent.
    pub slots: Vec<Slot>,
    /// What it starts its walkers with.
    pub setup: Vec<u8>,
}

impl AgentRegistration {
    /// The request to join.
    pub fn request(agent: &AgentInfo) -> Vec<u8> {
        message(&AgentRequest::Join(agent.clone()))
    }

    /// Reads the reply to it.
    ///
    /// # Errors
    /// The agent is rejected, or the reply is damaged.
    pub fn read(agent: &AgentInfo, reply: &[u8]) -> Result<Self, LinkError> {
        let AgentReply::Joined(joined) = decode_reply(reply)? else { return Err(unexpected("join")) };
        let (session, first) = (joined.session, joined.first_slot);
        let slots = (first..first + agent.slots()).map(|number| Slot::new(session, number)).collect();
        let setup = joined.setup.to_vec();
        Ok(Self { session, mixture_version: joined.mixture_version, slots, setup })
    }
}

/// The request of an agent to leave.
pub fn leave(session: u64, agent: &AgentInfo) -> Vec<u8> {
    message(&AgentRequest::Leave { session, id: agent.id.clone() })
}

/// The request for the mixture that an agent has joined with.
pub fn first_mixture(session: u64, version: u64) -> Vec<u8> {
    message(&MixtureFetch::new(session, None, version).request())
}

/// Reads the reply to it, which must contain the whole mixture.
///
/// # Errors
/// The agent must join again, or the reply is damaged or too short.
pub fn read_first_mixture(reply: &[u8]) -> Result<Mixture, LinkError> {
    let mixture = MixtureFetch::new(0, None, 0).receive(reply)?;
    mixture.ok_or_else(|| LinkError::InvalidReply("a part of the mixture is missing".to_owned()))
}

fn message(request: &AgentRequest<'_>) -> Vec<u8> {
    frame::with_block(&encode(request), None).as_bytes().to_vec()
}

/// One exchange about a slot: its report is delivered, then the next assignment comes with its mixture.
pub struct SlotExchange {
    slot: Slot,
    report: SlotReport,
    offered: bool,
    /// The assignment whose mixture is being fetched.
    fetch: Option<(Box<Assignment>, MixtureFetch)>,
}

/// What follows from a reply.
#[derive(Debug)]
pub enum SlotStep {
    /// The next request is due.
    Continue,
    /// The next assignment; `None` if there is no more work.
    Done(Option<Box<WorkItem>>),
}

impl SlotExchange {
    /// Begins the next offer of the slot.
    pub fn new(mut slot: Slot, report: SlotReport) -> Self {
        slot.begin_offer();
        Self { slot, report, offered: false, fetch: None }
    }

    /// The next request: the offer, a question about it, or one for a part of the mixture.
    pub fn request(&mut self) -> Vec<u8> {
        if let Some((_, fetch)) = &self.fetch {
            return message(&fetch.request());
        }
        if std::mem::replace(&mut self.offered, true) {
            return frame::with_block(&self.slot.poll(), None).as_bytes().to_vec();
        }
        let (offer, candidate) = self.slot.offer(&self.report);
        frame::with_block(&offer, candidate).as_bytes().to_vec()
    }

    /// Reads a reply. `mixtures` are those that the agent has, the newest last.
    ///
    /// # Errors
    /// As those of [`Slot::exchange`].
    pub fn receive(
        &mut self,
        reply: &[u8],
        mixtures: &mut VecDeque<Arc<Mixture>>,
    ) -> Result<SlotStep, LinkError> {
        if let Some((assignment, mut fetch)) = self.fetch.take() {
            let Some(mixture) = fetch.receive(reply)? else {
                self.fetch = Some((assignment, fetch));
                return Ok(SlotStep::Continue);
            };
            let mixture = Arc::new(mixture);
            mixtures.push_back(Arc::clone(&mixture));
            return Ok(SlotStep::Done(Some(Box::new(WorkItem { assignment: *assignment, mixture }))));
        }
        match self.slot.read(reply)? {
            SlotAnswer::Assignment(assignment, version) => {
                if let Some(mixture) = mixtures.iter().find(|mixture| mixture.version() == version) {
                    let mixture = Arc::clone(mixture);
                    return Ok(SlotStep::Done(Some(Box::new(WorkItem { assignment: *assignment, mixture }))));
                }
                let base = mixtures.back().cloned();
                self.fetch = Some((assignment, MixtureFetch::new(self.slot.session(), base, version)));
            }
            SlotAnswer::Shutdown => return Ok(SlotStep::Done(None)),
            SlotAnswer::Pending => {}
            SlotAnswer::Unknown => self.offered = false,
        }
        Ok(SlotStep::Continue)
    }

    /// The slot and its report, at the end of the exchange.
    pub fn into_parts(self) -> (Slot, SlotReport) {
        (self.slot, self.report)
    }
}
