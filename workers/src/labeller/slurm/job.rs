//! A job and the files in its directory.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Created in the directory by the job that calculates.
pub(super) const BEGUN: &str = "begun";
/// The batch script.
pub(super) const SCRIPT: &str = "job.sh";
/// The request to its runner.
pub(super) const REQUEST: &str = "order.json";
/// Output of Slurm and of the script.
pub(super) const LOG: &str = "slurm.log";

/// Identifies a job.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in super::super) struct CalculationJob {
    /// The cluster: elsewhere the name has no meaning.
    pub cluster: String,
    pub directory: PathBuf,
    /// The name, unique to the calculation.
    pub name: String,
    /// The user who submitted it: others may not see it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<u32>,
    /// The node where it failed, if another node may help.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
}
