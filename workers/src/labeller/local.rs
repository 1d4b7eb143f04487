//! A calculation as a process on this host.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Stdio};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use store::{is_local, is_running, process_start_time, this_host};
use tracing::warn;

use super::calculation_runner::{self, Calculation, CalculationEnd, RunnerRequest};
use super::calculation_state::CalculationState;
use super::removal::remove_directory;
use super::{private_directory, process_tree};

/// Initial time between two checks of a calculation.
const MIN_POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Longest time between two checks of a calculation.
const MAX_POLL_INTERVAL: Duration = Duration::from_millis(500);

/// Identifies a calculation by its runner and directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct LocalCalculation {
    /// For display only.
    pub host: String,
    pub directory: PathBuf,
    pub pid: u32,
    pub start_time: String,
}

/// A runner that waits for its request.
pub(super) struct PreparedRunner {
    pub handle: LocalCalculation,
    child: Child,
    stdin: ChildStdin,
    calculation: Calculation,
}

impl PreparedRunner {
    /// Starts the runner. The calculation starts only with [`Self::start`], and never if this is dropped before.
    pub fn spawn(calculation: Calculation) -> io::Result<Self> {
        let mut runner = calculation.runner.command();
        // It outlives this process, does not access the database and passes its environment to the program.
        runner.env_clear().envs(calculation.pass_environment.from_current_process());
        runner.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = runner.spawn()?;
        let stdin = child.stdin.take().ok_or(io::ErrorKind::BrokenPipe)?;
        let (pid, directory) = (child.id(), calculation.directory.clone());
        let start_time =
            process_start_time(pid).ok_or_else(|| io::Error::other("/proc does not show processes"))?;
        let handle = LocalCalculation { host: this_host(), directory, pid, start_time };
        Ok(Self { handle, child, stdin, calculation })
    }

    pub fn start(self) -> io::Result<Child> {
        calculation_runner::send_request(self.stdin, &RunnerRequest::Run(self.calculation))?;
        Ok(self.child)
    }
}

impl LocalCalculation {
    pub fn inspect(&self) -> CalculationState {
        if is_local(&self.start_time) != Some(true) {
            return CalculationState::Elsewhere;
        }
        if !private_directory::is_own(&self.directory) {
            // Another user may have created a directory of that name after it was removed.
            return if is_running(self.pid, &self.start_time) {
                CalculationState::Running
            } else {
                CalculationState::Gone
            };
        }
        // This order matters: a runner writes the end last.
        let runs = is_running(self.pid, &self.start_time);
        match (CalculationEnd::read(&self.directory), runs) {
            (Some(end), _) => CalculationState::Ended(end),
            (None, true) => CalculationState::Running,
            (None, false) => CalculationState::Gone,
        }
    }

    /// Waits for the end; `None` if it was interrupted.
    pub async fn wait(&self) -> Option<CalculationEnd> {
        let mut pause = MIN_POLL_INTERVAL;
        loop {
            match self.inspect() {
                CalculationState::Ended(end) => return Some(end),
                CalculationState::Running => tokio::time::sleep(pause).await,
                CalculationState::Ready | CalculationState::Gone | CalculationState::Elsewhere => {
                    return None;
                }
            }
            pause = (pause * 5 / 4).min(MAX_POLL_INTERVAL);
        }
    }

    /// Ends what is left of it and removes its directory.
    pub fn clear(&self) -> io::Result<()> {
        process_tree::terminate_process(self.pid, &self.start_time)?;
        clear(&self.directory)
    }
}

/// The same for a directory whose runner has ended.
pub(super) fn clear(directory: &Path) -> io::Result<()> {
    process_tree::terminate_marked(directory)?;
    remove(directory);
    Ok(())
}

/// A missing directory is no error. A directory that cannot be removed, or is not this user's, stays: this does not
/// end the labeller.
pub(super) fn remove(directory: &Path) {
    if fs::symlink_metadata(directory).is_ok() && !private_directory::is_own(directory) {
        warn!("not removing {}: it is not a directory of this user", directory.display());
    } else if let Err(error) = remove_directory(directory) {
        warn!("cannot remove {}: {error}", directory.display());
    }
}
