//! Configuration of the child processes. They read it as JSON from standard input and nothing else of the campaign's
//! configuration, so editing the file during a run has no effect.

use std::io::{self, Read};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use potentials::grace::{GraceModel, Precision, RadialPath};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use store::Protocol;
use wire::ipc::ConnectInfo;
use workers::labeller::LabelBounds;
use workers::settings::WalkSettings;

use crate::exit_status::Failure;
use crate::file_hash::verify_hash;
use crate::label_method::MethodConfig;
use crate::label_setup::LabelSetup;
use crate::log;

/// Configuration of a walker process.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct WalkerConfig {
    /// Parent process. The walker ends with it.
    pub parent: u32,
    /// How to connect to the orchestrator.
    pub door: ConnectInfo,
    /// The exported model.
    pub model: PathBuf,
    /// BLAKE3 hash of that file.
    pub model_hash: String,
    /// Precision of the model's evaluation.
    pub precision: Precision,
    /// Threads that evaluate it.
    pub threads: usize,
    /// Dynamics, bias and guards.
    pub settings: WalkSettings,
    /// Its log.
    pub log: Option<log::LogConfig>,
}

/// Configuration of an agent.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AgentConfig {
    /// The exported model, at its path on the orchestrator's host.
    pub model: PathBuf,
    /// BLAKE3 hash of that file.
    pub model_hash: String,
    /// Precision of the model's evaluation.
    pub precision: Precision,
    /// Dynamics, bias and guards.
    pub settings: WalkSettings,
    /// Largest message of a walker, bytes.
    pub message_bytes: usize,
    /// Heartbeat timeout of a walker, s.
    pub heartbeat_timeout: f64,
    /// Largest number of restarts.
    pub restarts: u32,
}

/// Configuration of a labeller process.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct LabellerConfig {
    /// Number among the labellers of a run, by which the next run adopts it.
    pub number: Option<u32>,
    /// Number of restarts so far.
    pub restarts: u32,
    /// Settings of a labeller that `calmwalk label` started.
    pub slot: Option<PoolConfig>,
    /// Directory of the campaign, or URL of its store.
    pub location: PathBuf,
    /// How labels are made.
    pub method: MethodConfig,
    /// The protocol.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// Limits of plausible labels.
    pub bounds: LabelBounds,
    /// How long a job is leased.
    pub lease: Duration,
    /// Its log. An adopted labeller keeps its original log.
    pub log: Option<log::LogConfig>,
}

/// Settings of a labeller of `calmwalk label`, as opposed to one of a run.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PoolConfig {
    /// Parent process. The labeller ends with it.
    pub parent: u32,
    /// Whether to exit when the queue is empty and no run is active, even if walks are unfinished.
    pub until_empty: bool,
    /// Time that a label in progress may take after a stop, s.
    pub grace_period: f64,
}

/// Reads the configuration of this process.
pub fn from_stdin<T: DeserializeOwned>() -> Result<T, Failure> {
    let mut text = String::new();
    io::stdin().read_to_string(&mut text).map_err(Failure::failed)?;
    serde_json::from_str(&text).map_err(|error| {
        Failure::Input(format!("standard input: {error}; this command is internal, calmwalk run starts it"))
    })
}

/// The configuration as bytes for the child's standard input.
pub fn to_bytes(setup: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(setup).expect("plain data becomes JSON")
}

impl LabellerConfig {
    /// Configuration of a labeller without a number.
    pub fn new(location: PathBuf, label_setup: LabelSetup) -> Self {
        let LabelSetup { method, protocol, attempts, bounds, lease } = label_setup;
        let (number, restarts, slot, log) = (None, 0, None, log::child_config());
        Self { number, restarts, slot, location, method, protocol, attempts, bounds, lease, log }
    }

    /// Hash of everything but number and log. A running labeller with another hash must be replaced.
    pub fn hash(&self) -> String {
        blake3::hash(&to_bytes(&Self { number: None, restarts: 0, log: None, ..self.clone() })).to_string()
    }
}

impl WalkerConfig {
    /// Loads the model and checks that it is the one of the run.
    pub fn load_model(&self) -> Result<Arc<GraceModel>, Failure> {
        verify_hash(&self.model, &self.model_hash)?;
        let model = GraceModel::load_in(&self.model, self.precision, RadialPath::default());
        Ok(Arc::new(model.map_err(Failure::input)?))
    }
}
