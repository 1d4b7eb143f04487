//! Agents on other hosts: the real protocol at both ends, and the real exchanges and pool of an agent. Stand-ins are the
//! link with its heartbeat, and the walkers of the host.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use calm::Mixture;
use tokio::sync::oneshot;
use wire::messages::AssignmentReport;
use wire::net::datagram::{self, AgentRegistration, SlotExchange, SlotStep};
use wire::net::{AgentEvent, AgentInfo, LinkError, Slot, SlotReport};
use wire::transport::{Incoming, WorkItem};
use workers::agent::{AgentCore, ExchangeEnd};

use super::fault::{Direction, FIRST_AGENT, Time};
use super::planted::PlantedBug;
use super::refit::RunRefits;
use super::scenario::SEED_STRUCTURES;
use super::world::{Event, World};
use crate::common::scripted::advance;
use crate::common::seed_structure;

/// Agents without heartbeat for this time are lost.
pub const AGENT_TIMEOUT: Duration = Duration::from_secs(15);
/// Time between two looks for them.
const EXPIRY_INTERVAL: Time = 1_000;
/// An agent repeats a request after this time.
const REQUEST_TIMEOUT: Time = 5_000;
/// Shortest time between a reply and the next request about the same offer.
const RETRY_DELAY: Time = 300;
/// An agent that was killed starts again after this time.
const RESTART_DELAY: Time = 3_000;
/// An agent that has left starts again after this time.
const RESTART_AFTER_LEAVING: Time = 12_000;
/// Walkers of an agent.
const WALKERS: u32 = 2;
/// Most mixtures that an agent keeps.
const MAX_VERSIONS: usize = 4;

/// A process of an agent: the number of its host, and its start count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AgentKey {
    pub agent: u32,
    pub process: u32,
}

/// What an agent does next.
#[derive(Clone, Debug)]
pub enum AgentEventKind {
    Starts,
    /// The next request of a conversation.
    Sends(u64),
    /// The reply to a request arrives.
    Reply(u64, Vec<u8>),
    /// A request has no reply in time.
    TimedOut(u64),
    /// A walker ends its assignment.
    WalkerFinishes(u32, u64),
    /// A walker that was killed starts again.
    WalkerStarts(u32),
}

/// What an agent asks for, until it has an answer.
enum Conversation {
    Join,
    Mixture(AgentRegistration),
    Slot(SlotExchange),
    Leave,
}

/// A walker of an agent.
#[derive(Default)]
struct HostWalker {
    reply: Option<oneshot::Receiver<Option<WorkItem>>>,
    work: Option<WorkItem>,
    /// Number of its assignments.
    count: u64,
}

/// A running agent.
pub struct AgentProcess {
    info: AgentInfo,
    process: u32,
    core: AgentCore<AgentRegistration>,
    session: u64,
    /// What it starts its walkers with: the number of the version of the potential.
    setup: Vec<u8>,
    mixtures: VecDeque<Arc<Mixture>>,
    walkers: Vec<HostWalker>,
    conversations: BTreeMap<u64, Conversation>,
    /// The conversation of each request that waits for its reply.
    requests: BTreeMap<u64, u64>,
    next: u64,
    leaving: bool,
    stopped_until: Time,
    /// Its heartbeat is missing until then.
    muted_until: Time,
}

/// The number of a request says where its reply goes.
fn request_number(key: AgentKey, number: u64) -> u64 {
    u64::from(key.agent) << 48 | u64::from(key.process) << 32 | number
}

fn sender_of(request: u64) -> AgentKey {
    AgentKey { agent: (request >> 48) as u32, process: (request >> 32) as u32 & 0xffff }
}

impl World {
    pub fn start_agent(&mut self, agent: u32, process: u32) {
        let told = if self.bug == Some(PlantedBug::AgentIdReused) { 1 } else { process };
        let info = AgentInfo {
            id: format!("{agent:016x}{told:016x}"),
            host: format!("host {agent}"),
            pid: process,
            program_version: "0.1.0".into(),
            walkers: WALKERS,
            prefetch: 1,
        };
        let started = AgentProcess {
            info,
            process,
            core: AgentCore::default(),
            session: 0,
            setup: Vec::new(),
            mixtures: VecDeque::new(),
            walkers: (0..WALKERS).map(|_| HostWalker::default()).collect(),
            conversations: BTreeMap::new(),
            requests: BTreeMap::new(),
            next: 0,
            leaving: false,
            stopped_until: 0,
            muted_until: 0,
        };
        self.agents.insert(agent, started);
        self.after(500, Event::Agent(AgentKey { agent, process }, AgentEventKind::Starts));
    }

