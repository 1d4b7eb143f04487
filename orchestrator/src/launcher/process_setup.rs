//! What a started process does with respect to its parent.

use std::ffi::CStr;
use std::io;

use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal, setsid};

/// Why a process cannot work for its parent.
#[derive(Debug, thiserror::Error)]
pub enum ParentExited {
    /// The parent exited before this call, or is another process than expected.
    #[error("the parent process {expected} has exited")]
    Other {
        /// Process id of the parent.
        expected: u32,
    },
    /// The system refused.
    #[error("cannot bind this process to its parent: {0}")]
    Refused(rustix::io::Errno),
}

/// Lets the kernel kill this process (SIGKILL) when the thread that started it exits, see [`crate::launcher`]. Call it
/// first, on the main thread, since the setting belongs to the calling thread. If it fails, the process must exit.
pub fn end_with_parent(parent: u32) -> Result<(), ParentExited> {
    set_parent_process_death_signal(Some(Signal::KILL)).map_err(ParentExited::Refused)?;
    // If the parent has already exited, no signal will come.
    let found = getppid().map(Pid::as_raw_nonzero).and_then(|pid| u32::try_from(pid.get()).ok());
    if found == Some(parent) { Ok(()) } else { Err(ParentExited::Other { expected: parent }) }
}

/// Moves this process to a session of its own, so that neither Ctrl-C nor closing the terminal reaches it. It must have
/// been started with [`super::Launch::for_own_session`].
pub fn start_own_session() -> io::Result<()> {
    setsid()?;
    Ok(())
}

/// Sets the name of the calling thread, at most 15 bytes; the main thread's name is what `top` and `pgrep` show.
/// Otherwise a process started by [`super::Launch::this_program`] is named `exe`.
pub fn set_process_name(name: &CStr) -> io::Result<()> {
    Ok(rustix::thread::set_name(name)?)
}
