//! `calmwalk walker`

use std::sync::Arc;

use orchestrator::launcher;
use potentials::grace::Threads;
use wire::ipc::IpcWalker;
use workers::walk::WalkContext;
use workers::walker;

use super::{Ended, Failure};
use crate::setup::{self, WalkerSetup};
use crate::{interrupt, log};

/// A walker's process; `calmwalk run` starts it
///
/// It reads what to do from standard input, ends with the process that started it, and on SIGTERM after the step in hand.
#[derive(Debug, clap::Args)]
pub struct Walker {}

impl Walker {
    pub fn run(self) -> Result<Ended, Failure> {
        let setup: WalkerSetup = setup::read()?;
        log::begin(setup.log.clone(), "walker", Some(setup.door.walker()))?;
        launcher::set_process_name(c"calmwalk").map_err(Failure::failed)?;
        launcher::end_with_parent(setup.parent).map_err(Failure::failed)?;
        let stopping = interrupt::flag()?;
        let threads = Threads::new(setup.threads).map_err(Failure::failed)?;
        let context = WalkContext { model: setup.load_model()?, threads, settings: Arc::new(setup.settings) };
        let mut transport = IpcWalker::connect(&setup.door, stopping).map_err(Failure::failed)?;
        let ended = walker::run(&context, &mut transport);
        match (ended, transport.failure()) {
            (_, Some(failure)) => Err(Failure::failed(failure)),
            (walker::Ended::SentHome, None) => Ok(Ended::Done),
            (walker::Ended::Stopped, None) => Ok(Ended::Interrupted),
        }
    }
}
