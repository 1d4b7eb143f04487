//! The processes of a calculation.
//!
//! While the runner is alive they are its descendants: it is the subreaper of its program, so orphans become its
//! children, even a daemon with its own session and an empty environment. After the runner has ended they are
//! recognized only by the mark that each inherits in its environment; a daemon that has cleared it is not found.
//! Neither are processes that another service started for the program (`systemd-run`, `at`, a container engine,
//! `ssh`). Processes that have taken the rights of another user cannot be ended.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::ExitStatus;
use std::thread;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, Signal, WaitOptions, getpid, pidfd_open, pidfd_send_signal, wait};
use store::is_running;

/// Environment variable that marks all processes of a calculation; it holds its directory.
pub const MARK: &str = "CALMWALK_CALCULATION";
/// Time between two checks whether all have ended.
const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// How long a program may take to end the processes that it started. A program that started processes on other
/// nodes of an allocation (`srun`, `mpirun`) has to end them there, and cannot if it is killed.
const TERMINATION_GRACE: Duration = Duration::from_secs(5);
/// A process that has not ended after this time counts as unkillable.
const KILL_TIMEOUT: Duration = Duration::from_secs(20);

/// A running process, from `/proc/PID/stat`.
struct ProcessStat {
    pid: Pid,
    parent: Option<Pid>,
    session: Option<Pid>,
    /// Resident memory, pages.
    pages: u64,
}

/// The children of this process: the program, and orphans of its descendants.
pub(super) struct ChildReaper {
    program: Pid,
    ended: Option<ExitStatus>,
}

impl ChildReaper {
    /// For this program, which nothing else may reap. Only one of these may exist in a process.
    pub fn new(program: Pid) -> Self {
        Self { program, ended: None }
    }

