//! How the server of a model is started.

use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::time::Duration;

use potentials::grace::Precision;
use serde::{Deserialize, Serialize};

/// Everything that the server of a model needs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PythonSettings {
    /// Directory of a virtual environment or of a conda environment (with `bin/python`), or a Python program.
    pub environment: PathBuf,
    /// Words before the Python program, for instance `apptainer exec image.sif`; `environment` is then the program inside. Relative paths
    /// are relative to the working directory.
    pub launcher: Vec<String>,
    /// An adapter of the package, or one of the user: `module:Class` or `file.py:Class`.
    pub adapter: String,
    /// The model's file or directory, for the adapter.
    pub model: Option<PathBuf>,
    /// Further settings of the adapter.
    pub options: serde_json::Map<String, serde_json::Value>,
    /// Where the model is evaluated.
    pub device: String,
    /// Precision of the model.
    pub precision: Precision,
    /// Processor threads of the server.
    pub threads: NonZeroU32,
    /// Largest number of structures of a batch.
    pub max_batch: NonZeroU32,
    /// Time for a call.
    pub timeout: Duration,
    /// Time for a call of a new shape, and for the start: frameworks compile.
    pub compile_timeout: Duration,
    /// Directory in which frameworks keep compiled programs.
    pub cache: Option<PathBuf>,
    /// Whether biased steps have one gradient for forces and bias ([`potentials::PotentialWithFeatures::evaluate_combined`]): what that
    /// needs is tested and prepared at the start.
    pub combined_gradients: bool,
}

impl PythonSettings {
    /// The usual settings of an adapter.
    pub fn new(environment: &Path, adapter: &str, model: Option<&Path>) -> Self {
        Self {
            environment: environment.to_owned(),
            launcher: Vec::new(),
            adapter: adapter.to_owned(),
            model: model.map(Path::to_owned),
            options: serde_json::Map::new(),
            device: "cpu".to_owned(),
            precision: Precision::default(),
            threads: NonZeroU32::MIN,
            max_batch: NonZeroU32::new(32).unwrap_or(NonZeroU32::MIN),
            timeout: Duration::from_secs(60),
            compile_timeout: Duration::from_secs(600),
            cache: None,
            combined_gradients: false,
        }
    }

    /// The file of an adapter `file.py:Class`, and the class.
    pub fn adapter_file(adapter: &str) -> Option<(&Path, &str)> {
        let (file, class) = adapter.rsplit_once(':')?;
        file.ends_with(".py").then_some((Path::new(file), class))
    }

    /// The Python program. Behind a launcher, only that knows what the environment is.
    pub fn program(&self) -> PathBuf {
        let is_directory = self.launcher.is_empty() && self.environment.is_dir();
        if is_directory { self.environment.join("bin/python") } else { self.environment.clone() }
    }

    /// Names adapter and environment, for errors.
    pub fn names(&self) -> String {
        format!("adapter {} in {}", self.adapter, self.environment.display())
    }
}
