//! `calmwalk walker`

use std::sync::Arc;

use orchestrator::launcher;
use potentials::grace::Threads;
use wire::ipc::IpcWalker;
use workers::walk::WalkContext;
use workers::walker;

use super::{CommandError, ExitStatus};
use crate::process_config::{self, WalkerConfig};
use crate::{log, signals};

/// Internal: a walker process, started by `calmwalk run` and `calmwalk agent`
///
/// Reads its settings from standard input. Exits with the process that started it, and on SIGTERM after the current step.
#[derive(Debug, clap::Args)]
pub struct WalkerArgs {}

impl WalkerArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let setup: WalkerConfig = process_config::from_stdin()?;
        log::init(setup.log.clone(), "walker", Some(setup.connect_info.walker()))?;
        launcher::set_process_name(c"calmwalk").map_err(CommandError::failed)?;
        launcher::end_with_parent(setup.parent).map_err(CommandError::failed)?;
        let stopping = signals::stop_token()?;
        let threads = Threads::new(setup.threads).map_err(CommandError::failed)?;
        let model = setup.model.load(setup.device.as_ref(), &stopping)?;
        let mut transport =
            IpcWalker::connect(&setup.connect_info, stopping).map_err(CommandError::failed)?;
        let original = Arc::clone(transport.original());
        let context = WalkContext { model, threads, settings: Arc::new(setup.settings), original };
        let ended = walker::run(&context, &mut transport);
        match (ended, transport.failure()) {
            (_, Some(failure)) => Err(CommandError::failed(failure)),
            (walker::WalkerExit::Dismissed, None) => Ok(ExitStatus::Done),
            (walker::WalkerExit::Stopped, None) => Ok(ExitStatus::Interrupted),
            (walker::WalkerExit::PotentialUnavailable(reason), None) => Err(CommandError::Failed(reason)),
        }
    }
}
