//! The world of a simulation: virtual time, the queue of events, and everything that exists. One thread; the order of
//! events follows from the seed alone.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::time::{Duration, Instant};

use sqlx::SqliteConnection;
use store::{Budget, ProcessRecord, Store};

use super::agent::{AgentProcess, MissingAgent};
use super::calculation::Calculation;
use super::event::{Event, Queued};
use super::fault::{PlannedFault, Time};
use super::faulty_store::FaultyStore;
use super::invariants::Known;
use super::labeller::Labeller;
use super::link::Links;
use super::planted::PlantedBug;
use super::random::Random;
use super::refitter::RefitProcesses;
use super::run::Run;
use super::scenario::Scenario;
use super::slurm::SlurmWorld;
use super::walker::{WalkerKey, WalkerProcess};

/// The wall clock at the start, ms since 1970.
pub const WALL_CLOCK: i64 = 1_700_000_000_000;
/// After the last fault, the campaign must end within this time.
const TIME_TO_END: Time = 700_000;
/// More events than any simulation has that makes progress.
const MAX_EVENTS: usize = 40_000;
/// Most events that may wait at a time.
const MAX_QUEUED: usize = 2_000;
/// How long a run is away after it ended.
const RESTART_DELAY: Time = 4_000;

/// How a simulation ended.
pub struct Outcome {
    /// The invariant that was broken.
    pub violation: Option<String>,
    /// What happened, one sentence a line.
    pub story: Vec<String>,
    /// A hash of every event.
    pub hash: u64,
    /// The decision log.
    pub log: String,
    /// When the campaign ended.
    pub ended: Time,
    /// Number of events.
    pub events: usize,
}

/// Everything that exists.
pub struct World {
    pub now: Time,
    pub random: Random,
    pub scenario: Scenario,
    pub bug: Option<PlantedBug>,
    pub store: FaultyStore,
    /// A connection of the harness, for invariants and for what the operating system knows.
    pub direct: SqliteConnection,
    pub directory: std::path::PathBuf,
    pub runs: BTreeMap<u64, Run>,
    pub walkers: BTreeMap<WalkerKey, WalkerProcess>,
    pub agents: BTreeMap<u32, AgentProcess>,
    pub labellers: BTreeMap<u32, Labeller>,
    pub calculations: BTreeMap<String, Calculation>,
    pub refits: RefitProcesses,
    pub slurm: SlurmWorld,
    pub known: Known,
    pub violation: Option<String>,
    pub links: Links,
    pub missing: Vec<MissingAgent>,
    pub next_session: u64,
    pub next_labeller: u32,
    /// Jobs that a person dropped or requeued.
    pub handled: BTreeSet<i64>,
    pub over: bool,
    pub clock_offset: i64,
    base: Instant,
    queue: BinaryHeap<Reverse<Queued>>,
    planned: u64,
    plan: Vec<PlannedFault>,
    story: Vec<String>,
    hasher: DefaultHasher,
}

impl World {
    pub fn new(seed: u64, plan: Vec<PlannedFault>, bug: Option<PlantedBug>, directory: &Path) -> Self {
        let scenario = Scenario::of(seed);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let store = runtime.block_on(Store::open(directory)).unwrap();
        if bug != Some(PlantedBug::BudgetForgotten) && scenario.label_budget.is_some() {
            let budget = Budget { labels: scenario.label_budget, ..Budget::default() };
            runtime.block_on(store.set_budget(&budget)).unwrap();
        }
        if let Some(refits) = &scenario.refits {
            let configuration = refits.configuration.to_string();
            runtime.block_on(store.set_configuration_in_force(&configuration, &[], 0)).unwrap();
        }
        let direct = runtime.block_on(super::invariants::connect(directory));
        let slurm = SlurmWorld::new(seed, &scenario);
        let mut world = Self {
            now: 0,
            random: Random::new(seed),
            store: FaultyStore::new(store, runtime, scenario.server, bug),
            scenario,
            bug,
            direct,
            directory: directory.to_owned(),
            runs: BTreeMap::new(),
            walkers: BTreeMap::new(),
            agents: BTreeMap::new(),
            labellers: BTreeMap::new(),
            calculations: BTreeMap::new(),
            refits: RefitProcesses::default(),
            slurm,
            known: Known::default(),
            violation: None,
            links: Links::default(),
            missing: Vec::new(),
            next_session: 1,
            next_labeller: 1,
            handled: BTreeSet::new(),
            over: false,
            clock_offset: 0,
            base: Instant::now(),
            queue: BinaryHeap::new(),
            planned: 0,
            plan,
            story: Vec::new(),
            hasher: DefaultHasher::new(),
        };
        world.after(0, Event::StartRun);
        for agent in 0..world.scenario.agents {
            world.start_agent(agent, 1);
        }
        for (number, planned) in world.plan.clone().into_iter().enumerate() {
            world.after(planned.at, Event::Fault(number));
        }
        world
    }

