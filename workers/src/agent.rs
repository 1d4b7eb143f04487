//! The agent of a host: dispatches assignments of a campaign on another host to local walkers.

mod agent_core;
mod metrics;
mod pool;

use std::collections::BTreeMap;
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures_util::future::BoxFuture;
use futures_util::stream::FuturesUnordered;
use futures_util::{FutureExt, StreamExt};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_util::sync::CancellationToken;
use wire::WalkId;
use wire::messages::{AssignmentReport, WalkProgress};
use wire::net::{AgentClient, LinkError, Membership, Slot, SlotReport};
use wire::transport::{Incoming, WorkItem};

pub use self::agent_core::{AgentCore, ExchangeEnd};
pub use self::metrics::{AgentMetrics, AssignmentCounts};

/// Time between two queries whether the orchestrator wants its agents to stop.
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Minimum time between two progress messages of a walk.
const PROGRESS_INTERVAL: Duration = Duration::from_secs(1);
/// An orchestrator that has not replied for this time counts as unresponsive.
const UNRESPONSIVE_AFTER: Duration = Duration::from_secs(5);
/// How long an agent that is asked to stop waits for its last reports to be delivered.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(20);

/// Why an agent ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AgentExit {
    /// The campaign has no more work.
    Done,
    /// It was asked to stop, or has lost all its walkers.
    Stopped,
    /// The orchestrator came back with other settings or another model: the agent must join again with new walkers.
    SetupChanged,
}

/// Events of an agent, for monitoring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OrchestratorEvent {
    /// The orchestrator wants its agents to stop.
    Stop,
    /// The orchestrator does not respond.
    Unresponsive {
        /// Reports that wait to be delivered.
        unsent: usize,
        /// Walkers without an assignment.
        idle: usize,
    },
    /// The orchestrator responds again.
    Recovered,
}

/// Runs the agent's part of a campaign.
pub struct Agent {
    /// The connection to the orchestrator.
    pub client: Arc<AgentClient>,
    /// The registration with the orchestrator.
    pub joined: Membership,
    /// Messages from the walkers of this host.
    pub incoming: mpsc::Receiver<Incoming>,
    /// Cancelled to stop: walkers are dismissed, with their assignments as they are.
    pub stopping: CancellationToken,
    /// How long the orchestrator may be unresponsive before the agent gives up.
    pub orchestrator_timeout: Duration,
    /// Updated for monitoring.
    pub metrics: Arc<Mutex<AgentMetrics>>,
}

/// The result of an exchange about a slot.
type ExchangeResult = (Slot, SlotReport, Result<Option<WorkItem>, LinkError>);

/// The reply to the query whether to stop, and how long it took.
type StopReply = (Result<Option<bool>, LinkError>, Duration);

/// State of the agent's exchange with the orchestrator.
struct ExchangeState {
    client: Arc<AgentClient>,
    joined: Arc<Membership>,
    core: AgentCore<Membership>,
    in_flight: FuturesUnordered<BoxFuture<'static, ExchangeResult>>,
    /// The pending query whether to stop.
    stop_query: Option<BoxFuture<'static, StopReply>>,
    /// A new registration in progress.
    joining: Option<BoxFuture<'static, Result<Membership, LinkError>>>,
    /// When the orchestrator last replied.
    heard: Instant,
    metrics: Arc<Mutex<AgentMetrics>>,
    /// The last event reported about its silence.
    silence: Option<OrchestratorEvent>,
    /// When progress of a walk was last sent.
    last_progress: BTreeMap<WalkId, Instant>,
}

impl Agent {
    /// Runs until there is no more work or the agent is asked to stop.
    ///
    /// # Errors
    /// The orchestrator is unresponsive, or its program is incompatible with this one.
    pub async fn run(mut self, mut watch: impl FnMut(OrchestratorEvent)) -> Result<AgentExit, LinkError> {
        let slots = self.joined.slots();
        let client = Arc::clone(&self.client);
        let mut over = pin!(client.address().wait_until_over());
        let mut stop = pin!(self.stopping.cancelled().fuse());
        let mut state = ExchangeState::new(self.client, self.joined, self.metrics);
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
                joined = answer_to(&mut state.joining) => {
                    let joined = joined?;
                    if joined.setup != state.joined.setup {
                        // Its walkers have other settings or another model, and so have their reports.
                        state.core.dismiss_idle();
                        joined.leave().await;
                        return Ok(AgentExit::SetupChanged);
                    }
                    state.has_joined(joined);
                }
                (reply, took) = answer_to(&mut state.stop_query) => if state.handle_stop_reply(reply, took)? { watch(OrchestratorEvent::Stop) },
                _ = ticks.tick() => state.poll(self.orchestrator_timeout)?.into_iter().for_each(&mut watch),
                () = &mut stop => {}
                // The orchestrator no longer knew of this agent, or it would have waited.
                () = &mut over => {
                    state.core.dismiss_idle();
                    return Ok(AgentExit::Done);
                }
            }
            if self.stopping.is_cancelled() {
                state.core.dismiss_idle();
                if state.core.pool.is_idle() {
                    break;
                }
            } else if state.core.is_over() {
                // The campaign is over or being stopped.
                let stopped = matches!(state.joined.is_stopping().await, Ok(Some(true)));
                state.core.dismiss_idle();
                state.joined.leave().await;
                return Ok(if stopped { AgentExit::Stopped } else { AgentExit::Done });
            }
        }
        // With a timeout: a broken connection must not keep a batch job beyond its time limit.
        let _ = timeout(FLUSH_TIMEOUT, state.flush()).await;
        state.joined.leave().await;
        Ok(AgentExit::Stopped)
    }
}

/// Waits for the reply to a pending query; never ends without one.
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

