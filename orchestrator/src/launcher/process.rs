//! Handles of processes. Unlike its process id, the handle of a process is never reused.

use std::io;
use std::os::fd::OwnedFd;

use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

/// Why a running process cannot be adopted.
#[derive(Debug, thiserror::Error)]
pub enum AdoptError {
    /// No process has this id any more, or another one.
    #[error("process {pid} has exited")]
    Gone {
        /// The process id.
        pid: u32,
    },
    /// The child already had a process, or does not exist.
    #[error(
        "cannot adopt process {pid} as number {number}: this number had a process before, or does not exist"
    )]
    NotAdoptable {
        /// The process id.
        pid: u32,
        /// Number of the child.
        number: u32,
    },
    /// The system refused.
    #[error("cannot monitor or signal process {pid}: {error}")]
    Refused {
        /// The process id.
        pid: u32,
        /// The error.
        error: io::Error,
    },
}

/// A process that is running, or was not waited for.
#[derive(Debug)]
pub(super) struct ProcessHandle {
    handle: OwnedFd,
}

impl ProcessHandle {
    /// The handle of a child process that was not waited for.
    pub fn from_child(pid: u32) -> io::Result<Self> {
        Ok(Self { handle: open(pid)? })
    }

    /// The handle of the process with this id and start time ([`store::process_start_time`]).
    pub fn open_running(pid: u32, start_time: &str) -> Result<Self, AdoptError> {
        let handle = open(pid).map_err(|error| match error {
            Errno::SRCH | Errno::INVAL => AdoptError::Gone { pid },
            error => AdoptError::Refused { pid, error: error.into() },
        })?;
        // Checked only now, since the handle belongs to one process whatever happens to the id.
        match store::process_start_time(pid) {
            Some(found) if found == start_time => Ok(Self { handle }),
            _ => Err(AdoptError::Gone { pid }),
        }
    }

    /// A second handle, which becomes readable when the process exits.
    #[allow(
        deprecated,
        reason = "for types that change their descriptor; an OwnedFd never does, and the successor is unsafe"
    )]
    pub fn end(&self) -> io::Result<AsyncFd<OwnedFd>> {
        AsyncFd::with_interest(self.handle.try_clone()?, Interest::READABLE)
    }

    /// Sends a signal. Does nothing if the process has exited.
    pub fn signal(&self, signal: Signal) -> io::Result<()> {
        match pidfd_send_signal(&self.handle, signal) {
            Ok(()) | Err(Errno::SRCH) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

/// Asks the process `pid`, which started at `start_time` ([`store::process_start_time`]), to exit (SIGTERM), without
/// waiting for it. Used for a labeller of an earlier run that cannot be adopted because it uses another label protocol.
pub fn request_exit(pid: u32, start_time: &str) -> Result<(), AdoptError> {
    let sent = ProcessHandle::open_running(pid, start_time)?.signal(Signal::TERM);
    sent.map_err(|error| AdoptError::Refused { pid, error })
}

fn open(pid: u32) -> Result<OwnedFd, Errno> {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw).ok_or(Errno::INVAL)?;
    pidfd_open(pid, PidfdFlags::empty())
}
