//! The agent of a host: deals the turns of a campaign that is led from another host to the walkers here.

mod metrics;
mod pool;

use std::collections::BTreeMap;
use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use futures_util::future::BoxFuture;
use futures_util::stream::FuturesUnordered;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, timeout};
use wire::WalkId;
use wire::messages::{Progress, Report};
use wire::net::{Joined, Parted, Slot, Told, Uplink};
use wire::transport::{Incoming, Work};

pub use self::metrics::{AgentMetrics, AssignmentCounts};
use self::pool::AssignmentPool;

/// Between two questions whether the orchestrator wants its agents to stop.
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Between two pieces of news about a walk.
const PROGRESS_INTERVAL: Duration = Duration::from_secs(1);
/// An orchestrator that is there answers sooner.
const UNRESPONSIVE_AFTER: Duration = Duration::from_secs(5);
/// What walkers delivered last may take so long on its way when the agent is asked to stop.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(20);

/// How an agent's work ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AgentExit {
    /// The campaign has no more work.
    Done,
    /// It was asked to stop, or every walker is gone.
    Stopped,
}

/// What an agent tells those who watch it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AgentEvent {
    /// The orchestrator wants its agents to stop.
    Stop,
    /// It does not answer.
    Unresponsive {
        /// Reports that are kept for it.
        unsent: usize,
        /// Walkers that have nothing to do.
        idle: usize,
    },
    /// It answers again.
    Recovered,
}

/// Deals turns.
pub struct Agent {
    /// The line to the orchestrator.
    pub uplink: Arc<Uplink>,
    /// The place that it has been given there.
    pub joined: Joined,
    /// What comes from the walkers of this host.
    pub incoming: mpsc::Receiver<Incoming>,
    /// Set from outside: walkers are sent home with their turns where they stand.
    pub stopping: Arc<AtomicBool>,
    /// An orchestrator that has been silent for so long will not come back.
    pub orchestrator_timeout: Duration,
    /// Kept for those who watch.
    pub metrics: Arc<Mutex<AgentMetrics>>,
}

/// What an exchange about a slot came to.
type ExchangeResult = (Slot, Told, Result<Option<Work>, Parted>);

/// The answer to the question whether to stop, and how long it took.
type StopReply = (Result<Option<bool>, Parted>, Duration);

/// What an agent has to say and to ask.
struct AgentState {
    uplink: Arc<Uplink>,
    joined: Arc<Joined>,
    pool: AssignmentPool,
    in_flight: FuturesUnordered<BoxFuture<'static, ExchangeResult>>,
    /// Those of them that deliver something.
    delivering: usize,
    /// Whether the orchestrator wants its agents to stop.
    stop_query: Option<BoxFuture<'static, StopReply>>,
    /// A new place, when this one has been lost …
    joining: Option<BoxFuture<'static, Result<Joined, Parted>>>,
    /// … which is taken when all that was asked from the old one has been answered.
    next_joined: Option<Joined>,
    /// When the orchestrator was last heard.
    heard: Instant,
    metrics: Arc<Mutex<AgentMetrics>>,
    /// What was told of its silence.
    silence: Option<AgentEvent>,
    /// When there was last news of a walk.
    last_progress: BTreeMap<WalkId, Instant>,
}

