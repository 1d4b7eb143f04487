//! The orchestrator's end: one task that listens to agents, answers, and hands on to the reactor.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use calm::Mixture;
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;
use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};

use super::certificates::Tls;
use super::desk::Desk;
use super::door::{self, Endpoint, Side};
use super::files::Files;
use super::message::{AGENTS, Agent, ORCHESTRATOR};
use super::{NetError, Welcome};
use crate::transport::Incoming;

/// Questions that wait in line before zenoh holds agents up.
const QUESTIONS: usize = 1024;
/// Between two looks for agents that have been silent for too long.
const LOOK: Duration = Duration::from_millis(500);

/// What happened to an agent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AgentEvent {
    /// It takes part now.
    Joined(Agent),
    /// It gives no sign of life: its link is down, or it is dead.
    Silent(Agent),
    /// It was silent and is back.
    Back(Agent),
    /// It was silent for too long: others get its turns.
    Lost(Agent),
    /// It has left in order.
    Left(Agent),
    /// A message was dropped; why.
    Dropped(String),
}

/// The orchestrator's end of the transport. Agents can connect as soon as it is open and are heard when it runs.
pub struct Hub {
    endpoint: Endpoint,
    session: Session,
    questions: Queryable<FifoChannelHandler<Query>>,
    signs: Subscriber<FifoChannelHandler<Sample>>,
    orders: mpsc::UnboundedReceiver<Close>,
    handle: Handle,
    number: u64,
    patience: Duration,
    welcome: Welcome,
}

/// Speaks to the hub's task.
#[derive(Clone, Debug)]
pub struct Handle(mpsc::UnboundedSender<Close>);

#[derive(Debug)]
struct Close;

impl Handle {
    /// There is no more work: [`Hub::run`] ends when the last agent has left.
    pub fn close(&self) {
        // After the hub's end there is nothing to be done about it.
        let _ = self.0.send(Close);
    }
}

impl Hub {
    /// Listens on an endpoint. `session` tells this run of the orchestrator from others; an agent without a sign of life
    /// for `patience` is taken for dead.
    ///
    /// # Errors
    /// An endpoint off loopback without certificates, certificates that cannot be used, whatever zenoh says.
    pub async fn open(
        endpoint: &Endpoint,
        tls: Option<&Tls>,
        session: u64,
        patience: Duration,
        welcome: Welcome,
    ) -> Result<Self, NetError> {
        let endpoint = endpoint.with_a_port().map_err(|why| NetError::open(endpoint, why))?;
        let (number, failed) = (session, |why| NetError::open(&endpoint, why));
        let session = door::open(Side::Orchestrator, &endpoint, tls).await?;
        let channel = zenoh::handlers::FifoChannel::new(QUESTIONS);
        let questions = session.declare_queryable(ORCHESTRATOR).complete(true).with(channel);
        let questions = questions.await.map_err(failed)?;
        let channel = zenoh::handlers::FifoChannel::new(QUESTIONS);
        let signs = session.liveliness().declare_subscriber(format!("{AGENTS}/*")).with(channel);
        let signs = signs.await.map_err(failed)?;
        let (sender, orders) = mpsc::unbounded_channel();
        let handle = Handle(sender);
        Ok(Self { endpoint, session, questions, signs, orders, handle, number, patience, welcome })
    }

    /// Where it listens.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// For whoever ends it.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// Listens to agents and hands on to the reactor until [`Handle::close`], and then until every agent has left or been
    /// taken for dead. `mixture` is the one in force; setting `stopping` asks agents to stop; `happened` is told what happens
    /// to them.
    ///
    /// # Errors
    /// zenoh has ended.
    pub async fn run(
        mut self,
        mixture: Arc<Mixture>,
        stopping: Arc<AtomicBool>,
        to_reactor: mpsc::Sender<Incoming>,
        mut happened: impl FnMut(AgentEvent) + Send + 'static,
    ) -> Result<(), NetError> {
        let files = Files::new(self.welcome.files);
        let mut desk = Desk::new(self.number, self.patience, self.welcome.setup, mixture, stopping);
        let mut closing = false;
        let mut decisions = FuturesUnordered::new();
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                // Decisions that nobody waits for any more end before the reactor hears why.
                biased;
                _ = self.orders.recv(), if !closing => closing = true,
                Some((slot, work)) = decisions.next() => desk.decided(slot, work),
                permit = to_reactor.reserve(), if !desk.outbox.is_empty() => match permit {
                    Ok(permit) => if let Some(incoming) = desk.outbox.pop_front() { permit.send(incoming) },
                    // The reactor has ended: whoever waits is sent home.
                    Err(_) => desk.outbox.clear(),
                },
                sign = self.signs.recv_async() => {
                    let sign = sign.map_err(|why| NetError::Ended { why: why.to_string() })?;
                    let id = sign.key_expr().as_str().rsplit('/').next().unwrap_or_default();
                    desk.sign(id, sign.kind() == SampleKind::Put, Instant::now());
                }
                query = self.questions.recv_async() => {
                    let query = query.map_err(|why| NetError::Ended { why: why.to_string() })?;
                    if let Some(decision) = desk.receive(query, &files) {
                        decisions.push(decision);
                    }
                }
                _ = look.tick() => desk.expire(Instant::now()),
            }
            desk.events.drain(..).for_each(&mut happened);
            if closing && desk.is_deserted() {
                break;
            }
        }
        desk.finish().await;
        self.session.close().await.map_err(|why| NetError::Ended { why: why.to_string() })
    }
}
