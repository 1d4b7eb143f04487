//! Agents that end, hang or cannot be reached, and what their run makes of it.

use wire::net::AgentEvent;

use super::super::event::Event;
use super::super::fault::{FIRST_AGENT, Time};
use super::super::planted::PlantedBug;
use super::super::world::World;
use super::{AgentProcess, EXPIRY_INTERVAL, RESTART_DELAY};

/// An agent that cannot be reached until others have joined the walks of the next version of the potential.
pub struct MissingAgent {
    pub agent: u32,
    /// The version when it was lost.
    pub version: u32,
    /// From then on, it is away for this time.
    pub delay: Time,
}

impl World {
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

    /// An agent can be reached again.
    pub fn agent_returns(&mut self, agent: u32) {
        self.links.mend(FIRST_AGENT + agent);
        let now = self.now;
        let Some(process) = self.agents.get_mut(&agent) else { return };
        process.muted_until = process.muted_until.min(now);
        let id = process.info.id.clone();
        self.tell(format!("agent {agent} can be reached again"));
        self.set_agent_alive(&id, true);
    }

    /// An agent has joined: those that miss a version return, if this is a newer one.
    fn missing_agents_return(&mut self, session: u64, joined: u32) {
        let version = self.version_of(session);
        let (due, left) = std::mem::take(&mut self.missing)
            .into_iter()
            .partition(|missing: &MissingAgent| missing.agent != joined && missing.version < version);
        self.missing = left;
        due.into_iter().for_each(|missing| self.after(missing.delay, Event::AgentReturns(missing.agent)));
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
                self.missing_agents_return(session, number);
                let newest = self.agents.get(&number).map(|agent| (agent.info.pid, agent.info.id.clone()));
                if newest.is_some_and(|(process, id)| process != joined.pid && id == joined.id) {
                    self.fail(format!("a dead process of agent {number} replaces the living one"));
                }
            }
            _ => {}
        }
    }
}