    pub fn agent_acts(&mut self, key: AgentKey, kind: AgentEventKind) {
        let Some(agent) = self.agents.get_mut(&key.agent).filter(|agent| agent.process == key.process) else {
            return;
        };
        if agent.stopped_until > self.now {
            let until = agent.stopped_until;
            return self.at(until, Event::Agent(key, kind));
        }
        match kind {
            AgentEventKind::Starts => {
                self.tell(format!("agent {} (process {}) starts", key.agent, key.process));
                self.converse(key, Conversation::Join);
                (0..WALKERS).for_each(|walker| self.agent_walker_idle(key, walker, None));
            }
            AgentEventKind::Sends(conversation) => self.agent_sends(key, conversation),
            AgentEventKind::Reply(request, bytes) => self.reply_arrives(key, request, &bytes),
            AgentEventKind::TimedOut(request) => {
                if let Some(conversation) = agent.requests.remove(&request) {
                    self.agent_sends(key, conversation);
                }
            }
            AgentEventKind::WalkerFinishes(walker, count) => self.agent_walker_finishes(key, walker, count),
            AgentEventKind::WalkerStarts(walker) => self.agent_walker_idle(key, walker, None),
        }
        self.agent_moves_on(key);
    }

    /// Begins a conversation.
    fn converse(&mut self, key: AgentKey, conversation: Conversation) {
        let agent = self.agents.get_mut(&key.agent).unwrap();
        agent.next += 1;
        let number = agent.next;
        agent.conversations.insert(number, conversation);
        self.agent_sends(key, number);
    }

    fn agent_sends(&mut self, key: AgentKey, conversation: u64) {
        let agent = self.agents.get_mut(&key.agent).unwrap();
        let bytes = match agent.conversations.get_mut(&conversation) {
            None => return,
            Some(Conversation::Join) => AgentRegistration::request(&agent.info),
            Some(Conversation::Mixture(joined)) => {
                datagram::first_mixture(joined.session, joined.mixture_version)
            }
            Some(Conversation::Slot(exchange)) => exchange.request(),
            Some(Conversation::Leave) => datagram::leave(agent.session, &agent.info),
        };
        agent.next += 1;
        let request = request_number(key, agent.next);
        agent.requests.insert(request, conversation);
        self.send(
            Direction::ToOrchestrator,
            FIRST_AGENT + key.agent,
            Event::AgentRequest(key, request, bytes),
        );
        self.after(REQUEST_TIMEOUT, Event::Agent(key, AgentEventKind::TimedOut(request)));
    }

    /// A request arrives at the run that has the address.
    pub fn agent_request_arrives(&mut self, key: AgentKey, request: u64, bytes: Vec<u8>) {
        let Some(session) = self.leader() else { return };
        if !self.is_active(session, || Event::AgentRequest(key, request, bytes.clone())) {
            return;
        }
        if self.runs[&session].refits.as_ref().is_some_and(RunRefits::walks_are_over) {
            // Agents are not served until the walks of the next version start.
            return;
        }
        self.runs.get_mut(&session).unwrap().agents.receive(request, &bytes);
        self.pump(session);
    }

    pub fn reply_leaves(&mut self, request: u64, bytes: Vec<u8>) {
        let key = sender_of(request);
        let event = Event::Agent(key, AgentEventKind::Reply(request, bytes));
        self.send(Direction::ToWalker, FIRST_AGENT + key.agent, event);
    }

    fn reply_arrives(&mut self, key: AgentKey, request: u64, bytes: &[u8]) {
        let believes = self.bug == Some(PlantedBug::LateReplyBelieved);
        let agent = self.agents.get_mut(&key.agent).unwrap();
        let conversation = agent.requests.remove(&request);
        // A late reply belongs to no request that waits.
        let mut any = || agent.requests.pop_first().map(|(_, conversation)| conversation);
        let Some(number) = conversation.or_else(|| if believes { any() } else { None }) else { return };
        let Some(conversation) = agent.conversations.remove(&number) else { return };
        match conversation {
            Conversation::Join => match AgentRegistration::read(&agent.info, bytes) {
                Ok(joined) => self.converse(key, Conversation::Mixture(joined)),
                Err(why) => self.agent_fails(key, &why),
            },
            Conversation::Mixture(joined) => match datagram::read_first_mixture(bytes) {
                Ok(_) if agent.session > 0 && joined.setup != agent.setup => self.agent_begins_again(key),
                Ok(mixture) => {
                    agent.mixtures.push_back(Arc::new(mixture));
                    agent.core.has_joined(joined);
                }
                // Another orchestrator has taken over in the meantime.
                Err(LinkError::RejoinRequired(_)) => self.converse(key, Conversation::Join),
                Err(why) => self.agent_fails(key, &why),
            },
            Conversation::Slot(mut exchange) => {
                let step = exchange.receive(bytes, &mut agent.mixtures);
                let excess = agent.mixtures.len().saturating_sub(MAX_VERSIONS);
                agent.mixtures.drain(..excess);
                self.slot_advances(key, number, exchange, step);
            }
            Conversation::Leave => {
                self.tell(format!("agent {} has left", key.agent));
                self.agents.remove(&key.agent);
                // A batch system starts the next one; it finds nothing to do if the campaign is over.
                let next = AgentKey { agent: key.agent, process: key.process + 1 };
                self.start_agent(next.agent, next.process);
                self.agents.get_mut(&next.agent).unwrap().stopped_until = self.now + RESTART_AFTER_LEAVING;
            }
        }
    }

