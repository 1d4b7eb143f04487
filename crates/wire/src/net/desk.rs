//! The hub's work between two waits: what is said to whom.

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use calm::Mixture;
use futures_util::future::{AbortHandle, abortable};
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use super::changes::{self, Changes};
use super::files::Files;
use super::hub::AgentEvent;
use super::message::{Agent, ORCHESTRATOR, Place, Reply, Request};
use super::roster::{Member, Roster};
use crate::block::CandidateBlock;
use crate::control::{EncodedReport, seal, unseal};
use crate::exchange::conversation::{Conversations, Next, Stranger};
use crate::exchange::dropped::Dropped;
use crate::exchange::frame;
use crate::exchange::message::{Answer, Caller, Decision, Letter, Words, complete};
use crate::ids::WalkId;
use crate::messages::Progress;
use crate::transport::{Incoming, Work};

/// Slots have one incarnation each.
const INCARNATION: u32 = 1;
/// More progress than this is not kept for a busy reactor.
const PROGRESS_KEPT: usize = 64;
/// Versions of the mixture that an agent may be behind without being sent the whole.
const VERSIONS: usize = 64;

/// The reactor's decision about a slot, when there is one.
pub(super) type Deciding = Pin<Box<dyn Future<Output = (u32, Option<Work>)> + Send>>;

pub(super) struct Desk {
    /// What the reactor has not taken yet.
    pub outbox: VecDeque<Incoming>,
    /// What nobody has been told yet.
    pub events: Vec<AgentEvent>,
    session: u64,
    setup: Vec<u8>,
    /// Whether agents are to stop.
    stopping: Arc<AtomicBool>,
    roster: Roster,
    conversations: Conversations,
    /// Where answers go, and the mixture of each turn, kept until it is reported.
    lines: BTreeMap<u32, Line>,
    /// The newest version last.
    versions: VecDeque<Arc<Mixture>>,
    /// Answers on their way: a link that is down holds up none but its own.
    sending: JoinSet<()>,
}

#[derive(Default)]
struct Line {
    route: Option<Query>,
    mixture: Option<Arc<Mixture>>,
    /// Gives up waiting for the reactor.
    deciding: Option<AbortHandle>,
}

impl Desk {
    pub(super) fn new(
        session: u64,
        patience: Duration,
        setup: Vec<u8>,
        mixture: Arc<Mixture>,
        stopping: Arc<AtomicBool>,
    ) -> Self {
        Self {
            outbox: VecDeque::new(),
            events: Vec::new(),
            session,
            setup,
            stopping,
            roster: Roster::new(patience),
            conversations: Conversations::new(session),
            lines: BTreeMap::new(),
            versions: VecDeque::from([mixture]),
            sending: JoinSet::new(),
        }
    }

    /// Takes in a question. If it brings an offer, the reactor's decision about it is to be waited for.
    pub(super) fn receive(&mut self, query: Query, files: &Files) -> Option<Deciding> {
        while self.sending.try_join_next().is_some() {}
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        let result = self.listen(&query, &payload, files);
        result.unwrap_or_else(|why| {
            let said = why.to_string();
            if let Dropped::Stranger(_) = why {
                // Of an agent that will join anew.
                self.send(query, &Reply::Stranger(said));
            } else {
                self.send(query, &Reply::Refused(said.clone()));
                self.events.push(AgentEvent::Dropped(said));
            }
            None
        })
    }

    fn listen(&mut self, query: &Query, payload: &[u8], files: &Files) -> Result<Option<Deciding>, Dropped> {
        let (control, block) = frame::split(payload)?;
        match unseal(control)? {
            Request::Join(agent) => self.join(query, agent)?,
            Request::Letter(Letter { caller, words }) => match words {
                Words::Offer { sequence, report } => {
                    return self.offer(query, caller, sequence, report, block);
                }
                Words::Ask { sequence } => self.ask(query, caller, sequence)?,
                Words::Progress(walk, progress) => {
                    self.conversations.check(caller)?;
                    self.progress(walk, progress.into_owned());
                }
            },
            Request::Lost { caller, sequence, fault } => {
                return self.lost(query, caller, sequence, fault);
            }
            Request::Mixture { session, have, wanted, skip } => {
                self.check(session)?;
                self.mixture(query, have, wanted, skip)?;
            }
            Request::File { session, hash, offset } => {
                self.check(session)?;
                let (length, part) = files.part(&hash, offset)?.ok_or(Dropped::File(hash))?;
                self.send(query.clone(), &Reply::File { length, part: &part });
            }
            Request::Here { session } => {
                self.check(session)?;
                let stopping = self.stopping.load(Ordering::Relaxed);
                self.send(query.clone(), &Reply::Here { stopping });
            }
            Request::Leave { session, id } => {
                self.check(session)?;
                if let Some(member) = self.roster.leave(&id) {
                    self.gone(&member);
                    self.events.push(AgentEvent::Left(member.agent));
                }
                self.send(query.clone(), &Reply::Left);
            }
        }
        Ok(None)
    }