    /// Reaps children that have ended. Returns whether any is left.
    pub fn reap(&mut self) -> io::Result<bool> {
        loop {
            match wait(WaitOptions::NOHANG) {
                Ok(Some((pid, status))) if pid == self.program => {
                    self.ended = Some(ExitStatus::from_raw(status.as_raw()));
                }
                Ok(Some(_)) | Err(Errno::INTR) => {}
                Ok(None) => return Ok(true),
                Err(Errno::CHILD) => return Ok(false),
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// Ends and reaps all descendants of this process. Returns how the program ended.
    ///
    /// # Errors
    /// A process cannot be ended.
    pub fn terminate(mut self) -> io::Result<ExitStatus> {
        let mut ending = Termination::start();
        loop {
            // The list may miss a process that is just being created, but the absence of children is certain.
            let is_left = self.reap()?;
            if let Some(status) = self.ended.filter(|_| !is_left) {
                return Ok(status);
            }
            let found = descendants().into_iter().map(|process| process.pid);
            let goes_on = ending.advance(found, is_descendant)?;
            // Processes of other users cannot be ended.
            if let Some(status) = self.ended.filter(|_| !goes_on && ending.has_refused) {
                return Ok(status);
            }
            thread::sleep(POLL_INTERVAL);
        }
    }
}

/// Resident memory of this process and its descendants, bytes. Shared memory counts for each.
pub(super) fn memory() -> u64 {
    let own = process(getpid()).map_or(0, |own| own.pages);
    let others: u64 = descendants().iter().map(|process| process.pages).sum();
    (own + others) * rustix::param::page_size() as u64
}

/// Ends every process with the mark of the calculation in this directory.
pub fn terminate_marked(directory: &Path) -> io::Result<()> {
    let mark = [MARK.as_bytes(), b"=", directory.as_os_str().as_bytes()].concat();
    terminate(|pid| is_marked(pid, &mark))
}

/// Ends the process with this id and start time, if it is running.
pub(super) fn terminate_process(pid: u32, start_time: &str) -> io::Result<()> {
    terminate(|found| number(found) == pid && is_running(pid, start_time))
}

/// Asks our processes to end, and kills those that do not, until none is left.
fn terminate(is_ours: impl Fn(Pid) -> bool) -> io::Result<()> {
    let mut ending = Termination::start();
    while ending.advance(pids().filter(|pid| is_ours(*pid)), &is_ours)? {
        thread::sleep(POLL_INTERVAL);
    }
    Ok(())
}

/// Processes that are being ended.
struct Termination {
    started: Instant,
    asked: HashSet<Pid>,
    /// Whether this user may not signal some of them.
    has_refused: bool,
}

impl Termination {
    fn start() -> Self {
        Self { started: Instant::now(), asked: HashSet::new(), has_refused: false }
    }

    /// Sends SIGTERM to new processes among `found`, and SIGKILL to all after the grace period. Returns whether any
    /// is left that can be ended.
    fn advance(
        &mut self,
        found: impl Iterator<Item = Pid>,
        is_ours: impl Fn(Pid) -> bool,
    ) -> io::Result<bool> {
        let mut left = None;
        for pid in found {
            let signal = match self.started.elapsed() >= TERMINATION_GRACE {
                true => Signal::KILL,
                // Only once: some programs take a second signal as a request to hurry.
                false if self.asked.insert(pid) => Signal::TERM,
                false => {
                    left = Some(pid);
                    continue;
                }
            };
            match send(signal, pid, &is_ours)? {
                true => left = Some(pid),
                false => self.has_refused = true,
            }
        }
        match left {
            Some(pid) if self.started.elapsed() > KILL_TIMEOUT => {
                let message = format!("cannot end process {}", pid.as_raw_nonzero());
                Err(io::Error::new(io::ErrorKind::TimedOut, message))
            }
            left => Ok(left.is_some()),
        }
    }
}

/// Process ids are reused: checks and signals the same process through a pidfd. Returns false for a process of
/// another user.
fn send(signal: Signal, pid: Pid, is_ours: impl Fn(Pid) -> bool) -> io::Result<bool> {
    let sent = pidfd_open(pid, PidfdFlags::empty()).and_then(|process| match is_ours(pid) {
        true => pidfd_send_signal(&process, signal),
        false => Ok(()),
    });
    match sent {
        Ok(()) | Err(Errno::SRCH) => Ok(true),
        // The error for a process that has just ended depends on the kernel version.
        Err(Errno::NOENT | Errno::INVAL) => Ok(true),
        Err(Errno::PERM) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Running descendants of this process, and processes in its session.
fn descendants() -> Vec<ProcessStat> {
    let own = getpid();
    let found: Vec<_> = pids().filter_map(process).collect();
    let parents: HashMap<_, _> = found.iter().map(|process| (process.pid, process.parent)).collect();
    let descends = |process: &ProcessStat| {
        let mut above = process.parent;
        // A process id may be reused while others are read, which can form a cycle.
        for _ in 0..parents.len() {
            match above {
                Some(pid) if pid == own => return true,
                Some(pid) => above = parents.get(&pid).copied().flatten(),
                None => return false,
            }
        }
        false
    };
    let is_ours = |process: &ProcessStat| process.session == Some(own) || descends(process);
    found.into_iter().filter(|process| process.pid != own && is_ours(process)).collect()
}

fn is_descendant(pid: Pid) -> bool {
    descendants().iter().any(|process| process.pid == pid)
}

fn number(pid: Pid) -> u32 {
    pid.as_raw_nonzero().get().unsigned_abs()
}

/// Every visible process.
fn pids() -> impl Iterator<Item = Pid> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| Pid::from_raw(entry.file_name().to_str()?.parse().ok()?))
}

/// `None` for a process that has ended.
fn process(pid: Pid) -> Option<ProcessStat> {
    let stat = fs::read(format!("/proc/{}/stat", pid.as_raw_nonzero())).ok()?;
    let stat = String::from_utf8_lossy(&stat);
    // Field 2, the name, may contain blanks and parentheses; field 3 is the state, 4 the parent, 6 the session, 24
    // the resident pages.
    let (_, fields) = stat.rsplit_once(')')?;
    let fields: Vec<_> = fields.split_whitespace().collect();
    let is_over = matches!(*fields.first()?, "Z" | "X" | "x");
    // For a process that is about to end these are 0 or -1, and `Pid` panics on negative numbers.
    let pid_in = |field: usize| {
        let number: i32 = fields.get(field)?.parse().ok()?;
        Some(if number > 0 { Pid::from_raw(number) } else { None })
    };
    let (parent, session, pages) = (pid_in(1)?, pid_in(3)?, fields.get(21)?.parse().ok()?);
    (!is_over).then_some(ProcessStat { pid, parent, session, pages })
}

/// A process that has ended has no environment.
fn is_marked(pid: Pid, mark: &[u8]) -> bool {
    let environment = fs::read(format!("/proc/{}/environ", pid.as_raw_nonzero()));
    environment.is_ok_and(|environment| environment.split(|byte| *byte == 0).any(|variable| variable == mark))
}