    /// An agent that has to start its walkers with something else joins again, as the same one.
    fn agent_begins_again(&mut self, key: AgentKey) {
        let Some(before) = self.agents.remove(&key.agent) else { return };
        self.tell(format!("agent {} is set up anew", key.agent));
        self.start_agent(key.agent, key.process + 1);
        let agent = self.agents.get_mut(&key.agent).unwrap();
        (agent.info, agent.muted_until) = (before.info, before.muted_until);
    }

    fn slot_advances(
        &mut self,
        key: AgentKey,
        number: u64,
        exchange: SlotExchange,
        step: Result<SlotStep, LinkError>,
    ) {
        let agent = self.agents.get_mut(&key.agent).unwrap();
        let end = match step {
            Ok(SlotStep::Continue) => {
                agent.conversations.insert(number, Conversation::Slot(exchange));
                return self.after(RETRY_DELAY, Event::Agent(key, AgentEventKind::Sends(number)));
            }
            Ok(SlotStep::Done(Some(work))) => ExchangeEnd::Work(work),
            Ok(SlotStep::Done(None)) => ExchangeEnd::Closed,
            Err(LinkError::RejoinRequired(_)) => ExchangeEnd::RejoinRequired,
            Err(why) => return self.agent_fails(key, &why),
        };
        let (slot, report) = exchange.into_parts();
        let (is_lost, keeps) =
            (matches!(end, ExchangeEnd::RejoinRequired), self.bug == Some(PlantedBug::OldSlotsKept));
        if is_lost && keeps {
            return self.exchange(key, slot, report);
        }
        if agent.core.exchanged(slot, report, end) {
            self.tell(format!("agent {} must join again", key.agent));
            self.converse(key, Conversation::Join);
        }
    }

    /// An agent that works with the same program must understand every reply.
    fn agent_fails(&mut self, key: AgentKey, why: &LinkError) {
        self.fail(format!("agent {} cannot continue: {why}", key.agent));
    }

    fn exchange(&mut self, key: AgentKey, slot: Slot, report: SlotReport) {
        self.converse(key, Conversation::Slot(SlotExchange::new(slot, report)));
    }

    fn agent_walker_idle(&mut self, key: AgentKey, walker: u32, report: Option<AssignmentReport>) {
        let agent = self.agents.get_mut(&key.agent).unwrap();
        let (reply, answer) = oneshot::channel();
        let of = &mut agent.walkers[walker as usize];
        (of.reply, of.work) = (Some(answer), None);
        if let Some((slot, report)) = agent.core.handle(Incoming::Idle { walker, report, reply }) {
            self.exchange(key, slot, report);
        }
    }

    /// A registration takes effect, and walkers begin what they were given.
    fn agent_moves_on(&mut self, key: AgentKey) {
        let of_process = |agent: &&mut AgentProcess| agent.process == key.process;
        let Some(agent) = self.agents.get_mut(&key.agent).filter(of_process) else { return };
        if let Some(joined) = agent.core.take_joined() {
            (agent.session, agent.setup) = (joined.session, joined.setup);
            let first = agent.core.start(joined.slots);
            self.tell(format!("agent {} has joined run {}", key.agent, joined.session));
            first.into_iter().for_each(|(slot, report)| self.exchange(key, slot, report));
        }
        for walker in 0..WALKERS {
            let agent = self.agents.get_mut(&key.agent).unwrap();
            let of = &mut agent.walkers[walker as usize];
            let Some(answer) = of.reply.as_mut().and_then(|reply| reply.try_recv().ok()) else { continue };
            (of.reply, of.work) = (None, answer);
            of.count += 1;
            if of.work.is_some() {
                let (count, version) =
                    (of.count, of.work.as_ref().map(|work| work.assignment.conditions.version));
                let known = String::from_utf8_lossy(&agent.setup).into_owned();
                if version.is_some_and(|version| version.to_string() != known) {
                    self.fail(format!("agent {} has a walk of another version than {known}", key.agent));
                }
                let time = self.random.between(1_500, 5_000);
                self.after(time, Event::Agent(key, AgentEventKind::WalkerFinishes(walker, count)));
            }
        }
        let agent = self.agents.get_mut(&key.agent).unwrap();
        if agent.session > 0 && agent.core.is_over() && !std::mem::replace(&mut agent.leaving, true) {
            self.converse(key, Conversation::Leave);
        }
    }

