//! Faults begin.

use super::agent::MissingAgent;
use super::event::{Event, Exit};
use super::fault::{Direction, FIRST_AGENT, Fault, LinkTrouble, Time};
use super::world::World;

impl World {
    pub fn begin_fault(&mut self, fault: Fault) {
        self.tell(fault.to_string());
        match fault {
            Fault::Link { walker, direction, trouble, until } => {
                self.links.add(walker, direction, trouble, until);
            }
            Fault::NextWrite { client, moment } => self.store.next_writes.push((client, moment)),
            Fault::StoreAway { until } => self.store.away_until = self.store.away_until.max(until),
            Fault::StoreFull { until } => self.store.full_until = self.store.full_until.max(until),
            Fault::KillWalker { walker, crash } => {
                if let Some(key) = self.leader().and_then(|run| self.newest_walker(run, walker)) {
                    self.walker_exits(key, if crash { Exit::Crash } else { Exit::Killed });
                }
            }
            Fault::StopWalker { walker, until } => {
                let key = self.leader().and_then(|run| self.newest_walker(run, walker));
                if let Some(process) = key.and_then(|key| self.walkers.get_mut(&key)) {
                    process.stopped_until = until;
                }
            }
            Fault::KillWalkerOften { walker, until } => {
                self.links.add(walker, Direction::ToOrchestrator, LinkTrouble::Delay, until);
                self.kill_walker_again(walker, until);
            }
            Fault::KillLabeller { labeller, crash } => {
                if let Some(id) = self.newest_labeller(labeller) {
                    self.labeller_exits(id, if crash { Exit::Crash } else { Exit::Killed });
                }
            }
            Fault::StopLabeller { labeller, until } => {
                if let Some(id) = self.newest_labeller(labeller) {
                    self.labellers.get_mut(&id).unwrap().stopped_until = until;
                }
            }
            Fault::StartLabellerTwice { labeller } => {
                if self.newest_labeller(labeller).is_some() {
                    self.new_labeller(labeller);
                }
            }
            Fault::KillOrchestrator => {
                if let Some(session) = self.leader() {
                    self.run_ends(session, "it was killed");
                }
            }
            Fault::StopInOrder => {
                if let Some(session) = self.leader() {
                    self.stop_run(session);
                }
            }
            Fault::StartOrchestratorTwice => self.start_run(),
            Fault::Hang { until } => self.hang(until),
            Fault::ClockJump { milliseconds } => self.clock_offset += milliseconds,
            Fault::DropJob => self.drop_job(),
            Fault::RetryJob => self.retry_job(),
            Fault::Relabel => self.relabel(),
            Fault::PauseWalks { until } => {
                self.pause_walks(true);
                self.at(until, Event::Resume);
            }
            Fault::KillCalculation => self.kill_calculation(),
            Fault::Slurm(fault) => self.begin_slurm_fault(fault),
            Fault::KillAgent { agent } => self.kill_agent(agent),
            Fault::StopAgent { agent, until } => self.stop_agent(agent, until),
            Fault::MuteAgent { agent, until } => self.mute_agent(agent, until),
            Fault::LoseAgent { agent, until } => {
                for direction in [Direction::ToOrchestrator, Direction::ToWalker] {
                    self.links.add(FIRST_AGENT + agent, direction, LinkTrouble::Cut, until);
                }
                self.mute_agent(agent, until);
            }
            Fault::MissVersion { agent, delay, until } => {
                let version = self.leader().map_or(0, |session| self.version_of(session));
                self.missing.push(MissingAgent { agent, version, delay });
                self.begin_fault(Fault::LoseAgent { agent, until });
            }
            Fault::KillAgentWalker { agent, walker, crash } => self.kill_agent_walker(agent, walker, crash),
            Fault::KillRefitter { after, times, crash } => {
                self.kill_refitter(after, times, if crash { Exit::Crash } else { Exit::Killed });
            }
            Fault::RollBack => self.roll_back(),
        }
    }

    pub fn kill_walker_again(&mut self, walker: u32, until: Time) {
        if let Some(key) = self.leader().and_then(|run| self.newest_walker(run, walker)) {
            self.walker_exits(key, Exit::Killed);
        }
        let delay = self.random.between(1_500, 3_500);
        if self.now + delay < until {
            self.after(delay, Event::KillAgain(walker, until));
        }
    }

    /// The orchestrator hangs. On a server its lock is lost meanwhile, and another orchestrator takes over.
    fn hang(&mut self, until: Time) {
        let Some(run) = self.leader().and_then(|session| self.runs.get_mut(&session)) else { return };
        run.stopped_until = until;
        if self.scenario.server {
            run.lock = None;
            self.start_run();
        }
    }
}
