//! The orchestrator's end: a task that receives requests of agents, answers them, and forwards reports to the reactor.

use std::future::poll_fn;
use std::sync::Arc;
use std::time::{Duration, Instant};

use calm::Mixture;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use zenoh::Session;
use zenoh::bytes::ZBytes;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};

use super::agent_event::AgentEvent;
use super::certificates::Tls;
use super::endpoint::{self, Endpoint};
use super::message::{AGENTS, ORCHESTRATOR};
use super::replies::Replies;
use super::session::{AgentMixtures, AgentSession};
use super::side::ConnectionSide;
use super::{AgentBootstrap, NetError};
use crate::transport::Incoming;

/// Number of queued requests before zenoh applies backpressure.
const QUEUE_LENGTH: usize = 1024;
/// Interval between checks for unresponsive agents.
const EXPIRY_INTERVAL: Duration = Duration::from_millis(500);

/// The orchestrator's end of the transport. Agents can connect as soon as it is open; [`AgentServer::run`] handles
/// their requests.
pub struct AgentServer {
    endpoint: Endpoint,
    session: Session,
    queries: Queryable<FifoChannelHandler<Query>>,
    liveliness: Subscriber<FifoChannelHandler<Sample>>,
    session_id: u64,
    agent_timeout: Duration,
    bootstrap: AgentBootstrap,
}

/// Tell an [`AgentServer`] to stop.
#[derive(Clone, Debug, Default)]
pub struct StopTokens {
    /// Cancelled to ask the agents to stop.
    pub stopping: CancellationToken,
    /// Cancelled when there is no more work: [`AgentServer::run`] returns when the last agent has left.
    pub closing: CancellationToken,
}

impl AgentServer {
    /// Listens on an endpoint. `session` distinguishes this run of the orchestrator from others. Agents without
    /// heartbeat for `agent_timeout` are considered lost.
    ///
    /// # Errors
    /// An endpoint off loopback without certificates, unusable certificates, or an error of zenoh.
    pub async fn open(
        endpoint: &Endpoint,
        tls: Option<&Tls>,
        session: u64,
        agent_timeout: Duration,
        bootstrap: AgentBootstrap,
    ) -> Result<Self, NetError> {
        let endpoint = endpoint.with_free_port().map_err(|why| NetError::open(endpoint, why))?;
        let (session_id, failed) = (session, |why| NetError::open(&endpoint, why));
        let session = endpoint::open(ConnectionSide::Orchestrator, &endpoint, tls).await?;
        let channel = zenoh::handlers::FifoChannel::new(QUEUE_LENGTH);
        let queries = session.declare_queryable(ORCHESTRATOR).complete(true).with(channel);
        let queries = queries.await.map_err(failed)?;
        let channel = zenoh::handlers::FifoChannel::new(QUEUE_LENGTH);
        let liveliness = session.liveliness().declare_subscriber(format!("{AGENTS}/*")).with(channel);
        let liveliness = liveliness.await.map_err(failed)?;
        Ok(Self { endpoint, session, queries, liveliness, session_id, agent_timeout, bootstrap })
    }

    /// The endpoint it listens on.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Handles requests of agents and forwards reports to the reactor until [`StopTokens::closing`], and then
    /// until every agent has left or is lost. `mixture` is the current mixture, `original` the original one. `on_event` is called for
    /// every event of an agent.
    ///
    /// # Errors
    /// The zenoh session was closed.
    pub async fn run(
        self,
        mixture: Arc<Mixture>,
        original: Arc<Mixture>,
        StopTokens { stopping, closing }: StopTokens,
        to_reactor: mpsc::Sender<Incoming>,
        mut on_event: impl FnMut(AgentEvent) + Send + 'static,
    ) -> Result<(), NetError> {
        let mixtures = AgentMixtures::new(mixture, &original);
        let mut state = AgentSession::new(
            self.session_id,
            Replies::default(),
            self.agent_timeout,
            self.bootstrap,
            mixtures,
            stopping,
        );
        let mut is_closing = false;
        let mut expiry = tokio::time::interval(EXPIRY_INTERVAL);
        expiry.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                // Answers go before new requests.
                biased;
                () = closing.cancelled(), if !is_closing => is_closing = true,
                decision = poll_fn(|context| state.slots.poll_decision(context)) => state.handle_decision(decision),
                permit = to_reactor.reserve(), if !state.slots.outbox.is_empty() => match permit {
                    Ok(permit) => if let Some(incoming) = state.slots.outbox.pop_front() { permit.send(incoming) },
                    // The reactor has ended: all waiting walkers shut down.
                    Err(_) => state.slots.outbox.clear(),
                },
                change = self.liveliness.recv_async() => {
                    let change = change.map_err(|why| NetError::SessionClosed { why: why.to_string() })?;
                    let id = change.key_expr().as_str().rsplit('/').next().unwrap_or_default();
                    state.set_alive(id, change.kind() == SampleKind::Put, Instant::now());
                }
                query = self.queries.recv_async() => {
                    let query = query.map_err(|why| NetError::SessionClosed { why: why.to_string() })?;
                    let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
                    state.receive(&query, &payload);
                }
                _ = expiry.tick() => state.expire(Instant::now()),
            }
            state.events.drain(..).for_each(&mut on_event);
            if is_closing && state.has_no_agents() {
                break;
            }
        }
        state.finish().await;
        self.session.close().await.map_err(|why| NetError::SessionClosed { why: why.to_string() })
    }
}
