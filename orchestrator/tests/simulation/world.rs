//! The world of a simulation: virtual time, the queue of events, and everything that exists. One thread; the order of
//! events follows from the seed alone.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::time::{Duration, Instant};

use sqlx::SqliteConnection;
use store::{Budget, ProcessRecord, RelabelRequest, Store};

use super::agent::{AgentEventKind, AgentKey, AgentProcess};
use super::calculation::Calculation;
use super::fault::{ClientKind, Direction, FIRST_AGENT, Fault, LinkTrouble, PlannedFault, Time};
use super::faulty_store::FaultyStore;
use super::invariants::Known;
use super::labeller::{Labeller, PROTOCOL};
use super::planted::PlantedBug;
use super::random::Random;
use super::refit::RefitEvent;
use super::refitter::RefitProcesses;
use super::run::Run;
use super::scenario::Scenario;
use super::slurm::{SlurmEvent, SlurmWorld};
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

/// What happens next.
#[derive(Clone, Debug)]
pub enum Event {
    Fault(usize),
    /// The end of a pause of all walks.
    Resume,
    /// A walker is killed, and again until this time.
    KillAgain(u32, Time),
    StartRun,
    /// A message arrives at the server of a run.
    ToServer {
        from: WalkerKey,
        sequence: u64,
        bytes: Vec<u8>,
    },
    /// An answer arrives at a walker.
    ToWalker {
        to: WalkerKey,
        bytes: Vec<u8>,
    },
    WalkerStarts(WalkerKey),
    WalkerPolls(WalkerKey, u64),
    WalkerFinishes(WalkerKey, u64),
    /// A run learns that a walker's process has ended.
    WalkerGone(WalkerKey, Exit),
    CommitDue(u64),
    RunTick(u64),
    RunHeartbeat(u64),
    RunSupervises(u64),
    LabellerStarts(u32),
    LabellerActs(u32, u64),
    LabellerHeartbeat(u32),
    /// A run learns that a labeller with this record has ended.
    LabellerGone(u32, String, Exit),
    CalculationEnds(String),
    Slurm(SlurmEvent),
    Agent(AgentKey, AgentEventKind),
    /// A request of an agent arrives at the run that leads.
    AgentRequest(AgentKey, u64, Vec<u8>),
    /// The heartbeat of an agent with this id is there again.
    AgentHeard(String),
    /// A run looks for silent agents.
    AgentExpiry(u64),
    Refit(RefitEvent),
}

/// Something that happens at a time; of two at the same time, what was planned first.
struct Queued {
    at: Time,
    number: u64,
    event: Event,
}

impl PartialEq for Queued {
    fn eq(&self, other: &Self) -> bool {
        (self.at, self.number) == (other.at, other.number)
    }
}

impl Eq for Queued {}