    fn check(&self, found: u64) -> Result<(), Stranger> {
        let expected = self.session;
        if found == expected { Ok(()) } else { Err(Stranger::Session { found, expected }) }
    }

    /// An agent that asks again, because the answer was lost, gets new slots.
    fn join(&mut self, query: &Query, agent: Agent) -> Result<(), Dropped> {
        if let Some(member) = self.roster.leave(&agent.id) {
            self.gone(&member);
        }
        self.events.push(AgentEvent::Joined(agent.clone()));
        let member = self.roster.join(agent).ok_or(Dropped::Numbers)?;
        let first_slot = member.first_slot;
        for slot in member.slots() {
            self.conversations.expect(slot, INCARNATION);
            self.lines.insert(slot, Line::default());
        }
        let mixture_version = self.newest().version();
        let place = Place { session: self.session, first_slot, mixture_version, setup: &self.setup };
        let reply = seal(&Reply::Joined(place));
        self.send_sealed(query.clone(), &reply);
        Ok(())
    }

    fn newest(&self) -> &Arc<Mixture> {
        self.versions.back().expect("the first version is never removed before there is another")
    }

    fn offer(
        &mut self,
        query: &Query,
        caller: Caller,
        sequence: u64,
        report: Option<EncodedReport<'_>>,
        block: &[u8],
    ) -> Result<Option<Deciding>, Dropped> {
        if !self.is_new(query, caller, sequence)? {
            return Ok(None);
        }
        let candidate = (!block.is_empty()).then(|| CandidateBlock::from_bytes(block)).transpose()?;
        let report = complete(report, candidate)?;
        Ok(Some(self.take(caller.walker, report)))
    }

    /// As an offer of nothing, by a walker that has no part in what became of the one before it.
    fn lost(
        &mut self,
        query: &Query,
        caller: Caller,
        sequence: u64,
        fault: bool,
    ) -> Result<Option<Deciding>, Dropped> {
        if !self.is_new(query, caller, sequence)? {
            return Ok(None);
        }
        self.outbox.push_back(Incoming::Gone { walker: caller.walker, fault });
        Ok(Some(self.take(caller.walker, None)))
    }

    /// Whether an offer is to be decided; if it has been, the answer is sent again. The answer goes to whoever asked last.
    fn is_new(&mut self, query: &Query, caller: Caller, sequence: u64) -> Result<bool, Dropped> {
        let (new, again) = match self.conversations.offer(caller, sequence)? {
            Next::Again(answer) => (false, Some(answer.to_vec())),
            Next::Wait => (false, None),
            Next::Take | Next::Unknown => (true, None),
        };
        match again {
            Some(answer) => self.send_sealed(query.clone(), &answer),
            None => self.route(caller.walker, query),
        }
        Ok(new)
    }

    fn route(&mut self, slot: u32, query: &Query) {
        if let Some(line) = self.lines.get_mut(&slot) {
            line.route = Some(query.clone());
        }
    }

    fn take(&mut self, slot: u32, report: Option<crate::messages::Report>) -> Deciding {
        self.conversations.take(slot);
        let (reply, decision) = oneshot::channel();
        let (decision, give_up) = abortable(decision);
        if let Some(line) = self.lines.get_mut(&slot) {
            line.mixture = None;
            line.deciding = Some(give_up);
        }
        self.outbox.push_back(Incoming::Free { walker: slot, report, reply });
        Box::pin(async move { (slot, decision.await.ok().and_then(Result::ok).flatten()) })
    }

