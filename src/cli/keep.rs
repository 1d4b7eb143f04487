//! `calmwalk keep`

use orchestrator::launcher;
use workers::labeller::keep;

use super::{Ended, Failure};

/// Keeps a calculation; labellers start it
///
/// It reads what to do from standard input, and outlives the labeller that started it.
#[derive(Debug, clap::Args)]
pub struct Keep {}

impl Keep {
    pub fn run(self) -> Result<Ended, Failure> {
        launcher::set_process_name(c"calmwalk").map_err(Failure::failed)?;
        keep().map_err(Failure::failed)?;
        Ok(Ended::Done)
    }
}
