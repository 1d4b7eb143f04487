//! A run of the orchestrator: the real core of the reactor with the real selector, the real server of the walkers'
//! protocol, and the real supervisor, twice. What the shells do around them is here, event by event.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use calm::Mixture;
use orchestrator::reactor::ReactorCore;
use orchestrator::selector::SelectorSnapshot;
use orchestrator::supervisor::{ChildState, Limits, Supervisor, SupervisorAction};
use store::records::{Commit, Fate};
use store::{CampaignLock, ProcessRecord, Store, StoreError};
use tokio_util::sync::CancellationToken;
use wire::datagram::{AnswerDatagram, DatagramServer};
use wire::net::datagram::AgentDatagramServer;
use wire::transport::WorkItem;

use super::agent::AGENT_TIMEOUT;
use super::fault::{ClientKind, Direction, Time};
use super::faulty_store::CommitTry;
use super::labeller::ATTEMPTS;
use super::planted::PlantedBug;
use super::scenario::SEED_STRUCTURES;
use super::walker::WalkerKey;
use super::world::{Event, Exit, World};
use crate::common::restore;

/// Time between two heartbeats of a run.
const HEARTBEAT_INTERVAL: Time = 15_000;
/// Time between two looks at what has changed in the store while walkers wait.
const TICK: Time = 4_000;
/// Most messages of walkers that may wait for the reactor: an offer and an exit of each, and some progress.
const MAX_INCOMING: usize = 64 + 2 * 8;
const LIMITS: Limits = Limits {
    heartbeat_timeout: Duration::from_secs(40),
    initial_backoff: Duration::from_secs(1),
    max_backoff: Duration::from_secs(20),
    max_restarts: 5,
    grace_period: Duration::from_secs(15),
    detached: false,
};
/// The hash of what labellers are started with.
const SETUP: &str = "setup";

/// Who may run the campaign.
pub enum RunLock {
    /// The lock of a directory.
    Directory { _lock: CampaignLock },
    /// A model of the lock on a server.
    Server,
}

/// A run.
pub struct Run {
    core: ReactorCore,
    server: DatagramServer,
    /// The server of agents on other hosts.
    pub agents: AgentDatagramServer,
    walkers: Supervisor,
    labellers: Supervisor,
    /// The process behind each number of a labeller, and its last heartbeat.
    labeller_processes: BTreeMap<u32, (u32, i64)>,
    /// The newest incarnation of each walker.
    incarnations: BTreeMap<u32, u32>,
    /// Mixtures that walkers may read.
    pub shared_memory: BTreeMap<u64, Arc<Mixture>>,
    stopping: CancellationToken,
    /// The commit that is being written.
    writing: Option<Commit>,
    /// The reactor has ended.
    finished: bool,
    pub record: ProcessRecord,
    pub lock: Option<RunLock>,
    pub stopped_until: Time,
    supervises_at: Option<Time>,
    ticks: bool,
    /// What was read once: paused walks, length of the queue.
    has_read: [bool; 2],
}

