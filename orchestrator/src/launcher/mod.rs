//! Processes on this host: started, listened to, waited for, and signalled.
//!
//! **The thread that starts a process must live as long as this one.** A child that ends with its parent
//! ([`end_with_parent`]) does so when the *thread* that started it ends, so a thread of a pool will not do.
//! [`Children`] starts processes where [`Children::next`] is awaited: that has to be the future that `block_on` runs on the
//! main thread, not a spawned task.
//!
//! **A child that outlives its parent** ([`start_own_session`]) has nobody any more who reads its standard error: what it
//! writes there fails from then on (`EPIPE`), and `eprintln!` panics of that. It has to use `writeln!` and let it fail.

mod child_monitor;
mod children;
mod descriptors;
mod heartbeats;
mod line_splitter;
mod process;
mod process_setup;
#[cfg(test)]
mod tests;

use std::ffi::{OsStr, OsString};
use std::io;
use std::path::PathBuf;
use std::process::Stdio;

use tokio::process::{Child, Command};

pub use children::{ChildEvent, Children};
pub use descriptors::raise_descriptor_limit;
pub use heartbeats::Heartbeats;
pub use process::{AdoptError, request_exit};
pub use process_setup::{ParentExited, end_with_parent, set_process_name, start_own_session};

/// What to start.
#[derive(Clone, Debug)]
pub struct Launch {
    program: PathBuf,
    name: OsString,
    arguments: Vec<OsString>,
    setup: Vec<u8>,
    own_group: bool,
    has_database: bool,
}

impl Launch {
    /// This program once more, the very file that runs now even if another has taken its place on the disk since. It
    /// reads `setup` from its standard input up to the end.
    ///
    /// It has a process group of its own, so that Ctrl-C at the terminal reaches its parent only.
    pub fn this_program(arguments: impl IntoIterator<Item = impl Into<OsString>>, setup: Vec<u8>) -> Self {
        Self {
            program: PathBuf::from("/proc/self/exe"),
            // The name that this process was called by; people look for it in lists of processes.
            name: std::env::args_os().next().unwrap_or_else(|| "calmwalk".into()),
            arguments: arguments.into_iter().map(Into::into).collect(),
            setup,
            own_group: true,
            has_database: true,
        }
    }

    /// Leaves it in the process group of its parent, as whoever calls [`start_own_session`] needs it: the leader of a group
    /// cannot begin a session.
    pub fn for_own_session(self) -> Self {
        Self { own_group: false, ..self }
    }

    /// Keeps from it the variables by which clients of a database server find it and its password: `PGPASSWORD` and the like.
    pub fn without_database(self) -> Self {
        Self { has_database: false, ..self }
    }

    /// Starts it, and gives it away to be watched together with what it is to read.
    fn start(self) -> io::Result<(Child, Vec<u8>)> {
        let mut command = Command::new(&self.program);
        command.arg0(&self.name).args(&self.arguments);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        if !self.has_database {
            std::env::vars_os().map(|(name, _)| name).filter(|name| is_postgres_variable(name)).for_each(
                |name| {
                    command.env_remove(name);
                },
            );
        }
        if self.own_group {
            command.process_group(0);
        }
        limit_inheritance(&mut command);
        Ok((command.spawn()?, self.setup))
    }
}

/// Whether an environment variable of this name is one of PostgreSQL's.
fn is_postgres_variable(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b"PG")
}

/// Gives the child the user's limit of descriptors, and nothing to inherit but its three standard streams. What is opened for
/// shared memory is not marked to be closed, and a labeller, which outlives this process, would keep that memory.
#[allow(unsafe_code)]
fn limit_inheritance(command: &mut Command) {
    let close_the_rest = || {
        // SAFETY: a system call that takes numbers and touches no memory.
        match unsafe { libc::close_range(3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC as libc::c_int) } {
            0 => descriptors::restore_descriptor_limit(),
            _ => Err(io::Error::last_os_error()),
        }
    };
    // SAFETY: between fork and exec nothing is done but two system calls; they allocate nothing and take no lock.
    unsafe { command.pre_exec(close_the_rest) };
}
