//! Serves the agents of other hosts on the orchestrator's side.

use std::collections::BTreeMap;
use std::sync::Arc;

use calm::Mixture;
use serde_json::json;
use store::{ProcessRecord, SERVER_RECONNECT_TIMEOUT, Store, StoreError, unix_milliseconds};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval};
use wire::net::{AgentBootstrap, AgentEvent, AgentServer, NetError, StopTokens};
use wire::transport::Incoming;
use workers::labeller::HEARTBEAT_INTERVAL;

use super::RunContext;
use super::walker_host::HostMixtures;
use crate::exit_status::CommandError;
use crate::output::{count, log_and_print, log_and_warn};
use crate::process_config;

/// Lets agents join if this run listens.
pub struct AgentService {
    server: Option<AgentServer>,
    store: Store,
    mixture: Arc<Mixture>,
    original: Arc<Mixture>,
}

impl AgentService {
    /// Starts to listen if the run is configured to.
    pub async fn open(
        run: RunContext<'_>,
        session: u64,
        HostMixtures { newest, original }: HostMixtures<'_>,
    ) -> Result<Self, CommandError> {
        // Writes wait here while the database is unreachable.
        let store = run.store.clone().with_reconnect_timeout(SERVER_RECONNECT_TIMEOUT);
        let (mixture, original) = (Arc::clone(newest), Arc::clone(original));
        let Some(listen) = run.listen else { return Ok(Self { server: None, store, mixture, original }) };
        let setup = run.campaign.agent_config()?;
        let files =
            setup.model.files().into_iter().map(|file| (file.hash.clone(), file.path.clone())).collect();
        let bootstrap = AgentBootstrap { setup: process_config::to_bytes(&setup), files };
        let heartbeat_timeout = run.campaign.config.run.agent_heartbeat_timeout.get();
        let server =
            AgentServer::open(&listen.endpoint, listen.tls.as_ref(), session, heartbeat_timeout, bootstrap)
                .await;
        let server = server.map_err(|error| match error {
            NetError::SessionClosed { .. } => CommandError::failed(error),
            error => CommandError::input(error),
        })?;
        listen.announce(server.endpoint())?;
        log_and_print(format_args!("agents may join at {}", server.endpoint()));
        Ok(Self { server: Some(server), store, mixture, original })
    }

    /// Serves agents until there is no more work and the last agent has left.
    pub async fn run(self, stop: StopTokens, to_reactor: mpsc::Sender<Incoming>) -> Result<(), CommandError> {
        let Some(server) = self.server else { return Ok(()) };
        let (sender, events) = mpsc::unbounded_channel();
        let on_event = move |event| drop(sender.send(event));
        let (ended, ()) = tokio::join!(
            server.run(self.mixture, self.original, stop, to_reactor, on_event),
            record_events(&self.store, events)
        );
        ended.map_err(CommandError::failed)
    }
}

/// Reports the agents' events: on standard error, in `status` and in the operations log. Skips what a busy database
/// cannot take.
async fn record_events(store: &Store, mut events: mpsc::UnboundedReceiver<AgentEvent>) {
    let mut records = BTreeMap::new();
    let mut heartbeats = interval(HEARTBEAT_INTERVAL);
    heartbeats.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let written = tokio::select! {
            event = events.recv() => match event {
                Some(event) => record_event(store, &mut records, event).await,
                None => return,
            },
            _ = heartbeats.tick() => write_heartbeats(store, &mut records).await,
        };
        if let Err(error) = written {
            log_and_warn(format_args!("cannot record the state of agents: {error}"));
        }
    }
}

async fn write_heartbeats(
    store: &Store,
    records: &mut BTreeMap<String, ProcessRecord>,
) -> Result<(), StoreError> {
    let living = records.values_mut().filter(|record| record.state == "running");
    let living: Vec<_> = living
        .map(|record| {
            record.last_seen = unix_milliseconds();
            record.clone()
        })
        .collect();
    store.upsert_processes(&living).await
}

async fn record_event(
    store: &Store,
    records: &mut BTreeMap<String, ProcessRecord>,
    event: AgentEvent,
) -> Result<(), StoreError> {
    let now = unix_milliseconds();
    let (agent, what, state) = match event {
        AgentEvent::Joined(agent) => (agent, "joined", "running"),
        AgentEvent::Unresponsive(agent) => (agent, "sends no heartbeat", "unresponsive"),
        AgentEvent::Recovered(agent) => (agent, "is back", "running"),
        AgentEvent::Lost(agent) => (agent, "timed out: its walks go to other walkers", "lost"),
        AgentEvent::Left(agent) => (agent, "left", "left"),
        AgentEvent::MessageRejected(why) => {
            log_and_warn(format_args!("rejected a message from another host: {why}"));
            return store.log_operation(now, "messages_rejected", &json!({ "remark": why })).await;
        }
    };
    let walkers = count(agent.walkers, "walker");
    log_and_print(format_args!("agent {} (process {}, {walkers}): {what}", agent.host, agent.pid));
    let record = records.entry(agent.id.clone()).or_insert_with(|| ProcessRecord {
        id: agent.id.clone(),
        host: agent.host.clone(),
        // This host cannot check whether the process lives.
        start_time: String::new(),
        ..ProcessRecord::new(ProcessRecord::AGENT, None, agent.pid, now)
    });
    (record.last_seen, record.state) = (now, state.to_owned());
    record.remark = walkers;
    if state == "left" {
        records.remove(&agent.id);
        store.remove_process(&agent.id).await?;
    } else {
        store.upsert_process(record).await?;
    }
    let detail = json!({ "id": agent.id, "host": agent.host, "pid": agent.pid, "walkers": agent.walkers, "what": what });
    store.log_operation(now, "agent", &detail).await
}
