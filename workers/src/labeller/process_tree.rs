//! The processes of a calculation, as the system shows them.
//!
//! While the keeper lives they are its descendants: it is the subreaper of all that its program starts, so what loses its parent
//! becomes a child of the keeper, also a daemon with a session of its own and an empty environment. When the keeper is gone
//! they are known by their mark alone, which each inherits in its environment: a daemon that has cleared it is not found then.
//! Neither are processes that another service has started for the program (`systemd-run`, `at`, a container engine, `ssh`),
//! nor can those be ended that have taken the rights of another user.

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

use super::calculation_runner::MARK;

/// Between two looks at whether all are gone.
const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// How long a program may take to end what it has started, when it is asked to. Whoever has started it on other nodes of an
/// allocation (`srun`, `mpirun`) has to end it there, and cannot if it is killed.
const TERMINATION_GRACE: Duration = Duration::from_secs(5);
/// A process that the system does not let go within this time will not go.
const KILL_TIMEOUT: Duration = Duration::from_secs(20);

/// A living process, as `/proc/PID/stat` shows it.
struct Process {
    pid: Pid,
    parent: Option<Pid>,
    session: Option<Pid>,
    /// Pages in memory.
    pages: u64,
}

/// The children of this process: the program that it has started, and what was left to it.
pub(super) struct Children {
    program: Pid,
    ended: Option<ExitStatus>,
}

impl Children {
    /// With that program, of which nobody else takes note. There is only one of these in a process.
    pub fn new(program: Pid) -> Self {
        Self { program, ended: None }
    }

    /// Takes note of those that have ended. Whether any is left.
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

    /// Ends every process that descends from this one, and takes note of their ends. How the program ended.
    ///
    /// # Errors
    /// One that cannot be ended.
    pub fn terminate(mut self) -> io::Result<ExitStatus> {
        let mut ending = Termination::start();
        loop {
            // A process that is born while others are listed may be missed, but that no child is left is certain.
            let is_left = self.reap()?;
            if let Some(status) = self.ended.filter(|_| !is_left) {
                return Ok(status);
            }
            let found = descendants().into_iter().map(|process| process.pid);
            let goes_on = ending.advance(found, is_descendant)?;
            // What other users run here cannot be ended.
            if let Some(status) = self.ended.filter(|_| !goes_on && ending.has_refused) {
                return Ok(status);
            }
            thread::sleep(POLL_INTERVAL);
        }
    }
}

/// Bytes that the descendants of this process have in memory together, and itself. What several share counts for each.
pub(super) fn memory() -> u64 {
    let own = process(getpid()).map_or(0, |own| own.pages);
    let others: u64 = descendants().iter().map(|process| process.pages).sum();
    (own + others) * rustix::param::page_size() as u64
}

/// Ends every process that bears the mark of the calculation in this directory.
pub(super) fn terminate_marked(directory: &Path) -> io::Result<()> {
    let mark = [MARK.as_bytes(), b"=", directory.as_os_str().as_bytes()].concat();
    terminate(|pid| is_marked(pid, &mark))
}

/// Ends the process with this number that was born then, if it still runs.
pub(super) fn terminate_process(pid: u32, start_time: &str) -> io::Result<()> {
    terminate(|found| number(found) == pid && is_running(pid, start_time))
}

/// Asks what is ours to end, and kills it if it does not, until nothing of it is left.
fn terminate(is_ours: impl Fn(Pid) -> bool) -> io::Result<()> {
    let mut ending = Termination::start();
    while ending.advance(pids().filter(|pid| is_ours(*pid)), &is_ours)? {
        thread::sleep(POLL_INTERVAL);
    }
    Ok(())
}

/// Processes that are being ended.
struct Termination {
    begun: Instant,
    asked: HashSet<Pid>,
    /// Whether there were some that this user may not end.
    has_refused: bool,
}

impl Termination {
    fn start() -> Self {
        Self { begun: Instant::now(), asked: HashSet::new(), has_refused: false }
    }

