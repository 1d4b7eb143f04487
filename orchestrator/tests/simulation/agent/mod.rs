//! Agents on other hosts: the real protocol at both ends, and the real exchanges and pool of an agent. Stand-ins are the
//! link with its heartbeat, and the walkers of the host.

mod loss;
mod walkers;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use calm::Mixture;
use wire::net::datagram::{self, AgentRegistration, SlotExchange, SlotStep};
use wire::net::{AgentInfo, LinkError, Slot, SlotReport};
use workers::agent::{AgentCore, ExchangeEnd};

use super::event::Event;
use super::fault::{Direction, FIRST_AGENT, Time};
use super::planted::PlantedBug;
use super::refit::RunRefits;
use super::world::World;
use walkers::HostWalker;

pub use loss::MissingAgent;

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

/// A running agent.
pub struct AgentProcess {
    info: AgentInfo,
    process: u32,
    core: AgentCore<AgentRegistration>,
    session: u64,
    /// Number of its registrations.
    registrations: u64,
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
            registrations: 0,
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
}
