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
use workers::labeller::{ExecutionSettings, LabelBounds, Method};
use workers::settings::WalkSettings;

use crate::config::PotentialKind;
use crate::exit_status::Failure;
use crate::label_setup::{self, LabelSetup};
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

/// How labels are made.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum MethodConfig {
    /// With a potential that calmwalk evaluates.
    Reference {
        /// Format of the potential's file.
        kind: PotentialKind,
        /// The potential.
        file: PathBuf,
        /// BLAKE3 hash of that file.
        file_hash: String,
    },
    /// With an external program.
    Code {
        /// The program and the protocol.
        settings: Box<dft::Settings>,
        /// How its calculations run.
        running: ExecutionSettings,
    },
}

impl MethodConfig {
    /// Prepares the method to label by `protocol`. Fails if a file or program has been replaced.
    pub fn load(&self, protocol: &Protocol) -> Result<Method, Failure> {
        match self {
            Self::Reference { kind, file, file_hash } => {
                verify_hash(file, file_hash)?;
                let potential = kind.load(file).map_err(Failure::Input)?;
                // Detects a file that was replaced while it was read.
                verify_hash(file, file_hash)?;
                Ok(Method::reference(potential))
            }
            Self::Code { settings, running } => {
                let code = settings.prepare(&running.pass_environment).map_err(Failure::input)?;
                label_setup::check_protocol(&label_setup::code_identity(settings.name(), &*code), protocol)?;
                Ok(Method::code(code, running.clone()))
            }
        }
    }
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

/// Checks that a file has this BLAKE3 hash.
pub fn verify_hash(path: &std::path::Path, expected: &str) -> Result<(), Failure> {
    let bytes = std::fs::read(path)
        .map_err(|error| Failure::Input(format!("cannot read {}: {error}", path.display())))?;
    let found = blake3::hash(&bytes).to_string();
    if found == expected {
        return Ok(());
    }
    Err(Failure::Input(format!(
        "{}: the file has another content (BLAKE3 {found}) than when this run began ({expected}); restore the old file",
        path.display()
    )))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_replaced_program_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let script = directory.path().join("label.sh");
        fs::write(&script, "exit 0").unwrap();
        let settings = serde_json::json!({ "command": {
            "command": ["sh", "label.sh"], "files": [script], "version": "1"
        } });
        let settings = Box::new(serde_json::from_value(settings).unwrap());
        let method = MethodConfig::Code { settings, running: ExecutionSettings::default() };
        let protocol = label_setup::protocol("script", method.identity().unwrap());
        assert!(method.load(&protocol).is_ok());
        fs::write(&script, "exit 1").unwrap();
        let message = method.load(&protocol).map(drop).unwrap_err().to_string();
        assert!(
            message.contains("not belong to the campaign's protocol 'script'")
                && message.contains("label.sh"),
            "{message}"
        );
    }
}