impl World {
    /// Starts an orchestrator, as `calmwalk run` does. It is refused while another one holds the lock.
    pub fn start_run(&mut self) {
        let ignores_lock = self.bug == Some(PlantedBug::LockIgnored);
        let lock = match self.scenario.server {
            true if self.runs.values().any(|run| run.lock.is_some()) => None,
            true => Some(RunLock::Server),
            false => CampaignLock::acquire(&self.directory, "simulation")
                .ok()
                .map(|lock| RunLock::Directory { _lock: lock }),
        };
        if lock.is_none() && !(ignores_lock && self.runs.len() == 1) {
            return self.tell("another orchestrator runs the campaign: this one ends".to_owned());
        }
        let session = self.next_session;
        self.next_session += 1;
        self.store.generation = session;
        let record = self.process_record(ProcessRecord::ORCHESTRATOR, None, format!("run-{session}"));
        match self.open_run(&record) {
            Ok((core, stopping)) => {
                self.tell(format!("run {session} begins"));
                let limits = Limits { detached: true, ..LIMITS };
                let agents = AgentDatagramServer::new(
                    session,
                    AGENT_TIMEOUT,
                    Arc::clone(core.selector().mixture()),
                    core.selector().original(),
                    stopping.clone(),
                );
                let run = Run {
                    core,
                    agents,
                    server: DatagramServer::new(session),
                    walkers: Supervisor::new(self.scenario.walkers, LIMITS),
                    labellers: Supervisor::new(
                        self.scenario.labellers,
                        Limits { heartbeat_timeout: Duration::from_secs(60), ..limits },
                    ),
                    labeller_processes: BTreeMap::new(),
                    incarnations: BTreeMap::new(),
                    shared_memory: BTreeMap::new(),
                    stopping,
                    writing: None,
                    finished: false,
                    record,
                    lock,
                    stopped_until: 0,
                    supervises_at: None,
                    ticks: false,
                    has_read: [false; 2],
                };
                self.runs.insert(session, run);
                self.adopt_labellers(session);
                self.after(0, Event::RunSupervises(session));
                if self.scenario.agents > 0 {
                    self.after(0, Event::AgentExpiry(session));
                }
                self.after(HEARTBEAT_INTERVAL, Event::RunHeartbeat(session));
            }
            Err(error) => {
                self.tell(format!("run {session} cannot begin: {error}"));
                self.process_is_dead(&record.id);
                self.after(TICK, Event::StartRun);
            }
        }
    }

    /// Reclaims leases, registers, restores the selector, and starts walks.
    fn open_run(&mut self, record: &ProcessRecord) -> Result<(ReactorCore, CancellationToken), StoreError> {
        let (now, wall, client) = (self.now, self.wall_clock(), ClientKind::Orchestrator);
        self.store
            .write(now, client, "leases are reclaimed", async |store| store.reclaim_leases(wall).await)?;
        let mut snapshot = self.store.read(now, snapshot).inspect(|snapshot| {
            debug_assert_eq!(snapshot.imported, 0);
        })?;
        if self.bug == Some(PlantedBug::KnownStructuresForgotten) {
            snapshot.known.clear();
        }
        if self.bug == Some(PlantedBug::MixtureForgotten) {
            snapshot.components.clear();
        }
        let mut selector = restore(&self.scenario.settings, SEED_STRUCTURES, snapshot);
        let begun = selector.start_walks();
        if !begun.walks.is_empty() {
            self.store.write(now, client, "walks begin", async |store| store.commit(&begun).await)?;
        }
        self.store.write(now, client, "a process is registered", async |store| {
            store.upsert_process(record).await
        })?;
        let stopping = CancellationToken::new();
        Ok((ReactorCore::new(selector, stopping.clone(), self.scenario.queue_limit), stopping))
    }

