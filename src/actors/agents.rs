//! Agents of other hosts, as the orchestrator sees them.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use calm::Mixture;
use serde_json::json;
use store::{ProcessRecord, SERVER_AWAY, Store, StoreError, unix_milliseconds};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval};
use wire::net::{self, AgentEvent, Hub, NetError, Welcome};
use wire::transport::Incoming;
use workers::labeller::SIGN_OF_LIFE;

use super::Run;
use crate::outcome::Failure;
use crate::output::{count, say, warn};
use crate::setup::{self, AgentSetup};

/// Where they join, if they may.
pub struct Agents {
    hub: Option<Hub>,
    store: Store,
    mixture: Arc<Mixture>,
}

/// Ends it.
pub struct Handle(Option<net::Handle>);

impl Handle {
    /// There is no more work.
    pub fn close(&self) {
        self.0.iter().for_each(net::Handle::close);
    }
}

impl Agents {
    /// Listens where this run is to.
    pub async fn open(run: Run<'_>, session: u64, mixture: &Arc<Mixture>) -> Result<Self, Failure> {
        // What is to be written down waits here while the database is away.
        let (store, mixture) = (run.store.clone().patient(SERVER_AWAY), Arc::clone(mixture));
        let Some(listen) = run.listen else { return Ok(Self { hub: None, store, mixture }) };
        let config = &run.campaign.config;
        let model = std::path::absolute(config.potential.model.get_ref()).map_err(Failure::failed)?;
        let model_hash = run.campaign.hash_of("potential.model");
        let setup = AgentSetup {
            model: model.clone(),
            model_hash: model_hash.clone(),
            precision: config.potential.precision,
            settings: run.campaign.walk_settings(),
            message_bytes: run.campaign.largest_message(),
            silence_limit: config.run.silence_limit.seconds(),
            restarts: config.run.restarts,
        };
        let welcome = Welcome { setup: setup::bytes(&setup), files: BTreeMap::from([(model_hash, model)]) };
        let patience = config.run.agent_silence_limit.get();
        let hub = Hub::open(&listen.endpoint, listen.tls.as_ref(), session, patience, welcome).await;
        let hub = hub.map_err(|error| match error {
            NetError::Ended { .. } => Failure::failed(error),
            error => Failure::input(error),
        })?;
        listen.announce(hub.endpoint())?;
        say(format_args!("agents may join at {}", hub.endpoint()));
        Ok(Self { hub: Some(hub), store, mixture })
    }

    pub fn handle(&self) -> Handle {
        Handle(self.hub.as_ref().map(Hub::handle))
    }

    /// Listens to them until there is no more work and the last has left.
    pub async fn run(
        self,
        stopping: Arc<AtomicBool>,
        to_reactor: mpsc::Sender<Incoming>,
    ) -> Result<(), Failure> {
        let Some(hub) = self.hub else { return Ok(()) };
        let (sender, events) = mpsc::unbounded_channel();
        let happened = move |event| drop(sender.send(event));
        let (ended, ()) = tokio::join!(
            hub.run(self.mixture, stopping, to_reactor, happened),
            keep_records(&self.store, events)
        );
        ended.map_err(Failure::failed)
    }
}

/// Says what happens to agents: here, in `status`, in the operations log. A database that is busy for a moment can do
/// without.
async fn keep_records(store: &Store, mut events: mpsc::UnboundedReceiver<AgentEvent>) {
    let mut records = BTreeMap::new();
    let mut look = interval(SIGN_OF_LIFE);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let written = tokio::select! {
            event = events.recv() => match event {
                Some(event) => keep_record(store, &mut records, event).await,
                None => return,
            },
            _ = look.tick() => signs_of_life(store, &mut records).await,
        };
        if let Err(error) = written {
            warn(format_args!("cannot write down how agents are: {error}"));
        }
    }
}

async fn signs_of_life(
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

async fn keep_record(
    store: &Store,
    records: &mut BTreeMap<String, ProcessRecord>,
    event: AgentEvent,
) -> Result<(), StoreError> {
    let now = unix_milliseconds();
    let (agent, what, state) = match event {
        AgentEvent::Joined(agent) => (agent, "joined", "running"),
        AgentEvent::Silent(agent) => (agent, "gives no sign of life", "silent"),
        AgentEvent::Back(agent) => (agent, "is back", "running"),
        AgentEvent::Lost(agent) => (agent, "was silent for too long: others get its walks", "lost"),
        AgentEvent::Left(agent) => (agent, "left", "left"),
        AgentEvent::Dropped(why) => {
            warn(format_args!("a message from another host was dropped: {why}"));
            return store.log_operation(now, "messages_dropped", &json!({ "remark": why })).await;
        }
    };
    let walkers = count(agent.walkers, "walker");
    say(format_args!("agent {} (process {}, {walkers}): {what}", agent.host, agent.pid));
    let record = records.entry(agent.id.clone()).or_insert_with(|| ProcessRecord {
        id: agent.id.clone(),
        host: agent.host.clone(),
        // Not one that this host could see.
        birth: String::new(),
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
