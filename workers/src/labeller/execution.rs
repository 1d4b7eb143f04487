//! How and where calculations run.

use std::path::PathBuf;

use ::batch::CustomScheduler;
use dft::PassedEnvironment;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How to run the calculations of another program. None of these settings changes the results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExecutionSettings {
    /// Cores per calculation, given to the program as `CALMWALK_CORES`. Core-hours are counted with it.
    pub cores: u32,
    /// GPUs per calculation, given to the program as `CALMWALK_GPUS`; 0 for none. A batch system is asked for them.
    #[serde(skip_serializing_if = "is_zero")]
    pub gpus: u32,
    /// Maximum time of a calculation, s.
    pub time_limit: f64,
    /// Maximum memory of all processes of a calculation together, GB (10⁹ bytes); `None` for no limit.
    pub memory: Option<f64>,
    /// Directory for calculations, on a disk of this host; `None` for the system's temporary directory. With a
    /// batch system every node must see it.
    pub scratch: Option<PathBuf>,
    /// What to do with the directory after a calculation.
    pub keep: KeepDirectories,
    /// Variables of the labeller's environment that the program gets in addition to the default ones.
    #[serde(skip_serializing_if = "PassedEnvironment::is_empty")]
    pub pass_environment: PassedEnvironment,
    /// The batch system that runs each calculation as a job; `None` for processes on this host.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch_system: Option<BatchSystem>,
    /// Further options of its jobs, in the syntax of the batch system's command.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub batch_options: Vec<String>,
    /// The batch system of [`BatchSystem::Custom`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scheduler: Option<Box<CustomScheduler>>,
}

/// A batch system that runs calculations as jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BatchSystem {
    /// Slurm.
    Slurm,
    /// The one that `launch.custom` describes.
    Custom,
}

/// Which directories of calculations to pack into the store; all others are removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum KeepDirectories {
    /// None.
    Nothing,
    /// Directories of failed calculations.
    #[default]
    Failed,
    /// All.
    All,
}

impl KeepDirectories {
    /// Whether to keep the directory of a calculation.
    pub(super) fn keeps(self, failed: bool) -> bool {
        match self {
            Self::Nothing => false,
            Self::Failed => failed,
            Self::All => true,
        }
    }
}

fn is_zero(number: &u32) -> bool {
    *number == 0
}

impl Default for ExecutionSettings {
    fn default() -> Self {
        Self {
            cores: 1,
            gpus: 0,
            time_limit: 86_400.0,
            memory: None,
            scratch: None,
            keep: KeepDirectories::default(),
            pass_environment: PassedEnvironment::default(),
            batch_system: None,
            batch_options: Vec::new(),
            scheduler: None,
        }
    }
}

impl ExecutionSettings {
    /// The directory for calculations.
    pub fn scratch(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }
}
