//! A calculation as a process on this host.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Stdio};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use store::{is_local, is_running, process_birth, this_host};
use tracing::warn;

use super::begun::Found;
use super::keeper::{self, Calculation, End, Order};
use super::tree::remove_tree;
use super::{private, session};

/// Between two looks at a calculation that has just begun …
const SHORTEST_PAUSE: Duration = Duration::from_millis(5);
/// … and at one that has lasted for a while.
const LONGEST_PAUSE: Duration = Duration::from_millis(500);

/// What finds a calculation again: its keeper, and where it works.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Kept {
    /// For people.
    pub host: String,
    pub directory: PathBuf,
    pub pid: u32,
    pub birth: String,
}

/// A keeper that waits for its order.
pub(super) struct Ready {
    pub kept: Kept,
    child: Child,
    stdin: ChildStdin,
    calculation: Calculation,
}

impl Ready {
    /// Starts the keeper; the calculation itself only begins with [`Self::go`]. Dropped before that, it never does.
    pub fn start(calculation: Calculation) -> io::Result<Self> {
        let mut keeper = calculation.keeper.command();
        // It outlives this process, speaks to no database, and gives its environment to the program.
        keeper.env_clear().envs(calculation.pass_environment.from_current_process());
        keeper.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = keeper.spawn()?;
        let stdin = child.stdin.take().ok_or(io::ErrorKind::BrokenPipe)?;
        let (pid, directory) = (child.id(), calculation.directory.clone());
        let birth = process_birth(pid).ok_or_else(|| io::Error::other("/proc does not show processes"))?;
        let kept = Kept { host: this_host(), directory, pid, birth };
        Ok(Self { kept, child, stdin, calculation })
    }

    pub fn go(self) -> io::Result<Child> {
        keeper::give(self.stdin, &Order::Keep(self.calculation))?;
        Ok(self.child)
    }
}

impl Kept {
    pub fn look(&self) -> Found {
        if is_local(&self.birth) != Some(true) {
            return Found::Elsewhere;
        }
        if !private::is_own(&self.directory) {
            // Another user may have made one of that name after it was gone.
            return if is_running(self.pid, &self.birth) { Found::Running } else { Found::Gone };
        }
        // In this order: the last that a keeper does is to write how the calculation ended.
        let runs = is_running(self.pid, &self.birth);
        match (End::read(&self.directory), runs) {
            (Some(end), _) => Found::Ended(end),
            (None, true) => Found::Running,
            (None, false) => Found::Gone,
        }
    }

    /// Waits for the end; `None` if it was broken off.
    pub async fn end(&self) -> Option<End> {
        let mut pause = SHORTEST_PAUSE;
        loop {
            match self.look() {
                Found::Ended(end) => return Some(end),
                Found::Running => tokio::time::sleep(pause).await,
                Found::Ready | Found::Gone | Found::Elsewhere => return None,
            }
            pause = (pause * 5 / 4).min(LONGEST_PAUSE);
        }
    }

    /// Ends whatever is left of it, and removes its directory.
    pub fn clear(&self) -> io::Result<()> {
        session::end_one(self.pid, &self.birth)?;
        clear(&self.directory)
    }
}

/// The same for the directory of a calculation whose keeper is gone.
pub(super) fn clear(directory: &Path) -> io::Result<()> {
    session::end_marked(directory)?;
    remove(directory);
    Ok(())
}

/// A directory that is gone already is no error. What cannot be removed, or is not this user's, stays: that is no reason for
/// a labeller to end.
pub(super) fn remove(directory: &Path) {
    if fs::symlink_metadata(directory).is_ok() && !private::is_own(directory) {
        warn!("{} is not removed: it is no directory of this user", directory.display());
    } else if let Err(error) = remove_tree(directory) {
        warn!("{} cannot be removed: {error}", directory.display());
    }
}
