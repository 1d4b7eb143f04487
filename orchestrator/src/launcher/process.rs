//! A process under a handle that belongs to it alone: its number may be given to another one when it is gone.

use std::io;
use std::os::fd::OwnedFd;

use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

/// Why a process that was started elsewhere cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum AdoptError {
    /// No process has this number, or another one has it now.
    #[error("process {pid} is gone")]
    Gone {
        /// The number that it had.
        pid: u32,
    },
    /// The child has a process already, or is none of the set.
    #[error(
        "process {pid} cannot be taken for number {number}: it had a process before, or there is no such number"
    )]
    NotAdoptable {
        /// Its process number.
        pid: u32,
        /// The child.
        number: u32,
    },
    /// The system refused.
    #[error("process {pid} cannot be watched or signalled: {error}")]
    Refused {
        /// Its process number.
        pid: u32,
        /// Why.
        error: io::Error,
    },
}

/// A living process, or one that is not reaped yet.
#[derive(Debug)]
pub(super) struct Process {
    handle: OwnedFd,
}

impl Process {
    /// The handle of a child that nobody has reaped yet.
    pub fn of_child(pid: u32) -> io::Result<Self> {
        Ok(Self { handle: open(pid)? })
    }

    /// The handle of the process with this number that was born then, [`store::process_birth`] has it.
    pub fn find(pid: u32, birth: &str) -> Result<Self, AdoptError> {
        let handle = open(pid).map_err(|error| match error {
            Errno::SRCH | Errno::INVAL => AdoptError::Gone { pid },
            error => AdoptError::Refused { pid, error: error.into() },
        })?;
        // Only now, since from here on the handle keeps to one process whatever becomes of the number.
        match store::process_birth(pid) {
            Some(found) if found == birth => Ok(Self { handle }),
            _ => Err(AdoptError::Gone { pid }),
        }
    }

    /// A second handle, which turns readable when the process ends.
    #[allow(
        deprecated,
        reason = "for types that change their descriptor; an OwnedFd never does, and the successor is unsafe"
    )]
    pub fn end(&self) -> io::Result<AsyncFd<OwnedFd>> {
        AsyncFd::with_interest(self.handle.try_clone()?, Interest::READABLE)
    }

    /// Sends a signal; one to a process that has ended meanwhile goes nowhere.
    pub fn signal(&self, signal: Signal) -> io::Result<()> {
        match pidfd_send_signal(&self.handle, signal) {
            Ok(()) | Err(Errno::SRCH) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

/// Asks the process `pid` that was born at `birth` ([`store::process_birth`]) to end in order (SIGTERM), and does not wait
/// for it: a labeller of an earlier run, say, that cannot be adopted because it works to another protocol.
pub fn request_exit(pid: u32, birth: &str) -> Result<(), AdoptError> {
    let sent = Process::find(pid, birth)?.signal(Signal::TERM);
    sent.map_err(|error| AdoptError::Refused { pid, error })
}

fn open(pid: u32) -> Result<OwnedFd, Errno> {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw).ok_or(Errno::INVAL)?;
    pidfd_open(pid, PidfdFlags::empty())
}
