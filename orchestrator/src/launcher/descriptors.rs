//! How many descriptors processes may have: this one needs a dozen for each walker, its children what their user gave them.

use std::io;
use std::sync::OnceLock;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// As many are enough for every walker that a host can have.
const TARGET_LIMIT: u64 = 65_536;

/// What this process was given, once it has raised it: the soft and the hard limit.
static ORIGINAL_LIMIT: OnceLock<(Option<u64>, Option<u64>)> = OnceLock::new();

/// Lets this process have as many descriptors as the hard limit allows, and it needs. Processes that it starts afterwards have what
/// it was given: some programs take ill to large limits.
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

/// Sets the limit that this process was given. Allocates nothing and takes no lock, so that it can stand between fork and exec.
pub(super) fn restore_descriptor_limit() -> io::Result<()> {
    match ORIGINAL_LIMIT.get() {
        Some(&(current, maximum)) => Ok(setrlimit(Resource::Nofile, Rlimit { current, maximum })?),
        None => Ok(()),
    }
}