    fn ask(&mut self, query: &Query, caller: Caller, sequence: u64) -> Result<(), Dropped> {
        match self.conversations.ask(caller, sequence)? {
            Next::Again(answer) => {
                let answer = answer.to_vec();
                self.send_sealed(query.clone(), &answer);
            }
            Next::Wait => self.route(caller.walker, query),
            Next::Take | Next::Unknown => {
                let answer = Answer { sequence, decision: Decision::Unknown };
                self.send(query.clone(), &Reply::Answer(answer));
            }
        }
        Ok(())
    }

    /// May be lost: whoever watches can do without.
    fn progress(&mut self, walk: WalkId, progress: Progress) {
        if self.outbox.len() < PROGRESS_KEPT {
            self.outbox.push_back(Incoming::Progress(walk, progress));
        }
    }

    fn mixture(&mut self, query: &Query, have: Option<u64>, wanted: u64, skip: u32) -> Result<(), Dropped> {
        let to = Arc::clone(self.version(wanted).ok_or(Dropped::Version(wanted))?);
        let from = have.and_then(|have| self.version(have)).map(Arc::clone);
        let (total, places, bytes) = changes::part(from.as_deref(), &to, skip);
        let (version, shape) = (to.version(), changes::shape(&to));
        let from = from.map(|from| from.version());
        let part = Changes { version, from, shape, total, skip, places, bytes: &bytes };
        self.send(query.clone(), &Reply::Mixture(part));
        Ok(())
    }

    /// A version that agents may need: one of the newest, or that of a turn in somebody's hands.
    fn version(&self, version: u64) -> Option<&Arc<Mixture>> {
        let promised = self.lines.values().filter_map(|line| line.mixture.as_ref());
        self.versions.iter().rev().chain(promised).find(|mixture| mixture.version() == version)
    }

    /// Answers the offer of a slot.
    pub(super) fn decided(&mut self, slot: u32, work: Option<Work>) {
        let Some((_, sequence)) = self.conversations.undecided(slot) else { return };
        let decision = match &work {
            Some(Work { assignment, mixture }) => {
                Decision::Turn { mixture_version: mixture.version(), assignment: Cow::Borrowed(assignment) }
            }
            None => Decision::Home,
        };
        let answer = seal(&Reply::Answer(Answer { sequence, decision }));
        if let Some(Work { mixture, .. }) = &work
            && mixture.version() > self.newest().version()
        {
            self.versions.push_back(Arc::clone(mixture));
            self.versions.drain(..self.versions.len().saturating_sub(VERSIONS));
        }
        let Some(line) = self.lines.get_mut(&slot) else { return };
        line.mixture = work.map(|work| work.mixture);
        if let Some(route) = line.route.take() {
            self.send_sealed(route, &answer);
        }
        self.conversations.answered(slot, answer);
    }

    /// An agent's sign of life has come or gone.
    pub(super) fn sign(&mut self, id: &str, alive: bool, now: Instant) {
        let event = if alive { AgentEvent::Back } else { AgentEvent::Silent };
        self.events.extend(self.roster.sign(id, alive, now).cloned().map(event));
    }

    /// Agents that have been silent for too long lose their turns.
    pub(super) fn expire(&mut self, now: Instant) {
        for member in self.roster.expire(now) {
            self.gone(&member);
            self.events.push(AgentEvent::Lost(member.agent));
        }
    }

    /// The slots of an agent are heard no more. Nobody waits for decisions about them before the reactor hears of it, so
    /// that a turn which is given to one meanwhile is known to be lost one way or the other.
    fn gone(&mut self, member: &Member) {
        for slot in member.slots() {
            self.conversations.forget(slot);
            let line = self.lines.remove(&slot);
            line.and_then(|line| line.deciding).inspect(AbortHandle::abort);
            self.outbox.push_back(Incoming::Gone { walker: slot, fault: false });
        }
    }

    fn send(&mut self, query: Query, reply: &Reply<'_>) {
        self.send_sealed(query, &seal(reply));
    }

    /// If it is lost the agent asks again.
    fn send_sealed(&mut self, query: Query, reply: &[u8]) {
        let reply = reply.to_vec();
        self.sending.spawn(async move { drop(query.reply(ORCHESTRATOR, reply).await) });
    }

    /// Whether no agent takes part.
    pub(super) fn is_deserted(&self) -> bool {
        self.roster.is_empty()
    }

    /// Waits until what is on its way is gone.
    pub(super) async fn finish(mut self) {
        while self.sending.join_next().await.is_some() {}
    }
}