impl Agent {
    /// Works until there is no more work or it is asked to stop.
    ///
    /// # Errors
    /// The orchestrator is silent, or it and this program do not understand each other.
    pub async fn run(mut self, mut watch: impl FnMut(AgentEvent)) -> Result<AgentExit, Parted> {
        let slots = self.joined.slots();
        let uplink = Arc::clone(&self.uplink);
        let mut over = pin!(uplink.address().over());
        let mut state = AgentState::new(self.uplink, self.joined, self.metrics);
        state.metrics().mixture_version = Some(state.joined.newest().await.version());
        state.start(slots);
        let mut ticks = interval(POLL_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                message = self.incoming.recv() => match message {
                    Some(message) => state.handle(message),
                    None => break,
                },
                Some(exchanged) = state.in_flight.next() => state.exchanged(exchanged)?,
                joined = answer_to(&mut state.joining) => state.has_joined(joined?),
                (told, took) = answer_to(&mut state.stop_query) => if state.handle_stop_reply(told, took)? { watch(AgentEvent::Stop) },
                _ = ticks.tick() => state.poll(self.orchestrator_timeout)?.into_iter().for_each(&mut watch),
                // Of this agent the orchestrator knew nothing any more, or it would have waited.
                () = &mut over => {
                    state.pool.dismiss_idle();
                    return Ok(AgentExit::Done);
                }
            }
            if self.stopping.load(Ordering::Relaxed) {
                state.pool.dismiss_idle();
                if state.pool.is_idle() {
                    break;
                }
            } else if state.pool.is_over() {
                // Of a campaign that is over, or of one that is being stopped.
                let stopped = matches!(state.joined.is_stopping().await, Ok(Some(true)));
                state.pool.dismiss_idle();
                state.joined.leave().await;
                return Ok(if stopped { AgentExit::Stopped } else { AgentExit::Done });
            }
        }
        // Not for ever: a line that is down must not keep a batch job beyond its time.
        let _ = timeout(FLUSH_TIMEOUT, state.flush()).await;
        state.joined.leave().await;
        Ok(AgentExit::Stopped)
    }
}

/// The answer to a question, if one was asked.
async fn answer_to<T>(stop_query: &mut Option<BoxFuture<'static, T>>) -> T {
    match stop_query {
        Some(asked) => {
            let answer = asked.await;
            *stop_query = None;
            answer
        }
        None => std::future::pending().await,
    }
}

impl AgentState {
    fn new(uplink: Arc<Uplink>, joined: Joined, metrics: Arc<Mutex<AgentMetrics>>) -> Self {
        Self {
            uplink,
            joined: Arc::new(joined),
            pool: AssignmentPool::default(),
            in_flight: FuturesUnordered::new(),
            delivering: 0,
            stop_query: None,
            joining: None,
            next_joined: None,
            heard: Instant::now(),
            metrics,
            silence: None,
            last_progress: BTreeMap::new(),
        }
    }

    fn metrics(&self) -> MutexGuard<'_, AgentMetrics> {
        self.metrics.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Somebody is there.
    fn mark_heard(&mut self) {
        self.heard = Instant::now();
        self.metrics().heard = Some(self.heard);
    }

    fn start(&mut self, slots: Vec<Slot>) {
        self.mark_heard();
        self.metrics().joins += 1;
        for (slot, told) in self.pool.start(slots) {
            self.exchange(slot, told);
        }
    }

    /// Begins to deliver what came of a slot's turn, and to ask for the next.
    fn exchange(&mut self, mut slot: Slot, told: Told) {
        self.delivering += usize::from(!matches!(told, Told::Nothing));
        let joined = Arc::clone(&self.joined);
        self.in_flight.push(Box::pin(async move {
            let result = slot.exchange(&joined, &told).await;
            (slot, told, result)
        }));
    }

    fn handle(&mut self, message: Incoming) {
        let next = match message {
            Incoming::Progress(walk, progress) => {
                self.metrics().record_progress(walk, &progress);
                self.forward_progress(walk, progress);
                None
            }
            Incoming::Free { walker, report, reply } => {
                if let Some(Report { walk, progress, .. }) = &report {
                    self.metrics().record_progress(*walk, progress);
                }
                self.pool.walker_idle(walker, report, reply)
            }
            Incoming::Gone { walker, fault } => self.pool.walker_lost(walker, fault),
        };
        if let Some((slot, told)) = next {
            self.exchange(slot, told);
        }
        self.update_metrics();
    }

    /// What is kept, and who waits.
    fn update_metrics(&self) {
        let mut metrics = self.metrics();
        (metrics.unsent, metrics.idle) = (self.unsent(), self.pool.idle());
    }

