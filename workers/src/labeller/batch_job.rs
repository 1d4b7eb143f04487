//! What calculations as jobs have in common, whichever batch system runs them.

use std::fs;
use std::path::Path;
use std::time::Duration;

use tokio::time::sleep;

/// Timeout of the batch system's commands.
pub(super) const COMMAND_TIMEOUT: Duration = Duration::from_secs(60);
/// Initial time between two checks of a calculation's directory.
pub(super) const MIN_POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Longest time between two checks of a calculation's directory.
pub(super) const MAX_POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Time between two tries of a command that failed.
pub(super) const RETRY_INTERVAL: Duration = Duration::from_secs(3);
/// Largest number of refusals by a batch system that answers.
pub(super) const MAX_REFUSALS: u32 = 3;
/// How long a cancelled job may take to end before its directory is left for later.
pub(super) const CANCEL_TIMEOUT: Duration = Duration::from_secs(5);
/// Delay after which files written by a node are visible here.
const SETTLE_TIME: Duration = Duration::from_secs(2);

pub(super) const SCRATCH_NOT_SHARED: &str =
    "label.scratch must be a directory that this host and every node see under the same name";

/// The user of this process.
pub(super) fn own_user() -> u32 {
    rustix::process::getuid().as_raw()
}

/// Makes files from other hosts visible: a network file system refreshes a directory when a file is created in it.
pub(super) async fn settle(directory: &Path) {
    sleep(SETTLE_TIME).await;
    let new = directory.join("look");
    // A program may have left a file of that name, and opening a pipe would block.
    let _ = fs::File::create_new(&new).and_then(|_| fs::remove_file(&new));
}
