//! What a started process does about the one that started it.

use std::ffi::CStr;
use std::io;

use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal, setsid};

/// Why a process cannot, or need not, go on with the one that started it.
#[derive(Debug, thiserror::Error)]
pub enum ParentExited {
    /// The parent ended before this process could tie itself to it, or is not the one it was said to be.
    #[error("the process {expected} that started this one is gone: there is nobody to work for")]
    Other {
        /// The parent's process number.
        expected: u32,
    },
    /// The system refused.
    #[error("this process cannot be made to end with the one that started it: {0}")]
    Refused(rustix::io::Errno),
}

/// Has this process killed (SIGKILL) when the thread that started it ends: see [`crate::launcher`]. To be called first of
/// all, on the main thread, since the tie is lost with the thread that made it. On an error the process has to leave.
pub fn end_with_parent(parent: u32) -> Result<(), ParentExited> {
    set_parent_process_death_signal(Some(Signal::KILL)).map_err(ParentExited::Refused)?;
    // The parent may have died before, and then no signal comes.
    let found = getppid().map(Pid::as_raw_nonzero).and_then(|pid| u32::try_from(pid.get()).ok());
    if found == Some(parent) { Ok(()) } else { Err(ParentExited::Other { expected: parent }) }
}

/// Takes this process out of its parent's session: neither Ctrl-C nor a closed terminal reaches it any more. It must have
/// been started with [`super::Launch::for_own_session`].
pub fn start_own_session() -> io::Result<()> {
    setsid()?;
    Ok(())
}

/// Gives the calling thread a name of at most 15 bytes; that of the main thread is the one under which `top` and `pgrep`
/// know the process. Without it a process that was started by [`super::Launch::this_program`] is called `exe`.
pub fn set_process_name(name: &CStr) -> io::Result<()> {
    Ok(rustix::thread::set_name(name)?)
}