    fn agent_walker_finishes(&mut self, key: AgentKey, walker: u32, count: u64) {
        let of = &self.agents[&key.agent].walkers[walker as usize];
        let Some(WorkItem { assignment, mixture }) = of.work.as_ref().filter(|_| of.count == count) else {
            return;
        };
        let is_script = |number: &usize| seed_structure(*number).structure == assignment.seed_structure;
        let script = (0..SEED_STRUCTURES).find(is_script).expect("one of the scenario");
        let events = self.scenario.script(script, assignment.conditions.version);
        let report = advance(&events, assignment, mixture, None);
        self.tell(format!(
            "walker {walker} of agent {} reports on walk {}, assignment {}",
            key.agent, report.walk, report.assignment
        ));
        self.agent_walker_idle(key, walker, Some(report));
    }

    pub fn kill_agent(&mut self, agent: u32) {
        let Some(process) = self.agents.remove(&agent) else { return };
        self.set_agent_alive(&process.info.id, false);
        self.start_agent(agent, process.process + 1);
        self.agents.get_mut(&agent).unwrap().stopped_until = self.now + RESTART_DELAY;
    }

    pub fn stop_agent(&mut self, agent: u32, until: Time) {
        self.agents.get_mut(&agent).into_iter().for_each(|agent| agent.stopped_until = until);
    }

    pub fn mute_agent(&mut self, agent: u32, until: Time) {
        let Some(agent) = self.agents.get_mut(&agent) else { return };
        agent.muted_until = agent.muted_until.max(until);
        let id = agent.info.id.clone();
        self.set_agent_alive(&id, false);
        self.after(until - self.now, Event::AgentHeard(id));
    }

    /// The heartbeat of an agent returns, unless its process has ended.
    pub fn agent_heard(&mut self, id: &str) {
        if self.agents.values().any(|agent| agent.info.id == id) {
            self.set_agent_alive(id, true);
        }
    }

    /// The heartbeat of an agent appears or disappears, for the run that leads.
    pub fn set_agent_alive(&mut self, id: &str, alive: bool) {
        let now = self.instant();
        if let Some(run) = self.leader().and_then(|session| self.runs.get_mut(&session)) {
            run.agents.set_alive(id, alive, now);
        }
    }

    pub fn kill_agent_walker(&mut self, number: u32, walker: u32, crashed: bool) {
        let Some(agent) = self.agents.get_mut(&number) else { return };
        let key = AgentKey { agent: number, process: agent.process };
        let of = &mut agent.walkers[walker as usize];
        (of.reply, of.work) = (None, None);
        of.count += 1;
        if let Some((slot, report)) = agent.core.handle(Incoming::Lost { walker, crashed }) {
            self.exchange(key, slot, report);
        }
        self.after(1_000, Event::Agent(key, AgentEventKind::WalkerStarts(walker)));
    }

    pub fn agents_expire(&mut self, session: u64) {
        if !self.is_active(session, || Event::AgentExpiry(session)) {
            return;
        }
        let now = self.instant();
        if self.bug != Some(PlantedBug::AgentLossForgotten) {
            self.runs.get_mut(&session).unwrap().agents.expire(now);
        }
        self.after(EXPIRY_INTERVAL, Event::AgentExpiry(session));
        self.pump(session);
    }

    /// The server says what happened to an agent: one that works is not taken for another.
    pub fn agent_event(&mut self, session: u64, event: AgentEvent) {
        match event {
            AgentEvent::Lost(lost) => {
                self.tell(format!("run {session} has lost an agent on {}", lost.host));
                let lives = |agent: &AgentProcess| agent.info == lost && agent.muted_until < self.now;
                if Some(session) == self.leader() && self.agents.values().any(lives) {
                    self.fail(format!("the living agent on {} is taken for dead", lost.host));
                }
            }
            AgentEvent::MessageRejected(why) => {
                self.fail(format!("run {session} rejects a message of an agent: {why}"));
            }
            AgentEvent::Joined(joined) => {
                let number = joined.host.trim_start_matches("host ").parse::<u32>().unwrap_or_default();
                let newest = self.agents.get(&number).map(|agent| (agent.info.pid, agent.info.id.clone()));
                if newest.is_some_and(|(process, id)| process != joined.pid && id == joined.id) {
                    self.fail(format!("a dead process of agent {number} replaces the living one"));
                }
            }
            _ => {}
        }
    }
}