    /// Runs until the campaign is over, or an invariant is broken.
    pub fn run(mut self) -> Outcome {
        let faults_end = self.plan.iter().map(|planned| planned.fault.end(planned.at)).max().unwrap_or(0);
        // A job whose id was lost counts as running for ten minutes.
        let time_to_end = if self.scenario.custom { 6 * TIME_TO_END } else { TIME_TO_END };
        let mut events = 0;
        while !self.over && self.violation.is_none() {
            let Some(Reverse(Queued { at, number, event })) = self.queue.pop() else {
                self.fail("nothing happens any more, and the campaign has not ended".to_owned());
                break;
            };
            self.now = at;
            events += 1;
            (at, number, std::mem::discriminant(&event)).hash(&mut self.hasher);
            let changes = self.store.changes;
            self.handle(event);
            if self.store.changes > changes {
                self.check_store();
            }
            self.check_memory();
            if at > faults_end + time_to_end || events > MAX_EVENTS {
                self.fail("the faults are over, and the campaign does not end".to_owned());
            }
        }
        if self.violation.is_none() {
            self.check_end();
        }
        let mut log = self.store.runtime.block_on(self.store.store.decision_log_text()).unwrap();
        if self.scenario.refits.is_some() {
            log += &self.versions_text();
        }
        let Self { store, direct, violation, story, hasher, now, .. } = self;
        store.runtime.block_on(async {
            let _ = sqlx::Connection::close(direct).await;
            store.store.close().await;
        });
        Outcome { violation, story, hash: hasher.finish(), log, ended: now, events }
    }

    fn check_memory(&mut self) {
        if self.queue.len() > MAX_QUEUED {
            self.fail(format!("{} events wait", self.queue.len()));
        }
    }

    /// The time of a clock that never jumps.
    pub fn instant(&self) -> Instant {
        self.base + Duration::from_millis(self.now)
    }

    /// The same, since the start.
    pub fn elapsed(&self) -> Duration {
        Duration::from_millis(self.now)
    }

    /// The wall clock, ms since 1970.
    pub fn wall_clock(&self) -> i64 {
        WALL_CLOCK + self.now.cast_signed() + self.clock_offset
    }

    pub fn after(&mut self, delay: Time, event: Event) {
        self.at(self.now + delay, event);
    }

    pub fn at(&mut self, at: Time, event: Event) {
        self.planned += 1;
        self.queue.push(Reverse(Queued { at, number: self.planned, event }));
    }

    /// Adds a sentence to the story.
    pub fn tell(&mut self, sentence: String) {
        for remark in std::mem::take(&mut self.store.remarks) {
            self.tell(remark);
        }
        sentence.hash(&mut self.hasher);
        self.story.push(format!("{:8.3} s  {sentence}", self.now as f64 / 1000.0));
    }

    /// An invariant is broken.
    pub fn fail(&mut self, what: String) {
        if self.violation.is_none() {
            self.tell(format!("BROKEN: {what}"));
            self.violation = Some(what);
        }
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Fault(number) => self.begin_fault(self.plan[number].fault.clone()),
            Event::Resume => self.pause_walks(false),
            Event::KillAgain(walker, until) => self.kill_walker_again(walker, until),
            Event::StartRun => self.start_run(),
            Event::ToServer { from, sequence, bytes } => self.message_arrives(from, sequence, bytes),
            Event::ToWalker { to, bytes } => self.answer_arrives(to, bytes),
            Event::WalkerStarts(key) => self.walker_starts(key),
            Event::WalkerPolls(key, offer) => self.walker_polls(key, offer),
            Event::WalkerFinishes(key, offer) => self.walker_finishes(key, offer),
            Event::WalkerGone(key, exit) => self.walker_gone(key, exit),
            Event::CommitDue(session) => self.commit_due(session),
            Event::RunTick(session) => self.run_tick(session),
            Event::RunHeartbeat(session) => self.run_heartbeat(session),
            Event::RunSupervises(session) => self.supervise(session),
            Event::LabellerStarts(id) => self.labeller_starts(id),
            Event::LabellerActs(id, token) => self.labeller_acts(id, token),
            Event::LabellerHeartbeat(id) => self.labeller_heartbeat(id),
            Event::LabellerGone(id, record, exit) => self.labeller_gone(id, record, exit),
            Event::CalculationEnds(id) => self.calculation_ends(&id),
            Event::Slurm(event) => self.slurm_event(event),
            Event::Agent(key, kind) => self.agent_acts(key, kind),
            Event::AgentRequest(key, request, bytes) => self.agent_request_arrives(key, request, bytes),
            Event::AgentHeard(id) => self.agent_heard(&id),
            Event::AgentExpiry(session) => self.agents_expire(session),
            Event::AgentReturns(agent) => self.agent_returns(agent),
            Event::Refit(event) => self.refit_event(event),
        }
    }

    /// The run that leads the campaign, if it is alive.
    pub fn leader(&self) -> Option<u64> {
        self.runs.keys().next_back().copied().filter(|session| !self.store.is_replaced(*session))
    }

    /// A run has ended, in whatever way. Somebody starts it again, unless the campaign is over.
    pub fn run_ends(&mut self, session: u64, why: &str) {
        let Some(run) = self.runs.remove(&session) else { return };
        self.tell(format!("run {session} ends: {why}"));
        self.process_is_dead(&run.record.id);
        // Walkers die with the process that started them.
        self.walkers.retain(|key, _| key.session != session);
        self.refitters_die_with(session);
        self.after(RESTART_DELAY, Event::StartRun);
    }

    /// What the operating system tells everybody who asks.
    pub fn process_is_dead(&mut self, id: &str) {
        let mark = sqlx::query("UPDATE process SET pid = 4294967295 WHERE id = $1").bind(id.to_owned());
        self.store.runtime.block_on(mark.execute(&mut self.direct)).unwrap();
    }

    /// The record of a living process.
    pub fn process_record(&self, kind: &str, number: Option<u32>, id: String) -> ProcessRecord {
        let record = ProcessRecord::new(kind, number, std::process::id(), self.wall_clock());
        ProcessRecord { id, host: "box".into(), ..record }
    }
}