    /// Reports that the orchestrator has not taken yet.
    fn unsent(&self) -> usize {
        self.delivering + self.pool.unsent()
    }

    fn exchanged(&mut self, (slot, told, result): ExchangeResult) -> Result<(), Parted> {
        self.mark_heard();
        self.delivering -= usize::from(!matches!(told, Told::Nothing));
        if result.is_ok() {
            self.metrics().delivered(&told);
        }
        match result {
            Ok(Some(work)) => {
                self.metrics().received(&work.assignment, work.mixture.version());
                self.pool.assign(slot, work);
            }
            Ok(None) => self.pool.slot_closed(),
            Err(Parted::Stranger(_)) => {
                self.pool.keep_unsent(told);
                self.rejoin();
            }
            Err(parted) => return Err(parted),
        }
        self.switch_session();
        self.update_metrics();
        Ok(())
    }

    /// This agent was taken for dead, or the orchestrator was started again: what it has to tell it tells in a new place.
    fn rejoin(&mut self) {
        if self.joining.is_none() && self.next_joined.is_none() {
            let uplink = Arc::clone(&self.uplink);
            self.joining = Some(Box::pin(async move { uplink.join().await }));
        }
    }

    fn has_joined(&mut self, joined: Joined) {
        self.next_joined = Some(joined);
        self.switch_session();
    }

    fn switch_session(&mut self) {
        if !self.in_flight.is_empty() {
            return;
        }
        if let Some(joined) = self.next_joined.take() {
            let slots = joined.slots();
            self.joined = Arc::new(joined);
            self.start(slots);
        }
    }

    /// Asks whether to stop, unless the orchestrator has been silent for so long that it is of no use. Returns what is new
    /// of its silence.
    fn poll(&mut self, orchestrator_timeout: Duration) -> Result<Option<AgentEvent>, Parted> {
        let silence = self.heard.elapsed();
        if silence > orchestrator_timeout {
            return Err(Parted::Silence { minutes: orchestrator_timeout.as_secs_f64() / 60.0 });
        }
        let joined = Arc::clone(&self.joined);
        self.stop_query.get_or_insert_with(|| {
            Box::pin(async move {
                let asked = Instant::now();
                (joined.is_stopping().await, asked.elapsed())
            })
        });
        let now = (silence > UNRESPONSIVE_AFTER)
            .then(|| AgentEvent::Unresponsive { unsent: self.unsent(), idle: self.pool.idle() });
        let before = std::mem::replace(&mut self.silence, now);
        Ok(if now.is_none() { before.map(|_| AgentEvent::Recovered) } else { now.filter(|_| now != before) })
    }

    fn handle_stop_reply(
        &mut self,
        told: Result<Option<bool>, Parted>,
        took: Duration,
    ) -> Result<bool, Parted> {
        match told {
            Ok(None) => return Ok(false),
            Err(Parted::Stranger(_)) => self.rejoin(),
            Err(parted) => return Err(parted),
            Ok(Some(_)) => {}
        }
        self.mark_heard();
        self.metrics().round_trip = Some(took);
        Ok(matches!(told, Ok(Some(true))))
    }

    /// Where a walk stands, once a second.
    fn forward_progress(&mut self, walk: WalkId, progress: Progress) {
        let now = Instant::now();
        if self.last_progress.get(&walk).is_some_and(|last| now.duration_since(*last) < PROGRESS_INTERVAL) {
            return;
        }
        if let Some(slot) = self.pool.slot_of(walk) {
            self.last_progress.insert(walk, now);
            tokio::spawn(slot.progress(Arc::clone(&self.joined), walk, progress));
        }
    }

    /// Waits until everything that is to be told has been taken. From a place that is lost it is not told: as far as the
    /// orchestrator knows nobody has those turns in hand, and they begin again where they began.
    async fn flush(&mut self) {
        while self.delivering > 0 {
            let Some((_, told, _)) = self.in_flight.next().await else { return };
            self.delivering -= usize::from(!matches!(told, Told::Nothing));
        }
    }
}
