//! What the processes of a campaign are started with: they read it from standard input, as JSON, and nothing else of the
//! configuration, so a file that is edited meanwhile changes nothing.

use std::io::{self, Read};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use potentials::grace::{GraceModel, Precision, RadialPath};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use store::Protocol;
use wire::ipc::ConnectInfo;
use workers::labeller::{LabelBounds, Method, Running};
use workers::settings::WalkSettings;

use crate::config::PotentialKind;
use crate::labelling::{self, Labelling};
use crate::log;
use crate::outcome::Failure;

/// What a walker's process needs to know.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct WalkerSetup {
    /// The process that it works for, and with which it ends.
    pub parent: u32,
    /// Its way to the orchestrator.
    pub door: ConnectInfo,
    /// The exported model.
    pub model: PathBuf,
    /// BLAKE3 of that file.
    pub model_hash: String,
    /// In which it is evaluated.
    pub precision: Precision,
    /// Threads that evaluate it.
    pub threads: usize,
    /// Dynamics, bias and guards.
    pub settings: WalkSettings,
    /// Its log.
    pub log: Option<log::Setup>,
}

/// What an agent needs to know.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AgentSetup {
    /// The exported model, where the orchestrator finds it.
    pub model: PathBuf,
    /// BLAKE3 of that file.
    pub model_hash: String,
    /// In which it is evaluated.
    pub precision: Precision,
    /// Dynamics, bias and guards.
    pub settings: WalkSettings,
    /// Bytes of the largest message of a walker.
    pub message_bytes: usize,
    /// A walker without a sign of life for so long (s) is replaced …
    pub silence_limit: f64,
    /// … so many times.
    pub restarts: u32,
}

/// What a labeller's process needs to know.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct LabellerSetup {
    /// Its number among those of a run, which the next run adopts.
    pub number: Option<u32>,
    /// How often one in its place was started again.
    pub restarts: u32,
    /// What it is if `calmwalk label` started it.
    pub slot: Option<SlotSetup>,
    /// Directory of the campaign, or URL of its store.
    pub location: PathBuf,
    /// How labels are made.
    pub method: MethodSetup,
    /// The protocol.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// What is believed of a label.
    pub bounds: LabelBounds,
    /// How long a job is leased.
    pub lease: Duration,
    /// Its log. One that is adopted keeps the log that it began with.
    pub log: Option<log::Setup>,
}

/// What tells a slot of `calmwalk label` from a labeller of a run.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SlotSetup {
    /// The process with which it ends.
    pub parent: u32,
    /// Whether it leaves when the queue is empty and nobody runs the campaign, also if some walks are not over.
    pub until_empty: bool,
    /// How long a label in hand may take after a stop, s.
    pub grace: f64,
}

/// How labels are made.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum MethodSetup {
    /// By a potential that calmwalk evaluates.
    Reference {
        /// What the potential's file holds.
        kind: PotentialKind,
        /// The potential.
        file: PathBuf,
        /// BLAKE3 of that file.
        file_hash: String,
    },
    /// By a program.
    Code {
        /// Which one, and by which protocol.
        settings: Box<dft::Settings>,
        /// How its calculations run.
        running: Running,
    },
}

impl MethodSetup {
    /// The method, ready to label by that protocol: a file or a program may have been replaced meanwhile.
    pub fn load(&self, protocol: &Protocol) -> Result<Method, Failure> {
        match self {
            Self::Reference { kind, file, file_hash } => {
                unchanged(file, file_hash)?;
                let potential = kind.load(file).map_err(Failure::Input)?;
                // It may have been replaced while it was read.
                unchanged(file, file_hash)?;
                Ok(Method::reference(potential))
            }
            Self::Code { settings, running } => {
                let code = settings.prepare(&running.pass_environment).map_err(Failure::input)?;
                labelling::agrees(&labelling::identity(settings.name(), &*code), protocol)?;
                Ok(Method::code(code, running.clone()))
            }
        }
    }
}

/// Reads the setup of this process.
pub fn read<T: DeserializeOwned>() -> Result<T, Failure> {
    let mut text = String::new();
    io::stdin().read_to_string(&mut text).map_err(Failure::failed)?;
    serde_json::from_str(&text).map_err(|error| {
        Failure::Input(format!("standard input: {error}; calmwalk run starts this command, not people"))
    })
}

/// A setup as the bytes that are written to the process.
pub fn bytes(setup: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(setup).expect("plain data becomes JSON")
}

impl LabellerSetup {
    /// That of a labeller without a number.
    pub fn new(location: PathBuf, labelling: Labelling) -> Self {
        let Labelling { method, protocol, attempts, bounds, lease } = labelling;
        let (number, restarts, slot, log) = (None, 0, None, log::for_children());
        Self { number, restarts, slot, location, method, protocol, attempts, bounds, lease, log }
    }

    /// What tells two setups of labellers apart, whatever their numbers and logs: one that was started with another must be
    /// replaced.
    pub fn hash(&self) -> String {
        blake3::hash(&bytes(&Self { number: None, restarts: 0, log: None, ..self.clone() })).to_string()
    }
}

impl WalkerSetup {
    /// Reads the model, which must be the one that the campaign's run began with.
    pub fn load_model(&self) -> Result<Arc<GraceModel>, Failure> {
        unchanged(&self.model, &self.model_hash)?;
        let model = GraceModel::load_in(&self.model, self.precision, RadialPath::default());
        Ok(Arc::new(model.map_err(Failure::input)?))
    }
}

/// Checks that a file is the one that the orchestrator read.
pub fn unchanged(path: &std::path::Path, expected: &str) -> Result<(), Failure> {
    let bytes = std::fs::read(path)
        .map_err(|error| Failure::Input(format!("cannot read {}: {error}", path.display())))?;
    let found = blake3::hash(&bytes).to_string();
    if found == expected {
        return Ok(());
    }
    Err(Failure::Input(format!(
        "{}: the file has another content (BLAKE3 {found}) than when this run began ({expected}); put the old file back",
        path.display()
    )))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_program_that_was_replaced_makes_no_labels_of_the_protocol() {
        let directory = tempfile::tempdir().unwrap();
        let script = directory.path().join("label.sh");
        fs::write(&script, "exit 0").unwrap();
        let settings = serde_json::json!({ "command": {
            "command": ["sh", "label.sh"], "files": [script], "version": "1"
        } });
        let settings = Box::new(serde_json::from_value(settings).unwrap());
        let method = MethodSetup::Code { settings, running: Running::default() };
        let protocol = labelling::protocol("script", method.identity().unwrap());
        assert!(method.load(&protocol).is_ok());
        fs::write(&script, "exit 1").unwrap();
        let message = method.load(&protocol).map(drop).unwrap_err().to_string();
        assert!(
            message.contains("of another protocol than 'script'") && message.contains("label.sh"),
            "{message}"
        );
    }
}
