//! Which agents take part, and which of them are taken for dead. No port, no clock.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::{Duration, Instant};

use super::message::{Agent, AgentId};

/// Slots are numbered from here on: those below are walkers of the orchestrator's own host.
const FIRST: u32 = 1 << 16;

/// The agents of a run.
#[derive(Debug)]
pub(super) struct Roster {
    /// How long an agent may be without a sign of life.
    patience: Duration,
    next: u32,
    members: BTreeMap<AgentId, Member>,
}

/// An agent that takes part.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Member {
    pub agent: Agent,
    pub first_slot: u32,
    /// Since when it has given no sign of life.
    silent: Option<Instant>,
}

impl Member {
    /// Numbers of its slots. No other member of this run ever has or had one of them.
    pub(super) fn slots(&self) -> Range<u32> {
        self.first_slot..self.first_slot + self.agent.slots()
    }
}

impl Roster {
    pub(super) fn new(patience: Duration) -> Self {
        Self { patience, next: FIRST, members: BTreeMap::new() }
    }

    /// Takes an agent in, with slots of its own; `None` if there are no numbers left for so many. An agent that is in
    /// already has to be taken out before.
    pub(super) fn join(&mut self, agent: Agent) -> Option<&Member> {
        let first_slot = self.next;
        self.next = first_slot.checked_add(agent.slots())?;
        let id = agent.id.clone();
        let member = Member { agent, first_slot, silent: None };
        Some(self.members.entry(id).insert_entry(member).into_mut())
    }

    /// Takes an agent out.
    pub(super) fn leave(&mut self, id: &str) -> Option<Member> {
        self.members.remove(id)
    }

    /// Its sign of life has come or gone. Returns the agent if that is news.
    pub(super) fn sign(&mut self, id: &str, alive: bool, now: Instant) -> Option<&Agent> {
        let member = self.members.get_mut(id)?;
        if alive == member.silent.is_none() {
            return None;
        }
        member.silent = (!alive).then_some(now);
        Some(&member.agent)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.members.is_empty()
    }

    /// Takes out those whose sign of life has been missing for too long.
    pub(super) fn expire(&mut self, now: Instant) -> Vec<Member> {
        let patience = self.patience;
        let dead = |member: &Member| member.silent.is_some_and(|since| now.duration_since(since) >= patience);
        self.members.extract_if(.., |_, member| dead(member)).map(|(_, member)| member).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn agent(id: &str, walkers: u32) -> Agent {
        Agent { id: id.into(), host: "a".into(), pid: 1, program_version: "0".into(), walkers, ahead: 1 }
    }

    #[test]
    fn numbers_are_never_used_again() {
        let mut roster = Roster::new(Duration::from_secs(60));
        assert_eq!(roster.join(agent("a", 2)).unwrap().slots(), FIRST..FIRST + 3);
        assert_eq!(roster.join(agent("b", 1)).unwrap().slots(), FIRST + 3..FIRST + 5);
        assert_eq!(roster.leave("a").unwrap().slots(), FIRST..FIRST + 3);
        assert_eq!(roster.join(agent("a", 2)).unwrap().slots(), FIRST + 5..FIRST + 8);
        assert_eq!(roster.leave("c"), None);
        assert_eq!(roster.join(agent("c", u32::MAX)), None);
    }

    #[test]
    fn who_is_silent_for_too_long_is_taken_out_and_who_comes_back_in_time_stays() {
        let (mut roster, start) = (Roster::new(Duration::from_secs(60)), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        roster.join(agent("a", 2));
        roster.join(agent("b", 2));
        assert_eq!(roster.sign("a", true, start), None, "no news");
        assert!(roster.sign("a", false, at(0)).is_some());
        assert!(roster.sign("b", false, at(10)).is_some());
        assert_eq!(roster.sign("a", false, at(20)), None, "known since a while");
        assert!(roster.sign("b", true, at(30)).is_some());
        assert_eq!(roster.expire(at(59)), []);
        let dead = roster.expire(at(60));
        assert_eq!(dead.iter().map(|member| member.agent.id.as_str()).collect::<Vec<_>>(), ["a"]);
        assert_eq!(roster.expire(at(1000)), []);
        assert_eq!(roster.sign("a", true, at(1001)), None, "dead is dead");
    }
}
