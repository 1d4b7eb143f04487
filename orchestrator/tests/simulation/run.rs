//! A run of the orchestrator: the real core of the reactor with the real selector, the real server of the walkers'
//! protocol, and the real supervisor, twice. The shell of the reactor and the supervision of processes have files of their own.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use calm::Mixture;
use orchestrator::reactor::ReactorCore;
use orchestrator::selector::{Selector, SelectorSnapshot};
use orchestrator::supervisor::{Limits, Supervisor};
use store::records::Commit;
use store::{CampaignLock, ProcessRecord, Store, StoreError};
use tokio_util::sync::CancellationToken;
use wire::datagram::DatagramServer;
use wire::net::AgentBootstrap;
use wire::net::datagram::AgentDatagramServer;

use super::agent::AGENT_TIMEOUT;
use super::event::Event;
use super::fault::{ClientKind, Time};
use super::planted::PlantedBug;
use super::refit::RunRefits;
use super::scenario::SEED_STRUCTURES;
use super::world::World;
use crate::common::restore;

/// Time between two heartbeats of a run.
const HEARTBEAT_INTERVAL: Time = 15_000;
/// Time between two looks at what has changed in the store while walkers wait.
pub(super) const TICK: Time = 4_000;
const LIMITS: Limits = Limits {
    heartbeat_timeout: Duration::from_secs(40),
    initial_backoff: Duration::from_secs(1),
    max_backoff: Duration::from_secs(20),
    max_restarts: 5,
    grace_period: Duration::from_secs(15),
    detached: false,
};

/// Who may run the campaign.
pub enum RunLock {
    /// The lock of a directory.
    Directory { _lock: CampaignLock },
    /// A model of the lock on a server.
    Server,
}

/// A run.
pub struct Run {
    pub(super) core: ReactorCore,
    pub(super) server: DatagramServer,
    /// The server of agents on other hosts.
    pub agents: AgentDatagramServer,
    pub(super) walkers: Supervisor,
    pub(super) labellers: Supervisor,
    /// The process behind each number of a labeller, and its last heartbeat.
    pub(super) labeller_processes: BTreeMap<u32, (u32, i64)>,
    /// The newest incarnation of each walker.
    pub(super) incarnations: BTreeMap<u32, u32>,
    /// Mixtures that walkers may read.
    pub shared_memory: BTreeMap<u64, Arc<Mixture>>,
    pub(super) stopping: CancellationToken,
    /// The commit that is being written.
    pub(super) writing: Option<Commit>,
    /// The reactor has ended.
    pub(super) finished: bool,
    pub record: ProcessRecord,
    pub lock: Option<RunLock>,
    pub stopped_until: Time,
    pub(super) supervises_at: Option<Time>,
    pub(super) ticks: bool,
    /// What was read once: paused walks, length of the queue.
    pub(super) has_read: [bool; 2],
    /// Refits, if the campaign has any.
    pub(super) refits: Option<RunRefits>,
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
            Ok((selector, version)) => {
                self.tell(format!("run {session} begins"));
                self.begin_walks(session, (record, lock), (selector, version));
            }
            Err(error) => {
                self.tell(format!("run {session} cannot begin: {error}"));
                self.process_is_dead(&record.id);
                self.after(TICK, Event::StartRun);
            }
        }
    }

    /// Starts reactor, servers and supervisors of a run, for the walks of one version of the potential.
    pub(super) fn begin_walks(
        &mut self,
        session: u64,
        (record, lock): (ProcessRecord, Option<RunLock>),
        (selector, version): (Selector, u32),
    ) {
        let stopping = CancellationToken::new();
        let limits = Limits { detached: true, ..LIMITS };
        let agents = AgentDatagramServer::new(
            self.session_of_agents(session, &record),
            AGENT_TIMEOUT,
            AgentBootstrap { setup: version.to_string().into_bytes(), ..AgentBootstrap::default() },
            Arc::clone(selector.mixture()),
            selector.original(),
            stopping.clone(),
        );
        let run = Run {
            core: ReactorCore::new(selector, stopping.clone(), self.scenario.queue_limit),
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
            refits: self.scenario.refits.as_ref().map(|_| RunRefits::new(version)),
        };
        self.runs.insert(session, run);
        self.adopt_labellers(session);
        self.after(0, Event::RunSupervises(session));
        if self.scenario.agents > 0 {
            self.after(0, Event::AgentExpiry(session));
        }
        self.watch_refits(session);
        self.after(HEARTBEAT_INTERVAL, Event::RunHeartbeat(session));
    }

    /// The session that distinguishes a run from others for agents. The walks of each version have one of their own.
    fn session_of_agents(&self, session: u64, process: &ProcessRecord) -> u64 {
        let first = process.id.trim_start_matches("run-").parse();
        match self.bug {
            Some(PlantedBug::SessionOfAllVersions) => first.unwrap_or(session),
            _ => session,
        }
    }

    /// Reclaims leases, registers, restores the selector, and starts walks.
    fn open_run(&mut self, record: &ProcessRecord) -> Result<(Selector, u32), StoreError> {
        let (now, wall, client) = (self.now, self.wall_clock(), ClientKind::Orchestrator);
        self.store
            .write(now, client, "leases are reclaimed", async |store| store.reclaim_leases(wall).await)?;
        let restored = self.restore_selector()?;
        self.store.write(now, client, "a process is registered", async |store| {
            store.upsert_process(record).await
        })?;
        Ok(restored)
    }

    /// The selector with the state in the store, and the version of the potential in force. New walks are started.
    pub(super) fn restore_selector(&mut self) -> Result<(Selector, u32), StoreError> {
        let (now, client) = (self.now, ClientKind::Orchestrator);
        let settings = self.settings_in_force()?;
        let mut snapshot = self.store.read(now, snapshot).inspect(|snapshot| {
            debug_assert_eq!(snapshot.imported, 0);
        })?;
        if self.bug == Some(PlantedBug::KnownStructuresForgotten) {
            snapshot.known.clear();
        }
        if self.bug == Some(PlantedBug::MixtureForgotten) {
            snapshot.components.clear();
        }
        let mut selector = restore(&settings, SEED_STRUCTURES, snapshot);
        let begun = selector.start_walks();
        if !begun.decisions.is_empty() {
            self.store.write(now, client, "walks begin", async |store| store.commit(&begun).await)?;
        }
        Ok((selector, settings.version.version))
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
        self.stop_refit_after_walks(session);
        self.pump(session);
    }

    /// Ends a run whose reactor and processes have ended, unless a refit or walks with another version follow.
    pub(super) fn end_if_over(&mut self, session: u64) {
        let Some(run) = self.runs.get(&session) else { return };
        if !(run.finished && run.walkers.is_over() && run.labellers.is_over() && run.agents.has_no_agents()) {
            return;
        }
        match run.refits.is_some() {
            true => self.walks_have_ended(session),
            false => self.finish_run(session, true),
        }
    }

    /// Ends a run. The campaign is over if nothing is left to do; only a run that has finished can know that.
    pub(super) fn finish_run(&mut self, session: u64, finished: bool) {
        let (now, wall) = (self.now, self.wall_clock());
        let run = &self.runs[&session];
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
        self.over = finished && is_over.unwrap_or(false) || abandons;
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