impl PartialOrd for Queued {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Queued {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.at, self.number).cmp(&(other.at, other.number))
    }
}

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
    /// Faults of links that last, with their end.
    links: Vec<(u32, Direction, LinkTrouble, Time)>,
    pub next_session: u64,
    pub next_labeller: u32,
    /// Jobs that a person dropped or requeued.
    pub handled: BTreeSet<i64>,
    pub over: bool,
    clock_offset: i64,
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
            slurm: SlurmWorld::new(seed),
            known: Known::default(),
            violation: None,
            links: Vec::new(),
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
            if at > faults_end + TIME_TO_END || events > MAX_EVENTS {
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

    /// Sends a message, if the link lets it pass.
    pub fn send(&mut self, direction: Direction, walker: u32, event: Event) {
        let mut delay = self.random.between(1, 20);
        let mut copies = 1;
        let now = self.now;
        self.links.retain(|(.., until)| *until > now);
        let troubles: Vec<LinkTrouble> = self
            .links
            .iter()
            .filter(|(of, way, ..)| (*of, *way) == (walker, direction))
            .map(|(_, _, trouble, _)| *trouble)
            .collect();
        for trouble in troubles {
            match trouble {
                LinkTrouble::Cut => copies = 0,
                LinkTrouble::Loss => copies *= u64::from(self.random.happens(40)),
                LinkTrouble::Delay => delay += self.random.below(8_000),
                LinkTrouble::Repetition => copies *= self.random.between(1, 3),
            }
        }
        for _ in 0..copies {
            self.after(delay, event.clone());
            delay += self.random.below(3_000);
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
            Event::Refit(event) => self.refit_event(event),
        }
    }

    /// The run that leads the campaign, if it is alive.
    pub fn leader(&self) -> Option<u64> {
        self.runs.keys().next_back().copied().filter(|session| !self.store.is_replaced(*session))
    }

    fn begin_fault(&mut self, fault: Fault) {
        self.tell(fault.to_string());
        match fault {
            Fault::Link { walker, direction, trouble, until } => {
                self.links.push((walker, direction, trouble, until));
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
                self.links.push((walker, Direction::ToOrchestrator, LinkTrouble::Delay, until));
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
                    self.links.push((FIRST_AGENT + agent, direction, LinkTrouble::Cut, until));
                }
                self.mute_agent(agent, until);
            }
            Fault::KillAgentWalker { agent, walker, crash } => self.kill_agent_walker(agent, walker, crash),
            Fault::KillRefitter { after, times, crash } => {
                self.kill_refitter(after, times, if crash { Exit::Crash } else { Exit::Killed });
            }
            Fault::RollBack => self.roll_back(),
        }
    }

    fn kill_walker_again(&mut self, walker: u32, until: Time) {
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

    fn drop_job(&mut self) {
        let jobs = self.store.runtime.block_on(self.store.store.queue_list(None, 100, 0)).unwrap();
        let open: Vec<_> =
            jobs.iter().filter(|job| ["queued", "leased"].contains(&job.state.name())).collect();
        if open.is_empty() {
            return;
        }
        let job = open[self.random.below(open.len() as u64) as usize];
        self.handled.insert(job.job);
        let (name, now) = (job.candidate.clone(), self.wall_clock());
        let dropped = self.store.write(self.now, ClientKind::Labeller, "a job is dropped", async |store| {
            store.drop_job(&name, now).await
        });
        self.tell(format!("job {} is dropped: {}", job.job, dropped.is_ok()));
    }

    fn retry_job(&mut self) {
        let jobs = self.store.runtime.block_on(self.store.store.queue_list(None, 100, 0)).unwrap();
        let open = jobs.iter().find(|job| ["failed", "dropped"].contains(&job.state.name()));
        let Some(job) = open else { return };
        self.handled.insert(job.job);
        let (name, now) = (job.candidate.clone(), self.wall_clock());
        let retried = self.store.write(self.now, ClientKind::Labeller, "a job is requeued", async |store| {
            store.retry_job(&name, now).await
        });
        self.tell(format!("job {} is requeued: {}", job.job, retried.is_ok()));
    }

    fn relabel(&mut self) {
        let now = self.wall_clock();
        self.slurm.ladders.forget();
        let relabelled =
            self.store.write(self.now, ClientKind::Labeller, "new labels are requested", async |store| {
                let labelled = store.relabellable(PROTOCOL).await?;
                let structures: Vec<_> = labelled.iter().map(|found| found.content).collect();
                let request = RelabelRequest {
                    structures: &structures,
                    include_current: true,
                    reason: "doubtful",
                    protocol: None,
                };
                store.relabel(&request, now).await?;
                Ok(structures.len())
            });
        self.tell(format!("new labels are requested: {relabelled:?}"));
    }

    /// A person tries again until it is done.
    fn pause_walks(&mut self, pause: bool) {
        let now = self.wall_clock();
        let result = self.store.write(self.now, ClientKind::Labeller, "walks are paused", async |store| {
            let walks = match pause {
                true => store.active_walks().await?,
                false => store.paused_walks().await?.into_iter().collect(),
            };
            if walks.is_empty() { Ok(walks) } else { store.pause_walks(&walks, pause, now).await }
        });
        if result.is_err() && !pause {
            self.after(1_000, Event::Resume);
        }
    }

    /// The record of a living process.
    pub fn process_record(&self, kind: &str, number: Option<u32>, id: String) -> ProcessRecord {
        let record = ProcessRecord::new(kind, number, std::process::id(), self.wall_clock());
        ProcessRecord { id, host: "box".into(), ..record }
    }
}

/// How a process ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// It finished.
    Done,
    /// It gave up.
    Failed,
    Killed,
    Crash,
}

impl Exit {
    pub fn reason(self) -> orchestrator::supervisor::ExitReason {
        use orchestrator::supervisor::ExitReason;
        match self {
            Self::Done => ExitReason::Exit { code: 0, last_line: None },
            Self::Failed => ExitReason::Exit { code: 1, last_line: None },
            Self::Killed => ExitReason::Signal { signal: 9, last_line: None },
            Self::Crash => ExitReason::Signal { signal: 11, last_line: None },
        }
    }
}
