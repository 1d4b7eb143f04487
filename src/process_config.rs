//! Configuration of the child processes. They read it as JSON from standard input and nothing else of the campaign's
//! configuration, so editing the file during a run has no effect.

use std::io::{self, Read};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use atoms::Structure;
use bridge::{ModelDescription, ModelReference, PythonModel, PythonSettings};
use calm::Projection;
use potentials::ModelWithFeatures;
use potentials::grace::{GraceModel, Precision, RadialPath};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use store::Protocol;
use tokio_util::sync::CancellationToken;
use wire::ipc::{CallAddress, ConnectInfo};
use workers::labeller::LabelBounds;
use workers::settings::WalkSettings;

use crate::exit_status::CommandError;
use crate::file_hash::verify_hash;
use crate::grace_projection::with_projection;
use crate::label_method::MethodConfig;
use crate::label_setup::LabelSetup;
use crate::log;

/// The files of a model.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFiles {
    /// The exported model.
    pub export: HashedFile,
    /// The artifact, if the model has no projection of its features but that of the artifact.
    pub artifact: Option<HashedFile>,
    /// Precision of the model's evaluation.
    pub precision: Precision,
}

/// The model of a campaign for agents, with paths of the orchestrator's host.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case")]
pub enum AgentModel {
    /// An export of GRACE.
    Grace(ModelFiles),
    /// A model that a program of the agent evaluates.
    Python(Box<AgentPythonModel>),
}

/// What an agent needs for a program of its own.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AgentPythonModel {
    /// How the program of each device is started.
    pub settings: Vec<PythonSettings>,
    /// What the agent's program must say of its model.
    pub reference: ModelReference,
    /// Whether its results must have the same bits.
    pub is_reproducible: bool,
    /// The model's file, if it is one file.
    pub model: Option<HashedFile>,
    /// The adapter's file, if it is one of the user.
    pub adapter: Option<HashedFile>,
    /// The artifact with the projection of its invariants, if they are projected.
    pub artifact: Option<HashedFile>,
    /// The largest seed structure, for the first batches.
    pub largest: Structure,
}

/// The model of a walker.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case")]
pub enum WalkerModel {
    /// An export of GRACE.
    Grace(ModelFiles),
    /// A model of a device of this host.
    Python(Box<DeviceModel>),
}

/// A model of the devices of a host.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceModel {
    /// The model.
    pub description: ModelDescription,
    /// The artifact with the projection of its invariants, if they are projected.
    pub artifact: Option<HashedFile>,
}

/// A file whose content must not change.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct HashedFile {
    /// Where it is.
    pub path: PathBuf,
    /// Its BLAKE3 hash.
    pub hash: String,
}

/// Configuration of a walker process.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct WalkerConfig {
    /// Parent process. The walker ends with it.
    pub parent: u32,
    /// How to connect to the orchestrator.
    pub connect_info: ConnectInfo,
    /// The model.
    pub model: WalkerModel,
    /// Where calls of its device go, for a model in Python.
    pub device: Option<CallAddress>,
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
    /// The model.
    pub model: AgentModel,
    /// Dynamics, bias and guards.
    pub settings: WalkSettings,
    /// Largest message of a walker, bytes.
    pub message_bytes: usize,
    /// Heartbeat timeout of a walker, s.
    pub heartbeat_timeout: f64,
    /// Largest number of restarts.
    pub max_restarts: u32,
    /// Whether the campaign trains new versions of its potential: the agent joins again for the next one.
    pub has_versions: bool,
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
    pub pool: Option<PoolConfig>,
    /// Directory of the campaign, or URL of its store.
    pub location: PathBuf,
    /// How labels are made.
    pub method: MethodConfig,
    /// The protocol.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub max_attempts: u32,
    /// Limits of plausible labels.
    pub bounds: LabelBounds,
    /// How long a job is leased.
    pub lease_timeout: Duration,
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
pub fn from_stdin<T: DeserializeOwned>() -> Result<T, CommandError> {
    let mut text = String::new();
    io::stdin().read_to_string(&mut text).map_err(CommandError::failed)?;
    serde_json::from_str(&text).map_err(|error| {
        CommandError::Input(format!(
            "standard input: {error}; this command is internal, calmwalk run starts it"
        ))
    })
}

/// The configuration as bytes for the child's standard input.
pub fn to_bytes(setup: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(setup).expect("plain data becomes JSON")
}

impl LabellerConfig {
    /// Configuration of a labeller without a number.
    pub fn new(location: PathBuf, label_setup: LabelSetup) -> Self {
        let LabelSetup { method, protocol, max_attempts, bounds, lease_timeout } = label_setup;
        let (number, restarts, pool, log) = (None, 0, None, log::child_config());
        Self { number, restarts, pool, location, method, protocol, max_attempts, bounds, lease_timeout, log }
    }

    /// Hash of everything but number and log. A running labeller with another hash must be replaced.
    pub fn hash(&self) -> String {
        blake3::hash(&to_bytes(&Self { number: None, restarts: 0, log: None, ..self.clone() })).to_string()
    }
}

impl ModelFiles {
    /// Loads the model and checks that it is the one of the run.
    pub fn load(&self) -> Result<Arc<GraceModel>, CommandError> {
        verify_hash(&self.export.path, &self.export.hash)?;
        let model = GraceModel::load_in(&self.export.path, self.precision, RadialPath::default());
        let mut model = model.map_err(CommandError::input)?;
        if let Some(artifact) = &self.artifact {
            verify_hash(&artifact.path, &artifact.hash)?;
            let projection = Projection::load(&artifact.path).map_err(CommandError::input)?;
            model = with_projection(model, &projection).map_err(CommandError::input)?;
        }
        Ok(Arc::new(model))
    }

    /// All files.
    pub fn files(&self) -> impl Iterator<Item = &HashedFile> {
        std::iter::once(&self.export).chain(&self.artifact)
    }
}

impl AgentModel {
    /// All files that an agent downloads if they are not on its host.
    pub fn files(&self) -> Vec<&HashedFile> {
        match self {
            Self::Grace(files) => files.files().collect(),
            Self::Python(python) => {
                [&python.model, &python.adapter, &python.artifact].into_iter().flatten().collect()
            }
        }
    }
}

impl WalkerModel {
    /// Loads the model of this process, whose calls go to `device`. Cancelling `stopping` ends calls of a device that does not answer.
    pub fn load(
        &self,
        device: Option<&CallAddress>,
        stopping: &CancellationToken,
    ) -> Result<Arc<dyn ModelWithFeatures>, CommandError> {
        let DeviceModel { description, artifact } = match self {
            Self::Grace(files) => return Ok(files.load()?),
            Self::Python(model) => &**model,
        };
        let address = device.ok_or_else(|| CommandError::input("the model has no device"))?;
        let model = PythonModel::shared(description.clone(), address.clone(), stopping.clone());
        let model = model.map_err(CommandError::Input)?;
        let Some(artifact) = artifact else { return Ok(Arc::new(model)) };
        verify_hash(&artifact.path, &artifact.hash)?;
        let projection = Projection::load(&artifact.path).map_err(CommandError::input)?;
        Ok(Arc::new(model.projected(projection).map_err(CommandError::Input)?))
    }
}
