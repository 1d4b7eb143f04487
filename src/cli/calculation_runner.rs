//! `calmwalk calculation-runner`

use orchestrator::launcher;
use workers::labeller::run_calculation;

use super::{ExitStatus, Failure};

/// Internal: run one calculation for a labeller
///
/// Reads its settings from standard input, and outlives the labeller that started it.
#[derive(Debug, clap::Args)]
pub struct CalculationRunnerArgs {}

impl CalculationRunnerArgs {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        launcher::set_process_name(c"calmwalk").map_err(Failure::failed)?;
        run_calculation().map_err(Failure::failed)?;
        Ok(ExitStatus::Done)
    }
}
