//! The walkers of an agent's host: what they are given, and what they report.

use tokio::sync::oneshot;
use wire::messages::AssignmentReport;
use wire::transport::{Incoming, WorkItem};

use super::super::dealing::AgentWork;
use super::super::event::Event;
use super::super::planted::PlantedBug;
use super::super::scenario::SEED_STRUCTURES;
use super::super::world::World;
use super::{AgentEventKind, AgentKey, AgentProcess, Conversation, WALKERS};
use crate::common::scripted::advance;
use crate::common::seed_structure;

/// A walker of an agent.
#[derive(Default)]
pub(super) struct HostWalker {
    reply: Option<oneshot::Receiver<Option<WorkItem>>>,
    work: Option<WorkItem>,
    /// Number of its assignments.
    count: u64,
    /// The registration under which it got the last one.
    registration: u64,
}

impl AgentProcess {
    /// What its walkers work on.
    pub fn works(&self) -> Vec<AgentWork> {
        let work = |(walker, of): (u32, &HostWalker)| {
            let walk = of.work.as_ref()?.assignment.walk;
            Some(AgentWork { walker, registration: of.registration, walk })
        };
        (0..).zip(&self.walkers).filter_map(work).collect()
    }

    /// What a walker that waits is given, if there is something for it.
    fn deal(&mut self, walker: u32, bug: Option<PlantedBug>) -> Option<Option<WorkItem>> {
        let reply = self.walkers[walker as usize].reply.as_mut()?;
        let mut dealt = reply.try_recv().ok();
        if dealt.is_none() && bug == Some(PlantedBug::AssignmentDealtTwice) {
            dealt = self.walkers.iter().find_map(|other| other.work.clone()).map(Some);
        }
        if let (Some(Some(work)), Some(PlantedBug::NewestMixture)) = (&mut dealt, bug) {
            work.mixture = self.mixtures.back().cloned()?;
        }
        dealt
    }
}

impl World {
    pub(super) fn agent_walker_idle(&mut self, key: AgentKey, walker: u32, report: Option<AssignmentReport>) {
        let agent = self.agents.get_mut(&key.agent).unwrap();
        let (reply, answer) = oneshot::channel();
        let of = &mut agent.walkers[walker as usize];
        (of.reply, of.work) = (Some(answer), None);
        if let Some((slot, report)) = agent.core.handle(Incoming::Idle { walker, report, reply }) {
            self.exchange(key, slot, report);
        }
    }

    /// A registration takes effect, and walkers begin what they were given.
    pub(super) fn agent_moves_on(&mut self, key: AgentKey) {
        let of_process = |agent: &&mut AgentProcess| agent.process == key.process;
        let Some(agent) = self.agents.get_mut(&key.agent).filter(of_process) else { return };
        // What walkers were given was for the registration before, if a new one takes effect now.
        let registration = agent.registrations;
        if let Some(joined) = agent.core.take_joined() {
            (agent.session, agent.setup) = (joined.session, joined.setup);
            agent.registrations += 1;
            let first = agent.core.start(joined.slots);
            self.tell(format!("agent {} has joined run {}", key.agent, joined.session));
            first.into_iter().for_each(|(slot, report)| self.exchange(key, slot, report));
        }
        for walker in 0..WALKERS {
            let agent = self.agents.get_mut(&key.agent).unwrap();
            let Some(dealt) = agent.deal(walker, self.bug) else { continue };
            let of = &mut agent.walkers[walker as usize];
            (of.reply, of.work, of.registration) = (None, dealt, registration);
            of.count += 1;
            if let Some(WorkItem { assignment, mixture }) = of.work.clone() {
                let count = of.count;
                let known = String::from_utf8_lossy(&agent.setup).into_owned();
                if assignment.conditions.version.to_string() != known {
                    self.fail(format!("agent {} has a walk of another version than {known}", key.agent));
                }
                self.check_mixture_of(
                    &format!("walker {walker} of agent {}", key.agent),
                    &assignment,
                    &mixture,
                );
                self.check_dealt_once(key, walker);
                let time = self.random.between(1_500, 5_000);
                self.after(time, Event::Agent(key, AgentEventKind::WalkerFinishes(walker, count)));
            }
        }
        let agent = self.agents.get_mut(&key.agent).unwrap();
        if agent.session > 0 && agent.core.is_over() && !std::mem::replace(&mut agent.leaving, true) {
            self.converse(key, Conversation::Leave);
        }
    }

    pub(super) fn agent_walker_finishes(&mut self, key: AgentKey, walker: u32, count: u64) {
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
}
