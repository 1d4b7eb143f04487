//! Limits of open file descriptors. This process needs a dozen for each walker; its children keep the user's limit.

use std::io;
use std::sync::OnceLock;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Enough for all walkers a host can run.
const TARGET_LIMIT: u64 = 65_536;

/// The original soft and hard limit, if it was raised.
static ORIGINAL_LIMIT: OnceLock<(Option<u64>, Option<u64>)> = OnceLock::new();

/// Raises the soft limit of open file descriptors as far as necessary, up to the hard limit. Processes started
/// afterwards get the original limit, since some programs do not work well with large limits.
pub fn raise_descriptor_limit() {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let wanted = maximum.map_or(TARGET_LIMIT, |maximum| maximum.min(TARGET_LIMIT));
    if current.is_none_or(|current| current >= wanted) {
        return;
    }
    if setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum }).is_ok() {
        let _ = ORIGINAL_LIMIT.set((current, maximum));
    }
}

/// Restores the original limit. Allocates nothing and takes no lock, so it can be called between fork and exec.
pub(super) fn restore_descriptor_limit() -> io::Result<()> {
    match ORIGINAL_LIMIT.get() {
        Some(&(current, maximum)) => Ok(setrlimit(Resource::Nofile, Rlimit { current, maximum })?),
        None => Ok(()),
    }
}
