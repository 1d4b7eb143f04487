//! State of the server: handles requests and decisions.

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use calm::Mixture;
use futures_util::future::{AbortHandle, abortable};
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use super::agent_server::AgentEvent;
use super::delta::{self, MixtureDelta};
use super::files::Files;
use super::message::{Agent, JoinReply, ORCHESTRATOR, Reply, Request};
use super::registry::{AgentRegistry, RegisteredAgent};
use crate::block::CandidateBlock;
use crate::control::{EncodedReport, decode, encode};
use crate::ids::WalkId;
use crate::messages::Progress;
use crate::protocol::frame;
use crate::protocol::message::{Answer, AnswerBody, Envelope, Payload, SenderId, attach_candidate};
use crate::protocol::rejected::RejectedMessage;
use crate::protocol::sequence::{OfferStatus, SenderMismatch, SequenceTracker};
use crate::transport::{Incoming, WorkItem};

/// Each slot has one incarnation.
const INCARNATION: u32 = 1;
/// Maximum number of progress messages queued for the reactor.
const MAX_QUEUED_PROGRESS: usize = 64;
/// Number of recent mixture versions to keep as bases of deltas.
const MAX_VERSIONS: usize = 64;

/// Resolves to the reactor's decision about a slot.
pub(super) type PendingDecision = Pin<Box<dyn Future<Output = (u32, Option<WorkItem>)> + Send>>;

pub(super) struct ServerSession {
    /// Messages for the reactor.
    pub outbox: VecDeque<Incoming>,
    /// Events to be reported.
    pub events: Vec<AgentEvent>,
    session: u64,
    setup: Vec<u8>,
    /// Whether agents should stop.
    stopping: CancellationToken,
    registry: AgentRegistry,
    sequences: SequenceTracker,
    /// Routes of answers, and the mixture of each assignment, kept until its report.
    slots: BTreeMap<u32, SlotConnection>,
    /// The newest version last.
    versions: VecDeque<Arc<Mixture>>,
    /// Answers being sent. A broken link delays only its own.
    sending: JoinSet<()>,
}

#[derive(Default)]
struct SlotConnection {
    route: Option<Query>,
    mixture: Option<Arc<Mixture>>,
    /// Aborts waiting for the reactor's decision.
    abort_decision: Option<AbortHandle>,
}

impl ServerSession {
    pub(super) fn new(
        session: u64,
        agent_timeout: Duration,
        setup: Vec<u8>,
        mixture: Arc<Mixture>,
        stopping: CancellationToken,
    ) -> Self {
        Self {
            outbox: VecDeque::new(),
            events: Vec::new(),
            session,
            setup,
            stopping,
            registry: AgentRegistry::new(agent_timeout),
            sequences: SequenceTracker::new(session),
            slots: BTreeMap::new(),
            versions: VecDeque::from([mixture]),
            sending: JoinSet::new(),
        }
    }

    /// Handles a request. If it is an offer, returns the reactor's pending decision.
    pub(super) fn receive(&mut self, query: Query, files: &Files) -> Option<PendingDecision> {
        while self.sending.try_join_next().is_some() {}
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        let result = self.dispatch(&query, &payload, files);
        result.unwrap_or_else(|why| {
            let reason = why.to_string();
            if let RejectedMessage::SenderMismatch(_) = why {
                // The agent will join again.
                self.send(query, &Reply::RejoinRequired(reason));
            } else {
                self.send(query, &Reply::Rejected(reason.clone()));
                self.events.push(AgentEvent::MessageRejected(reason));
            }
            None
        })
    }

