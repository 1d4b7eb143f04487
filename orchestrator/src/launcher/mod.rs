//! Processes on this host: starting, monitoring, waiting and signalling.
//!
//! **The thread that starts a process must live as long as this process.** A child that exits with its parent
//! ([`end_with_parent`]) is killed when the *thread* that started it exits, so threads of a pool are unsuitable.
//! [`Children`] starts processes where [`Children::next`] is awaited: this must be the future that `block_on` runs on
//! the main thread, not a spawned task.
//!
//! **A child that outlives its parent** ([`start_own_session`]) loses the reader of its standard error: writes then
//! fail with `EPIPE`, and `eprintln!` panics. Use `writeln!` and ignore its errors.

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

/// How to start a process.
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
    /// Starts this program again, from the file that is running now even if it has been replaced on disk. It reads
    /// `setup` from its standard input.
    ///
    /// It gets its own process group, so that Ctrl-C in the terminal reaches only its parent.
    pub fn this_program(arguments: impl IntoIterator<Item = impl Into<OsString>>, setup: Vec<u8>) -> Self {
        Self {
            program: PathBuf::from("/proc/self/exe"),
            // The name by which this process was called, as users see it in process lists.
            name: std::env::args_os().next().unwrap_or_else(|| "calmwalk".into()),
            arguments: arguments.into_iter().map(Into::into).collect(),
            setup,
            own_group: true,
            has_database: true,
        }
    }

    /// Keeps it in the process group of its parent, as required for [`start_own_session`]: the leader of a process
    /// group cannot start a session.
    pub fn for_own_session(self) -> Self {
        Self { own_group: false, ..self }
    }

    /// Removes the environment variables with the address and password of a database server, such as `PGPASSWORD`.
    pub fn without_database(self) -> Self {
        Self { has_database: false, ..self }
    }

    /// Starts the process. Returns it with its setup, for the monitor.
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

/// Whether an environment variable belongs to PostgreSQL.
fn is_postgres_variable(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b"PG")
}

/// Restores the user's limit of file descriptors in the child, and closes all but its three standard streams. File
/// descriptors of shared memory are not close-on-exec, and a labeller, which outlives this process, would keep that
/// memory.
#[allow(unsafe_code)]
fn limit_inheritance(command: &mut Command) {
    let close_the_rest = || {
        // SAFETY: a system call that takes numbers and accesses no memory.
        match unsafe { libc::close_range(3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC as libc::c_int) } {
            0 => descriptors::restore_descriptor_limit(),
            _ => Err(io::Error::last_os_error()),
        }
    };
    // SAFETY: between fork and exec there are only two system calls, which allocate nothing and take no lock.
    unsafe { command.pre_exec(close_the_rest) };
}
