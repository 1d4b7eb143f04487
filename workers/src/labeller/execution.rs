//! How and where calculations run.

use std::path::PathBuf;

use dft::PassedEnvironment;
use serde::{Deserialize, Serialize};

/// How the calculations of another program run. Nothing of it changes what comes out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExecutionSettings {
    /// Cores that a calculation has: it finds their number in its environment, as `CALMWALK_CORES`. Core-hours are counted
    /// by it.
    pub cores: u32,
    /// Longest time of a calculation, s.
    pub time_limit: f64,
    /// Most memory of all processes of a calculation together, GB (10⁹ bytes); none for no limit.
    pub memory: Option<f64>,
    /// Where directories of calculations are made, on a disk of this host; none for the one for temporary files. With a batch
    /// system every node has to see it.
    pub scratch: Option<PathBuf>,
    /// What becomes of the directory when a calculation has ended.
    pub keep: KeepDirectories,
    /// Variables of the labeller's environment that the program gets beside those that every program gets.
    #[serde(skip_serializing_if = "PassedEnvironment::is_empty")]
    pub pass_environment: PassedEnvironment,
    /// The batch system that each calculation is a job of; none for processes beside the labeller.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch_system: Option<BatchSystem>,
    /// Further options of its jobs, as the batch system's own command takes them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub batch_options: Vec<String>,
}

/// What runs calculations as jobs of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BatchSystem {
    /// Slurm.
    Slurm,
}

/// Which directories of calculations are packed into the store; all others are removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum KeepDirectories {
    /// None.
    Nothing,
    /// Those of calculations that failed.
    #[default]
    Failed,
    /// All.
    All,
}

impl KeepDirectories {
    /// Whether the directory of a calculation is kept that has `failed`, or has not.
    pub(super) fn keeps(self, failed: bool) -> bool {
        match self {
            Self::Nothing => false,
            Self::Failed => failed,
            Self::All => true,
        }
    }
}

impl Default for ExecutionSettings {
    fn default() -> Self {
        Self {
            cores: 1,
            time_limit: 86_400.0,
            memory: None,
            scratch: None,
            keep: KeepDirectories::default(),
            pass_environment: PassedEnvironment::default(),
            batch_system: None,
            batch_options: Vec::new(),
        }
    }
}

impl ExecutionSettings {
    /// Where directories of calculations are made.
    pub fn scratch(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }
}