    fn dispatch(
        &mut self,
        query: &Query,
        payload: &[u8],
        files: &Files,
    ) -> Result<Option<PendingDecision>, RejectedMessage> {
        let (control, block) = frame::split(payload)?;
        match decode(control)? {
            Request::Join(agent) => self.join(query, agent)?,
            Request::Envelope(Envelope { sender, payload }) => match payload {
                Payload::Offer { sequence, report } => {
                    return self.offer(query, sender, sequence, report, block);
                }
                Payload::Poll { sequence } => self.poll(query, sender, sequence)?,
                Payload::Progress(walk, progress) => {
                    self.sequences.check_sender(sender)?;
                    self.progress(walk, progress.into_owned());
                }
            },
            Request::Lost { sender, sequence, crashed } => {
                return self.lost(query, sender, sequence, crashed);
            }
            Request::Mixture { session, have, wanted, skip } => {
                self.check_session(session)?;
                self.mixture(query, have, wanted, skip)?;
            }
            Request::File { session, hash, offset } => {
                self.check_session(session)?;
                let (length, part) = files.part(&hash, offset)?.ok_or(RejectedMessage::File(hash))?;
                self.send(query.clone(), &Reply::File { length, part: &part });
            }
            Request::Ping { session } => {
                self.check_session(session)?;
                let stopping = self.stopping.is_cancelled();
                self.send(query.clone(), &Reply::Pong { stopping });
            }
            Request::Leave { session, id } => {
                self.check_session(session)?;
                if let Some(member) = self.registry.leave(&id) {
                    self.agent_lost(&member);
                    self.events.push(AgentEvent::Left(member.agent));
                }
                self.send(query.clone(), &Reply::Left);
            }
        }
        Ok(None)
    }

    fn check_session(&self, found: u64) -> Result<(), SenderMismatch> {
        let expected = self.session;
        if found == expected { Ok(()) } else { Err(SenderMismatch::Session { found, expected }) }
    }

    /// An agent that repeats its request because the answer was lost gets new slots.
    fn join(&mut self, query: &Query, agent: Agent) -> Result<(), RejectedMessage> {
        if let Some(member) = self.registry.leave(&agent.id) {
            self.agent_lost(&member);
        }
        self.events.push(AgentEvent::Joined(agent.clone()));
        let member = self.registry.join(agent).ok_or(RejectedMessage::Numbers)?;
        let first_slot = member.first_slot;
        for slot in member.slots() {
            self.sequences.expect(slot, INCARNATION);
            self.slots.insert(slot, SlotConnection::default());
        }
        let mixture_version = self.newest().version();
        let joined = JoinReply { session: self.session, first_slot, mixture_version, setup: &self.setup };
        let reply = encode(&Reply::Joined(joined));
        self.send_encoded(query.clone(), &reply);
        Ok(())
    }

    fn newest(&self) -> &Arc<Mixture> {
        self.versions.back().expect("the first version is not removed before another is added")
    }

    fn offer(
        &mut self,
        query: &Query,
        sender: SenderId,
        sequence: u64,
        report: Option<EncodedReport<'_>>,
        block: &[u8],
    ) -> Result<Option<PendingDecision>, RejectedMessage> {
        if !self.is_new(query, sender, sequence)? {
            return Ok(None);
        }
        let candidate = (!block.is_empty()).then(|| CandidateBlock::from_bytes(block)).transpose()?;
        let report = attach_candidate(report, candidate)?;
        Ok(Some(self.begin_offer(sender.walker, report)))
    }

    /// Handled like an empty offer, after the loss of the walker is forwarded.
    fn lost(
        &mut self,
        query: &Query,
        sender: SenderId,
        sequence: u64,
        crashed: bool,
    ) -> Result<Option<PendingDecision>, RejectedMessage> {
        if !self.is_new(query, sender, sequence)? {
            return Ok(None);
        }
        self.outbox.push_back(Incoming::Lost { walker: sender.walker, crashed });
        Ok(Some(self.begin_offer(sender.walker, None)))
    }

    /// Whether an offer is new. If it has been answered, sends the answer again. The latest request takes the answer.
    fn is_new(&mut self, query: &Query, sender: SenderId, sequence: u64) -> Result<bool, RejectedMessage> {
        let (new, again) = match self.sequences.offer(sender, sequence)? {
            OfferStatus::Answered(answer) => (false, Some(answer.to_vec())),
            OfferStatus::Pending => (false, None),
            OfferStatus::New | OfferStatus::Unknown => (true, None),
        };
        match again {
            Some(answer) => self.send_encoded(query.clone(), &answer),
            None => self.set_route(sender.walker, query),
        }
        Ok(new)
    }

    fn set_route(&mut self, slot: u32, query: &Query) {
        if let Some(slot_connection) = self.slots.get_mut(&slot) {
            slot_connection.route = Some(query.clone());
        }
    }

