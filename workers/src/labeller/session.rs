//! The processes of a calculation, as the system shows them.
//!
//! While the keeper lives they are those of its session. When it is gone that number may be given to another, so they are
//! known by their mark alone, which each inherits in its environment.

use std::collections::HashSet;
use std::fs;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, Signal, getpid, pidfd_open, pidfd_send_signal};
use store::is_running;

use super::keeper::MARK;

/// Between two looks at whether all are gone.
const LOOK: Duration = Duration::from_millis(2);
/// How long a program may take to end what it has started, when it is asked to. Whoever has started it on other nodes of an
/// allocation (`srun`, `mpirun`) has to end it there, and cannot if it is killed.
const GRACE: Duration = Duration::from_secs(5);
/// A process that the system does not let go within this time will not go.
const PATIENCE: Duration = Duration::from_secs(20);

/// A process of a session.
struct Member {
    session: Pid,
    /// Pages in memory.
    pages: u64,
}

/// Ends every process of the session that this process leads, but itself.
pub(super) fn end_others() -> io::Result<()> {
    let own = getpid();
    end(|pid| pid != own && member(pid).is_some_and(|member| member.session == own))
}

/// Bytes that the processes of this session have in memory together. What several share counts for each.
pub(super) fn memory() -> u64 {
    let own = getpid();
    let members = processes().filter_map(member).filter(|member| member.session == own);
    members.map(|member| member.pages).sum::<u64>() * rustix::param::page_size() as u64
}

/// Ends every process that bears the mark of the calculation in this directory.
pub(super) fn end_marked(directory: &Path) -> io::Result<()> {
    let mark = [MARK.as_bytes(), b"=", directory.as_os_str().as_bytes()].concat();
    end(|pid| is_marked(pid, &mark))
}

/// Ends the process with this number that was born then, if it still runs.
pub(super) fn end_one(pid: u32, birth: &str) -> io::Result<()> {
    end(|found| found.as_raw_nonzero().get().unsigned_abs() == pid && is_running(pid, birth))
}

/// Asks what is ours to end, and kills it if it does not, until nothing of it is left.
fn end(is_ours: impl Fn(Pid) -> bool) -> io::Result<()> {
    let (begun, mut asked) = (Instant::now(), HashSet::new());
    loop {
        let found: Vec<_> = processes().filter(|pid| is_ours(*pid)).collect();
        let Some(first) = found.first() else { return Ok(()) };
        if begun.elapsed() > PATIENCE {
            let message = format!("process {} cannot be ended", first.as_raw_nonzero());
            return Err(io::Error::new(io::ErrorKind::TimedOut, message));
        }
        for pid in found {
            if begun.elapsed() >= GRACE {
                send(Signal::KILL, pid, &is_ours)?;
            } else if asked.insert(pid) {
                // Once: to be told again means haste to some.
                send(Signal::TERM, pid, &is_ours)?;
            }
        }
        thread::sleep(LOOK);
    }
}

/// Numbers are given out again: what is looked at and what gets the signal has to be the same process.
fn send(signal: Signal, pid: Pid, is_ours: impl Fn(Pid) -> bool) -> io::Result<()> {
    let sent = pidfd_open(pid, PidfdFlags::empty()).and_then(|process| match is_ours(pid) {
        true => pidfd_send_signal(&process, signal),
        false => Ok(()),
    });
    match sent {
        Ok(()) | Err(Errno::SRCH) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// Every process that this one can see.
fn processes() -> impl Iterator<Item = Pid> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| Pid::from_raw(entry.file_name().to_str()?.parse().ok()?))
}

/// None for one that has ended.
fn member(pid: Pid) -> Option<Member> {
    let stat = fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero())).ok()?;
    // The name, field 2, may hold blanks and parentheses; the state is field 3, the session 6, pages in memory 24.
    let (_, fields) = stat.rsplit_once(')')?;
    let fields: Vec<_> = fields.split_whitespace().collect();
    let is_over = matches!(*fields.first()?, "Z" | "X" | "x");
    let (session, pages) = (fields.get(3)?.parse().ok()?, fields.get(21)?.parse().ok()?);
    (!is_over).then_some(Member { session: Pid::from_raw(session)?, pages })
}

/// One that has ended has no environment any more.
fn is_marked(pid: Pid, mark: &[u8]) -> bool {
    let environment = fs::read(format!("/proc/{}/environ", pid.as_raw_nonzero()));
    environment.is_ok_and(|environment| environment.split(|byte| *byte == 0).any(|variable| variable == mark))
}