impl ExchangeState {
    fn new(client: Arc<AgentClient>, joined: Membership, metrics: Arc<Mutex<AgentMetrics>>) -> Self {
        Self {
            client,
            joined: Arc::new(joined),
            core: AgentCore::default(),
            in_flight: FuturesUnordered::new(),
            stop_query: None,
            joining: None,
            heard: Instant::now(),
            metrics,
            silence: None,
            last_progress: BTreeMap::new(),
        }
    }

    fn metrics(&self) -> MutexGuard<'_, AgentMetrics> {
        self.metrics.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that the orchestrator has replied.
    fn mark_heard(&mut self) {
        self.heard = Instant::now();
        self.metrics().heard = Some(self.heard);
    }

    fn start(&mut self, slots: Vec<Slot>) {
        self.mark_heard();
        self.metrics().joins += 1;
        for (slot, report) in self.core.start(slots) {
            self.exchange(slot, report);
        }
    }

    /// Starts to deliver the result of a slot's assignment and to ask for the next one.
    fn exchange(&mut self, mut slot: Slot, report: SlotReport) {
        let joined = Arc::clone(&self.joined);
        self.in_flight.push(Box::pin(async move {
            let result = slot.exchange(&joined, &report).await;
            (slot, report, result)
        }));
    }

    fn handle(&mut self, message: Incoming) {
        match &message {
            Incoming::Progress(walk, progress) => {
                self.metrics().record_progress(*walk, progress);
                self.forward_progress(*walk, progress.clone());
            }
            Incoming::Idle { report: Some(AssignmentReport { walk, progress, .. }), .. } => {
                self.metrics().record_progress(*walk, progress);
            }
            _ => {}
        }
        if let Some((slot, report)) = self.core.handle(message) {
            self.exchange(slot, report);
        }
        self.update_metrics();
    }

    /// Updates the number of waiting reports and idle walkers.
    fn update_metrics(&self) {
        let mut metrics = self.metrics();
        (metrics.unsent, metrics.idle) = (self.core.unsent(), self.core.pool.idle());
    }

    fn exchanged(&mut self, (slot, report, result): ExchangeResult) -> Result<(), LinkError> {
        self.mark_heard();
        if result.is_ok() {
            self.metrics().delivered(&report);
        }
        let end = match result {
            Ok(Some(work)) => {
                self.metrics().received(&work.assignment, work.mixture.version());
                ExchangeEnd::Work(Box::new(work))
            }
            Ok(None) => ExchangeEnd::Closed,
            Err(LinkError::RejoinRequired(_)) => ExchangeEnd::RejoinRequired,
            Err(parted) => return Err(parted),
        };
        if self.core.exchanged(slot, report, end) {
            self.join();
        }
        self.switch_session();
        self.update_metrics();
        Ok(())
    }

    fn join(&mut self) {
        let client = Arc::clone(&self.client);
        self.joining = Some(Box::pin(async move { client.join().await }));
    }

    fn has_joined(&mut self, joined: Membership) {
        self.core.has_joined(joined);
        self.switch_session();
    }

    fn switch_session(&mut self) {
        if let Some(joined) = self.core.take_joined() {
            let slots = joined.slots();
            self.joined = Arc::new(joined);
            self.start(slots);
        }
    }

    /// Queries whether to stop. Fails if the orchestrator has been unresponsive for longer than
    /// `orchestrator_timeout`. Returns an event if its responsiveness changed.
    fn poll(&mut self, orchestrator_timeout: Duration) -> Result<Option<OrchestratorEvent>, LinkError> {
        let silence = self.heard.elapsed();
        if silence > orchestrator_timeout {
            return Err(LinkError::Timeout { minutes: orchestrator_timeout.as_secs_f64() / 60.0 });
        }
        let joined = Arc::clone(&self.joined);
        self.stop_query.get_or_insert_with(|| {
            Box::pin(async move {
                let asked = Instant::now();
                (joined.is_stopping().await, asked.elapsed())
            })
        });
        let now = (silence > UNRESPONSIVE_AFTER).then(|| OrchestratorEvent::Unresponsive {
            unsent: self.core.unsent(),
            idle: self.core.pool.idle(),
        });
        let before = std::mem::replace(&mut self.silence, now);
        Ok(if now.is_none() {
            before.map(|_| OrchestratorEvent::Recovered)
        } else {
            now.filter(|_| now != before)
        })
    }

    fn handle_stop_reply(
        &mut self,
        reply: Result<Option<bool>, LinkError>,
        took: Duration,
    ) -> Result<bool, LinkError> {
        match reply {
            Ok(None) => return Ok(false),
            Err(LinkError::RejoinRequired(_)) => {
                if self.core.rejoin() {
                    self.join();
                }
            }
            Err(parted) => return Err(parted),
            Ok(Some(_)) => {}
        }
        self.mark_heard();
        self.metrics().round_trip = Some(took);
        Ok(matches!(reply, Ok(Some(true))))
    }

    /// Sends the progress of a walk, once a second.
    fn forward_progress(&mut self, walk: WalkId, progress: WalkProgress) {
        let now = Instant::now();
        if self.last_progress.get(&walk).is_some_and(|last| now.duration_since(*last) < PROGRESS_INTERVAL) {
            return;
        }
        if let Some(slot) = self.core.pool.slot_of(walk) {
            self.last_progress.insert(walk, now);
            tokio::spawn(slot.progress(Arc::clone(&self.joined), walk, progress));
        }
    }

    /// Waits until every report is delivered. Reports under a lost registration are not: the orchestrator treats
    /// their assignments as not started, and they start again.
    async fn flush(&mut self) {
        while self.core.delivering() > 0 {
            let Some((_, report, _)) = self.in_flight.next().await else { return };
            self.core.flushed(&report);
        }
    }
}
