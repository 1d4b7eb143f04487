//! The agents of a run, and which of them are lost. Uses no ports and no clock.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::{Duration, Instant};

use super::message::{AgentId, AgentInfo};

/// Number of the first slot; smaller numbers are walkers of the orchestrator's host.
const FIRST_SLOT: u32 = 1 << 16;

/// The agents of a run.
#[derive(Debug)]
pub(super) struct AgentRegistry {
    /// Maximum time without heartbeat.
    timeout: Duration,
    next_slot: u32,
    agents: BTreeMap<AgentId, RegisteredAgent>,
    /// When the heartbeats that are missing disappeared. An agent's request to join may be handled after its death.
    silent: BTreeMap<AgentId, Instant>,
}

/// An agent that has joined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RegisteredAgent {
    pub agent: AgentInfo,
    pub first_slot: u32,
}

impl RegisteredAgent {
    /// Numbers of its slots. They are unique within a run and never reused.
    pub(super) fn slots(&self) -> Range<u32> {
        self.first_slot..self.first_slot + self.agent.slots()
    }
}

impl AgentRegistry {
    pub(super) fn new(timeout: Duration) -> Self {
        Self { timeout, next_slot: FIRST_SLOT, agents: BTreeMap::new(), silent: BTreeMap::new() }
    }

    /// Registers an agent with new slots; `None` if there are not enough numbers left. An agent that is already
    /// registered must be removed first.
    pub(super) fn join(&mut self, agent: AgentInfo) -> Option<&RegisteredAgent> {
        let first_slot = self.next_slot;
        self.next_slot = first_slot.checked_add(agent.slots())?;
        let entry = self.agents.entry(agent.id.clone());
        Some(entry.insert_entry(RegisteredAgent { agent, first_slot }).into_mut())
    }

    /// Removes an agent.
    pub(super) fn leave(&mut self, id: &str) -> Option<RegisteredAgent> {
        self.agents.remove(id)
    }

    /// Updates whether the agent's heartbeat is present. Returns the agent if this changed.
    pub(super) fn set_alive(&mut self, id: &str, alive: bool, now: Instant) -> Option<&AgentInfo> {
        if alive != self.silent.contains_key(id) {
            return None;
        }
        match alive {
            true => self.silent.remove(id),
            false => self.silent.insert(id.to_owned(), now),
        };
        self.agents.get(id).map(|registered| &registered.agent)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.agents.is_empty()
    }

    /// Removes the agents whose heartbeat has been missing for too long.
    pub(super) fn expire(&mut self, now: Instant) -> Vec<RegisteredAgent> {
        let Self { timeout, agents, silent, .. } = self;
        let mut lost = Vec::new();
        for (id, since) in silent {
            if now.duration_since(*since) >= *timeout
                && let Some(registered) = agents.remove(id)
            {
                // If it lives and joins again, it has the whole time again.
                *since = now;
                lost.push(registered);
            }
        }
        lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn agent(id: &str, walkers: u32) -> AgentInfo {
        AgentInfo {
            id: id.into(),
            host: "a".into(),
            pid: 1,
            program_version: "0".into(),
            walkers,
            prefetch: 1,
        }
    }

    #[test]
    fn slot_numbers_are_never_reused() {
        let mut registry = AgentRegistry::new(Duration::from_secs(60));
        assert_eq!(registry.join(agent("a", 2)).unwrap().slots(), FIRST_SLOT..FIRST_SLOT + 3);
        assert_eq!(registry.join(agent("b", 1)).unwrap().slots(), FIRST_SLOT + 3..FIRST_SLOT + 5);
        assert_eq!(registry.leave("a").unwrap().slots(), FIRST_SLOT..FIRST_SLOT + 3);
        assert_eq!(registry.join(agent("a", 2)).unwrap().slots(), FIRST_SLOT + 5..FIRST_SLOT + 8);
        assert_eq!(registry.leave("c"), None);
        assert_eq!(registry.join(agent("c", u32::MAX)), None);
    }

    #[test]
    fn an_agent_that_died_before_its_request_was_handled_expires() {
        let mut registry = AgentRegistry::new(Duration::from_secs(60));
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        assert_eq!(registry.set_alive("a", false, start), None, "it has not joined yet");
        registry.join(agent("a", 2));
        assert_eq!(registry.expire(start + 59 * second), []);
        assert_eq!(registry.expire(start + 60 * second).len(), 1);
        // It lives after all: it has the whole time again, and longer if its heartbeat is back.
        registry.join(agent("a", 2));
        assert_eq!(registry.expire(start + 119 * second), []);
        assert!(registry.set_alive("a", true, start + 119 * second).is_some());
        assert_eq!(registry.expire(start + 1000 * second), []);
    }

    #[test]
    fn agents_without_heartbeat_expire_unless_they_recover_in_time() {
        let (mut registry, start) = (AgentRegistry::new(Duration::from_secs(60)), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        registry.join(agent("a", 2));
        registry.join(agent("b", 2));
        assert_eq!(registry.set_alive("a", true, start), None, "no news");
        assert!(registry.set_alive("a", false, at(0)).is_some());
        assert!(registry.set_alive("b", false, at(10)).is_some());
        assert_eq!(registry.set_alive("a", false, at(20)), None, "known for a while");
        assert!(registry.set_alive("b", true, at(30)).is_some());
        assert_eq!(registry.expire(at(59)), []);
        let dead = registry.expire(at(60));
        assert_eq!(dead.iter().map(|registered| registered.agent.id.as_str()).collect::<Vec<_>>(), ["a"]);
        assert_eq!(registry.expire(at(1000)), []);
        assert_eq!(registry.set_alive("a", true, at(1001)), None, "dead is dead");
    }
}