    fn begin_offer(&mut self, slot: u32, report: Option<crate::messages::Report>) -> PendingDecision {
        self.sequences.begin(slot);
        let (reply, decision) = oneshot::channel();
        let (decision, give_up) = abortable(decision);
        if let Some(slot_connection) = self.slots.get_mut(&slot) {
            slot_connection.mixture = None;
            slot_connection.abort_decision = Some(give_up);
        }
        self.outbox.push_back(Incoming::Idle { walker: slot, report, reply });
        Box::pin(async move { (slot, decision.await.ok().and_then(Result::ok).flatten()) })
    }

    fn poll(&mut self, query: &Query, sender: SenderId, sequence: u64) -> Result<(), RejectedMessage> {
        match self.sequences.poll(sender, sequence)? {
            OfferStatus::Answered(answer) => {
                let answer = answer.to_vec();
                self.send_encoded(query.clone(), &answer);
            }
            OfferStatus::Pending => self.set_route(sender.walker, query),
            OfferStatus::New | OfferStatus::Unknown => {
                let answer = Answer { sequence, body: AnswerBody::Unknown };
                self.send(query.clone(), &Reply::Answer(answer));
            }
        }
        Ok(())
    }

    /// May drop the message.
    fn progress(&mut self, walk: WalkId, progress: Progress) {
        if self.outbox.len() < MAX_QUEUED_PROGRESS {
            self.outbox.push_back(Incoming::Progress(walk, progress));
        }
    }

    fn mixture(
        &mut self,
        query: &Query,
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
        self.send(query.clone(), &Reply::Mixture(part));
        Ok(())
    }

    /// A version that agents may need: a recent one, or one of a current assignment.
    fn version(&self, version: u64) -> Option<&Arc<Mixture>> {
        let promised = self.slots.values().filter_map(|slot_connection| slot_connection.mixture.as_ref());
        self.versions.iter().rev().chain(promised).find(|mixture| mixture.version() == version)
    }

    /// Answers the pending offer of a slot.
    pub(super) fn handle_decision(&mut self, slot: u32, work: Option<WorkItem>) {
        let Some((_, sequence)) = self.sequences.pending(slot) else { return };
        let body = match &work {
            Some(WorkItem { assignment, mixture }) => AnswerBody::Assignment {
                mixture_version: mixture.version(),
                assignment: Cow::Borrowed(assignment),
            },
            None => AnswerBody::Shutdown,
        };
        let answer = encode(&Reply::Answer(Answer { sequence, body }));
        if let Some(WorkItem { mixture, .. }) = &work
            && mixture.version() > self.newest().version()
        {
            self.versions.push_back(Arc::clone(mixture));
            self.versions.drain(..self.versions.len().saturating_sub(MAX_VERSIONS));
        }
        let Some(slot_connection) = self.slots.get_mut(&slot) else { return };
        slot_connection.mixture = work.map(|work| work.mixture);
        if let Some(route) = slot_connection.route.take() {
            self.send_encoded(route, &answer);
        }
        self.sequences.set_answer(slot, answer);
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

    /// Rejects all further messages about the agent's slots. Aborts pending decisions before the reactor learns of the
    /// loss, so that an assignment sent in the meantime is recognized as lost either way.
    fn agent_lost(&mut self, member: &RegisteredAgent) {
        for slot in member.slots() {
            self.sequences.remove(slot);
            let slot_connection = self.slots.remove(&slot);
            slot_connection
                .and_then(|slot_connection| slot_connection.abort_decision)
                .inspect(AbortHandle::abort);
            self.outbox.push_back(Incoming::Lost { walker: slot, crashed: false });
        }
    }

    fn send(&mut self, query: Query, reply: &Reply<'_>) {
        self.send_encoded(query, &encode(reply));
    }

    /// If the reply is lost, the agent repeats its request.
    fn send_encoded(&mut self, query: Query, reply: &[u8]) {
        let reply = reply.to_vec();
        self.sending.spawn(async move { drop(query.reply(ORCHESTRATOR, reply).await) });
    }

    /// Whether no agent is registered.
    pub(super) fn has_no_agents(&self) -> bool {
        self.registry.is_empty()
    }

    /// Waits until all answers are sent.
    pub(super) async fn finish(mut self) {
        while self.sending.join_next().await.is_some() {}
    }
}
