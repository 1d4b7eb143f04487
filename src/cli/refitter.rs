//! `calmwalk refitter`

use std::path::PathBuf;

use orchestrator::launcher;

use super::{CommandError, ExitStatus, block_on};
use crate::refit::settings::RefitterConfig;
use crate::refit::{self, RefitOutcome};
use crate::signals::stop_token;
use crate::{log, process_config};

/// Internal: train a new version of the potential, started by `calmwalk run`
///
/// Reads its settings from standard input. Exits with the process that started it; the next one continues.
#[derive(Debug, clap::Args)]
pub struct RefitterArgs {
    /// Only end the processes with this mark when standard input is closed
    #[arg(long, value_name = "MARK")]
    end_marked: Option<PathBuf>,
}

impl RefitterArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        launcher::set_process_name(c"calmwalk").map_err(CommandError::failed)?;
        if let Some(mark) = &self.end_marked {
            refit::end_marked_when_alone(mark)?;
            return Ok(ExitStatus::Done);
        }
        let config: RefitterConfig = process_config::from_stdin()?;
        log::init(config.log.clone(), "refitter", None)?;
        if let Some(parent) = config.parent {
            launcher::end_with_parent(parent).map_err(CommandError::failed)?;
        }
        let stop = stop_token()?;
        Ok(match block_on(refit::process::run(&config, &stop))?? {
            RefitOutcome::Registered(_) | RefitOutcome::Refused(_) => ExitStatus::Done,
            RefitOutcome::Stopped => ExitStatus::Interrupted,
        })
    }
}
