//! A run and the processes that it supervises: walkers and labellers.

use orchestrator::supervisor::{ChildState, SupervisorAction};
use store::ProcessRecord;

use super::event::{Event, Exit};
use super::fault::{ClientKind, Time};
use super::planted::PlantedBug;
use super::run::Run;
use super::walker::WalkerKey;
use super::world::World;

/// The hash of what labellers are started with.
const SETUP: &str = "setup";

impl World {
    /// Adopts the labellers of earlier runs, and asks those that it cannot adopt to end.
    pub(super) fn adopt_labellers(&mut self, session: u64) {
        let elapsed = self.elapsed();
        let found =
            self.store.read(self.now, async |store| store.processes(Some(ProcessRecord::LABELLER)).await);
        // In earnest the run would end here; its labellers would be found by the next one.
        for found in found.unwrap_or_default().into_iter().filter(|found| !found.is_dead()) {
            let id = self.labellers.iter().find(|(_, labeller)| labeller.record.id == found.id);
            let Some((&id, _)) = id else { continue };
            let run = self.runs.get_mut(&session).expect("it has begun");
            let number = found.number.filter(|_| found.state == "running");
            match number.filter(|number| run.labellers.adopt(*number, elapsed)) {
                Some(number) => drop(run.labeller_processes.insert(number, (id, found.last_seen))),
                None => self.terminate_labeller(id),
            }
        }
    }

    pub(super) fn plan_supervision(&mut self, session: u64) {
        let Some(run) = self.runs.get_mut(&session) else { return };
        let deadlines = [run.walkers.next_deadline(), run.labellers.next_deadline()];
        let Some(due) = deadlines.into_iter().flatten().min() else { return };
        let due = (due.as_nanos().div_ceil(1_000_000) as Time).max(self.now + 1);
        if run.supervises_at.is_none_or(|planned| planned > due) {
            run.supervises_at = Some(due);
            self.at(due, Event::RunSupervises(session));
        }
    }

    pub fn supervise(&mut self, session: u64) {
        if !self.is_active(session, || Event::RunSupervises(session)) {
            return;
        }
        let elapsed = self.elapsed();
        let run = self.runs.get_mut(&session).unwrap();
        run.supervises_at = None;
        let walkers = run.walkers.due_actions(elapsed);
        let labellers = run.labellers.due_actions(elapsed);
        self.act_on_walkers(session, walkers);
        self.act_on_labellers(session, labellers);
        self.pump(session);
    }

    pub(super) fn act_on_walkers(&mut self, session: u64, actions: Vec<SupervisorAction>) {
        for action in actions {
            match action {
                SupervisorAction::Start { number, incarnation } => {
                    let run = self.runs.get_mut(&session).unwrap();
                    run.incarnations.insert(number, incarnation);
                    let told = if self.bug == Some(PlantedBug::IncarnationIgnored) { 1 } else { incarnation };
                    run.server.expect(number, told);
                    self.tell(format!("run {session} starts walker {number} (incarnation {incarnation})"));
                    self.new_walker(WalkerKey { session, number, incarnation });
                }
                SupervisorAction::Terminate { number } => {
                    if let Some(key) = self.newest_walker(session, number) {
                        self.terminate_walker(key);
                    }
                }
                SupervisorAction::Kill { number } => {
                    if let Some(key) = self.newest_walker(session, number) {
                        self.walker_exits(key, Exit::Killed);
                    }
                }
            }
        }
    }

    pub(super) fn act_on_labellers(&mut self, session: u64, actions: Vec<SupervisorAction>) {
        for action in actions {
            match action {
                SupervisorAction::Start { number, .. } => {
                    let id = self.new_labeller(number);
                    let run = self.runs.get_mut(&session).unwrap();
                    run.labeller_processes.insert(number, (id, 0));
                }
                SupervisorAction::Terminate { number } => {
                    let process = self.runs[&session].labeller_processes.get(&number).copied();
                    process.into_iter().for_each(|(id, _)| self.terminate_labeller(id));
                }
                SupervisorAction::Kill { number } => {
                    let process = self.runs[&session].labeller_processes.get(&number).copied();
                    process.into_iter().for_each(|(id, _)| self.labeller_exits(id, Exit::Killed));
                }
            }
        }
    }

    /// A walker's process has ended, and its run learns of it.
    pub fn walker_gone(&mut self, key: WalkerKey, exit: Exit) {
        let session = key.session;
        if !self.is_active(session, || Event::WalkerGone(key, exit)) {
            return;
        }
        let elapsed = self.elapsed();
        let run = self.runs.get_mut(&session).unwrap();
        let Some(ended) = run.walkers.ended(key.number, exit.reason(), elapsed) else { return };
        let told = if self.bug == Some(PlantedBug::IncarnationIgnored) { 1 } else { ended.incarnation };
        run.server.process_ended(key.number, told, ended.reason.is_crash());
        if ended.then == ChildState::Exited {
            // There is no more work for the other walkers either.
            run.walkers.close();
        }
        let all_failed = run.walkers.is_over()
            && run.walkers.status(elapsed).all(|child| child.state == ChildState::Failed);
        if all_failed && !run.stopping.is_cancelled() {
            return self.run_ends(session, "no walker is left");
        }
        self.pump(session);
    }

    /// A labeller has ended: every run that started or adopted it learns of it, also one that was replaced meanwhile.
    pub fn labeller_gone(&mut self, id: u32, record: String, exit: Exit) {
        let of = |run: &Run| {
            run.labeller_processes.iter().find(|(_, (of, _))| *of == id).map(|(number, _)| *number)
        };
        let runs: Vec<(u64, u32)> =
            self.runs.iter().filter_map(|(session, run)| Some((*session, of(run)?))).collect();
        for (session, number) in runs {
            self.labeller_gone_from(session, number, (id, record.clone(), exit));
        }
    }

    /// A run releases the leases of a labeller that has ended.
    fn labeller_gone_from(&mut self, session: u64, number: u32, (id, record, exit): (u32, String, Exit)) {
        if !self.is_active(session, || Event::LabellerGone(id, record.clone(), exit)) {
            return;
        }
        let (elapsed, wall, now) = (self.elapsed(), self.wall_clock(), self.now);
        let run = self.runs.get_mut(&session).unwrap();
        run.labeller_processes.remove(&number);
        let Some(ended) = run.labellers.ended(number, exit.reason(), elapsed) else { return };
        if ended.reason.is_crash() {
            let attempts = self.attempts();
            // If that fails, the leases of dead processes are released with the next heartbeat.
            let _ = self.store.write(
                now,
                ClientKind::Orchestrator,
                "leases of a crashed labeller",
                async |store| store.fail_leases_of(&record, "crashed", "", attempts, wall).await,
            );
        }
        let _ = self.store.write(now, ClientKind::Orchestrator, "leases of dead processes", async |store| {
            store.release_leases_of_dead_processes(wall).await
        });
        let run = self.runs.get_mut(&session).unwrap();
        let all_failed = run.labellers.is_over()
            && run.labellers.status(elapsed).all(|child| child.state == ChildState::Failed);
        if all_failed && !run.stopping.is_cancelled() {
            return self.run_ends(session, "no labeller is left");
        }
        self.pump(session);
    }

    /// The record of a new labeller.
    pub fn labeller_record(&self, number: u32, id: String) -> ProcessRecord {
        let record = self.process_record(ProcessRecord::LABELLER, Some(number), id);
        ProcessRecord { setup: Some(SETUP.to_owned()), ..record }
    }
}