    /// Asks those among `found` that were not asked yet, and kills all when they have had their time. Whether any is left that
    /// may be ended.
    fn advance(
        &mut self,
        found: impl Iterator<Item = Pid>,
        is_ours: impl Fn(Pid) -> bool,
    ) -> io::Result<bool> {
        let mut left = None;
        for pid in found {
            let signal = match self.begun.elapsed() >= TERMINATION_GRACE {
                true => Signal::KILL,
                // Once: to be told again means haste to some.
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
            Some(pid) if self.begun.elapsed() > KILL_TIMEOUT => {
                let message = format!("process {} cannot be ended", pid.as_raw_nonzero());
                Err(io::Error::new(io::ErrorKind::TimedOut, message))
            }
            left => Ok(left.is_some()),
        }
    }
}

/// Numbers are given out again: what is looked at and what gets the signal has to be the same process. False for one of
/// another user.
fn send(signal: Signal, pid: Pid, is_ours: impl Fn(Pid) -> bool) -> io::Result<bool> {
    let sent = pidfd_open(pid, PidfdFlags::empty()).and_then(|process| match is_ours(pid) {
        true => pidfd_send_signal(&process, signal),
        false => Ok(()),
    });
    match sent {
        Ok(()) | Err(Errno::SRCH) => Ok(true),
        // What the system says where the process has just gone depends on its version.
        Err(Errno::NOENT | Errno::INVAL) => Ok(true),
        Err(Errno::PERM) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Living processes that descend from this one, or are in its session.
fn descendants() -> Vec<Process> {
    let own = getpid();
    let found: Vec<_> = pids().filter_map(process).collect();
    let parents: HashMap<_, _> = found.iter().map(|process| (process.pid, process.parent)).collect();
    let descends = |process: &Process| {
        let mut above = process.parent;
        // A number may be given out again while others are read, and make a circle.
        for _ in 0..parents.len() {
            match above {
                Some(pid) if pid == own => return true,
                Some(pid) => above = parents.get(&pid).copied().flatten(),
                None => return false,
            }
        }
        false
    };
    let is_ours = |process: &Process| process.session == Some(own) || descends(process);
    found.into_iter().filter(|process| process.pid != own && is_ours(process)).collect()
}

fn is_descendant(pid: Pid) -> bool {
    descendants().iter().any(|process| process.pid == pid)
}

fn number(pid: Pid) -> u32 {
    pid.as_raw_nonzero().get().unsigned_abs()
}

/// Every process that this one can see.
fn pids() -> impl Iterator<Item = Pid> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| Pid::from_raw(entry.file_name().to_str()?.parse().ok()?))
}

/// None for one that has ended.
fn process(pid: Pid) -> Option<Process> {
    let stat = fs::read(format!("/proc/{}/stat", pid.as_raw_nonzero())).ok()?;
    let stat = String::from_utf8_lossy(&stat);
    // The name, field 2, may hold blanks and parentheses; the state is field 3, the parent 4, the session 6, pages in memory 24.
    let (_, fields) = stat.rsplit_once(')')?;
    let fields: Vec<_> = fields.split_whitespace().collect();
    let is_over = matches!(*fields.first()?, "Z" | "X" | "x");
    // Of a process that is about to end they are 0 or -1, and a number below 0 is a panic in `Pid`.
    let pid_in = |field: usize| {
        let number: i32 = fields.get(field)?.parse().ok()?;
        Some(if number > 0 { Pid::from_raw(number) } else { None })
    };
    let (parent, session, pages) = (pid_in(1)?, pid_in(3)?, fields.get(21)?.parse().ok()?);
    (!is_over).then_some(Process { pid, parent, session, pages })
}

/// One that has ended has no environment any more.
fn is_marked(pid: Pid, mark: &[u8]) -> bool {
    let environment = fs::read(format!("/proc/{}/environ", pid.as_raw_nonzero()));
    environment.is_ok_and(|environment| environment.split(|byte| *byte == 0).any(|variable| variable == mark))
}
