//! `calmwalk calculation-runner`

use orchestrator::launcher;
use workers::labeller::run_calculation;

use super::{CommandError, ExitStatus};

/// Internal: run one calculation for a labeller
///
/// Reads its settings from standard input, and outlives the labeller that started it.
#[derive(Debug, clap::Args)]
pub struct CalculationRunnerArgs {}

impl CalculationRunnerArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        launcher::set_process_name(c"calmwalk").map_err(CommandError::failed)?;
        run_calculation().map_err(CommandError::failed)?;
        Ok(ExitStatus::Done)
    }
}