    /// Adopts the labellers of earlier runs, and asks those that it cannot adopt to end.
    fn adopt_labellers(&mut self, session: u64) {
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

    /// Whether a run is there and does not hang; if it hangs, the event comes later.
    pub fn is_active(&mut self, session: u64, event: impl FnOnce() -> Event) -> bool {
        let Some(run) = self.runs.get(&session) else { return false };
        let until = run.stopped_until;
        if until > self.now {
            self.at(until, event());
        }
        until <= self.now
    }

    pub fn message_arrives(&mut self, from: WalkerKey, sequence: u64, bytes: Vec<u8>) {
        let session = from.session;
        if !self.is_active(session, || Event::ToServer { from, sequence, bytes: bytes.clone() }) {
            return;
        }
        let elapsed = self.elapsed();
        let run = self.runs.get_mut(&session).unwrap();
        let Ok((walker, reports)) = run.server.receive(&bytes) else { return };
        match reports {
            true => run.walkers.delivered(walker, elapsed),
            false => run.walkers.heartbeat(walker, elapsed),
        }
        if run.incarnations.get(&walker) != Some(&from.incarnation) {
            return self.fail(format!(
                "incarnation {} of walker {walker} is heard, which was replaced",
                from.incarnation
            ));
        }
        if sequence > 0 {
            self.known.offers.insert((from, sequence));
        }
        self.pump(session);
    }

    /// Lets everything happen that needs no time: answers, decisions, the next assignments.
    pub fn pump(&mut self, session: u64) {
        self.deliver(session);
        self.advance(session);
        self.deliver(session);
        self.plan_supervision(session);
        self.end_if_over(session);
    }

    /// Passes answers to walkers, and messages to the reactor.
    fn deliver(&mut self, session: u64) {
        loop {
            let Some(run) = self.runs.get_mut(&session) else { return };
            let mut sent = Vec::new();
            run.server.answer_decided(|work| sent.push(work.clone()));
            run.agents.answer_decided(|work| sent.push(work.clone()));
            let answers = run.server.take_answers();
            let mut incoming = run.server.take_incoming();
            incoming.extend(run.agents.take_incoming());
            let replies = run.agents.take_replies();
            let told = run.agents.take_events();
            sent.into_iter().for_each(|work| self.assignment_leaves(session, work));
            for AnswerDatagram { walker, incarnation, bytes } in answers {
                let newest = self.runs[&session].incarnations.get(&walker).copied();
                let incarnation = match self.bug {
                    Some(PlantedBug::IncarnationIgnored) => newest.unwrap_or(incarnation),
                    _ => incarnation,
                };
                let to = WalkerKey { session, number: walker, incarnation };
                self.send(Direction::ToWalker, walker, Event::ToWalker { to, bytes });
            }
            told.into_iter().for_each(|event| self.agent_event(session, event));
            replies.into_iter().for_each(|(request, bytes)| self.reply_leaves(request, bytes));
            if incoming.len() > MAX_INCOMING {
                self.fail(format!("{} messages wait for the reactor", incoming.len()));
            }
            if incoming.is_empty() {
                return;
            }
            let run = self.runs.get_mut(&session).unwrap();
            if run.finished {
                // The channel to the reactor is closed: who waits is shut down.
                continue;
            }
            if let Err(error) = run.core.receive(incoming) {
                return self.fail(format!("the selector cannot decide: {error}"));
            }
        }
    }

    /// An assignment is sent to a walker: everything that it depends on must be in the store. Publishes its mixture.
    fn assignment_leaves(&mut self, session: u64, work: WorkItem) {
        if Some(session) == self.leader() {
            self.check_assignment(&work.assignment);
        }
        let run = self.runs.get_mut(&session).unwrap();
        let version = work.mixture.version();
        let before = run.shared_memory.values().next_back();
        let mixture = match (self.bug, before) {
            (Some(PlantedBug::TornMixture), Some(before)) if version > before.version() => {
                Arc::new(before.at_version(version))
            }
            _ => work.mixture,
        };
        run.shared_memory.entry(version).or_insert(mixture);
    }

    /// What the reactor does after a batch of messages or a commit.
    fn advance(&mut self, session: u64) {
        let (now, instant, bug) = (self.now, self.instant(), self.bug);
        let Some(run) = self.runs.get_mut(&session).filter(|run| !run.finished && run.writing.is_none())
        else {
            return;
        };
        let skips = |bug_of_read, has_read| has_read && bug == Some(bug_of_read);
        let read = (|| {
            if run.core.needs_unfinished_jobs(instant)
                && !skips(PlantedBug::QueueLengthRemembered, run.has_read[1])
            {
                let unfinished = self.store.read(now, async |store| store.unfinished_jobs().await)?;
                run.core.set_unfinished_jobs(unfinished, instant);
                run.has_read[1] = true;
            }
            if run.core.needs_paused_walks(instant) && !skips(PlantedBug::PauseRemembered, run.has_read[0]) {
                let paused = self.store.read(now, async |store| store.paused_walks().await)?;
                run.core.set_paused_walks(paused, instant);
                run.has_read[0] = true;
            }
            Ok::<_, StoreError>(())
        })();
        if let Err(error) = read {
            return self.run_ends(session, &error.to_string());
        }
        run.core.schedule();
        match run.core.take_commit() {
            Some(commit) => {
                run.writing = Some(commit);
                if bug == Some(PlantedBug::AnswerBeforeCommit) {
                    run.core.send_replies();
                }
                let time = self.random.between(1, 400);
                self.after(time, Event::CommitDue(session));
            }
            None => {
                run.core.send_replies();
                if run.core.is_over() {
                    run.finished = true;
                    self.tell(format!("the reactor of run {session} has ended"));
                }
            }
        }
        self.plan_tick(session);
    }

    fn plan_tick(&mut self, session: u64) {
        let Some(run) = self.runs.get_mut(&session) else { return };
        let wanted = run.core.waiting() > 0 || run.finished;
        if wanted && !std::mem::replace(&mut run.ticks, wanted) {
            self.after(TICK, Event::RunTick(session));
        }
    }

    pub fn run_tick(&mut self, session: u64) {
        if !self.is_active(session, || Event::RunTick(session)) {
            return;
        }
        self.runs.get_mut(&session).unwrap().ticks = false;
        self.check_labels(session);
        self.pump(session);
        self.plan_tick(session);
    }

    /// After the last walk, labellers are asked to end when no structure waits for a label.
    fn check_labels(&mut self, session: u64) {
        let (now, wall, elapsed) = (self.now, self.wall_clock(), self.elapsed());
        let run = self.runs.get_mut(&session).unwrap();
        if !run.finished || run.stopping.is_cancelled() {
            return;
        }
        let pending = self.store.read(now, async |store| store.has_pending_labels(wall).await);
        if pending.is_ok_and(|pending| !pending) || self.bug == Some(PlantedBug::QueueAbandoned) {
            let actions = run.labellers.stop(elapsed);
            self.act_on_labellers(session, actions);
        }
    }

    pub fn commit_due(&mut self, session: u64) {
        if !self.is_active(session, || Event::CommitDue(session)) {
            return;
        }
        let run = self.runs.get_mut(&session).unwrap();
        let Some(mut commit) = run.writing.take() else { return };
        if self.bug == Some(PlantedBug::CheckpointForgotten) && !commit.candidates.is_empty() {
            commit.walks.clear();
        }
        match self.store.commit(self.now, session, &commit) {
            CommitTry::Written => {
                self.tell(format!(
                    "run {session} has committed {} decisions, {} candidates",
                    commit.decisions.len(),
                    commit.candidates.len()
                ));
                self.known.decisions += commit.decisions.len() as i64;
                let accepted = commit.candidates.iter().filter(|candidate| candidate.fate == Fate::Accepted);
                self.known.accepted.extend(accepted.map(|candidate| candidate.block.view().id().to_string()));
                self.runs.get_mut(&session).unwrap().core.send_replies();
                self.pump(session);
            }
            CommitTry::Again => {
                run.writing = Some(commit);
                self.after(1_000, Event::CommitDue(session));
            }
            CommitTry::Failed(error @ (StoreError::DuplicateCandidate(_) | StoreError::Inconsistent(_))) => {
                self.fail(format!("a commit contradicts the store: {error}"));
            }
            CommitTry::Failed(error) => self.run_ends(session, &error.to_string()),
        }
    }

    fn plan_supervision(&mut self, session: u64) {
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

    fn act_on_walkers(&mut self, session: u64, actions: Vec<SupervisorAction>) {
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

    fn act_on_labellers(&mut self, session: u64, actions: Vec<SupervisorAction>) {
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

    /// A labeller has ended; a run that started or adopted it releases its leases.
    pub fn labeller_gone(&mut self, id: u32, record: String, exit: Exit) {
        let of = |run: &Run| {
            run.labeller_processes.iter().find(|(_, (of, _))| *of == id).map(|(number, _)| *number)
        };
        let Some((session, number)) = self.runs.iter().find_map(|(session, run)| Some((*session, of(run)?)))
        else {
            return;
        };
        if !self.is_active(session, || Event::LabellerGone(id, record.clone(), exit)) {
            return;
        }
        let (elapsed, wall, now) = (self.elapsed(), self.wall_clock(), self.now);
        let run = self.runs.get_mut(&session).unwrap();
        run.labeller_processes.remove(&number);
        let Some(ended) = run.labellers.ended(number, exit.reason(), elapsed) else { return };
        if ended.reason.is_crash() {
            // If that fails, the leases of dead processes are released with the next heartbeat.
            let _ = self.store.write(
                now,
                ClientKind::Orchestrator,
                "leases of a crashed labeller",
                async |store| store.fail_leases_of(&record, "crashed", "", ATTEMPTS, wall).await,
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

    /// The heartbeat of a run, which also reads those of labellers.
    pub fn run_heartbeat(&mut self, session: u64) {
        if !self.is_active(session, || Event::RunHeartbeat(session)) {
            return;
        }
        let ignores = [Some(PlantedBug::FenceForgotten), Some(PlantedBug::LockIgnored)].contains(&self.bug);
        if self.store.is_replaced(session) && !ignores {
            return self.run_ends(session, "it has lost its lock");
        }
        let (now, wall, elapsed) = (self.now, self.wall_clock(), self.elapsed());
        let run = self.runs.get_mut(&session).unwrap();
        run.record.last_seen = wall;
        let record = run.record.clone();
        let client = ClientKind::Orchestrator;
        let records = (|| {
            self.store
                .write(now, client, "a heartbeat", async |store| store.upsert_process(&record).await)?;
            self.store.write(now, client, "leases of dead processes", async |store| {
                store.release_leases_of_dead_processes(wall).await
            })?;
            self.store.read(now, async |store| store.processes(Some(ProcessRecord::LABELLER)).await)
        })();
        for (number, (id, last_seen)) in &mut run.labeller_processes {
            let Ok(records) = &records else {
                // Their heartbeats cannot be read now.
                run.labellers.heartbeat(*number, elapsed);
                continue;
            };
            let name = self.labellers.get(id).map(|labeller| labeller.record.id.clone());
            let Some(record) = records.iter().find(|record| Some(&record.id) == name.as_ref()) else {
                continue;
            };
            if record.last_seen != *last_seen {
                *last_seen = record.last_seen;
                run.labellers.delivered(*number, elapsed);
            }
        }
        self.after(HEARTBEAT_INTERVAL, Event::RunHeartbeat(session));
        self.pump(session);
    }

    /// Asks a run to stop in order.
    pub fn stop_run(&mut self, session: u64) {
        let elapsed = self.elapsed();
        let run = self.runs.get_mut(&session).unwrap();
        run.stopping.cancel();
        let walkers = run.walkers.stop(elapsed);
        let labellers = run.labellers.stop(elapsed);
        self.act_on_walkers(session, walkers);
        self.act_on_labellers(session, labellers);
        self.pump(session);
    }

    /// Ends a run whose reactor and processes have ended. The campaign is over if nothing is left to do.
    fn end_if_over(&mut self, session: u64) {
        let (now, wall) = (self.now, self.wall_clock());
        let Some(run) = self.runs.get(&session) else { return };
        if !(run.finished && run.walkers.is_over() && run.labellers.is_over() && run.agents.has_no_agents()) {
            return;
        }
        let id = run.record.id.clone();
        let _ = self.store.write(now, ClientKind::Orchestrator, "a process is removed", async |store| {
            store.remove_process(&id).await
        });
        let is_over = self.store.read(now, async |store| {
            Ok(store.all_walks_ended().await? && !store.has_pending_labels(wall).await?)
        });
        let abandons = self.bug == Some(PlantedBug::QueueAbandoned) && !run.stopping.is_cancelled();
        self.run_ends(session, "in order");
        // The next run looks again.
        self.over = is_over.unwrap_or(false) || abandons;
    }

    /// The record of a new labeller.
    pub fn labeller_record(&self, number: u32, id: String) -> ProcessRecord {
        let record = self.process_record(ProcessRecord::LABELLER, Some(number), id);
        ProcessRecord { setup: Some(SETUP.to_owned()), ..record }
    }
}

/// What the selector continues from.
async fn snapshot(store: &Store) -> Result<SelectorSnapshot, StoreError> {
    Ok(SelectorSnapshot {
        imported: 0,
        walks: store.load_walks().await?,
        components: store.load_components().await?,
        known: store.known_hashes().await?,
        values: store.values().await?,
    })
}
