//! Tells processes with the same id apart: the system reuses process ids, but not start times.

use std::fs;
use std::os::unix::fs::MetadataExt;

use rustix::process::Pid;

/// When and where the process `pid` of this PID namespace started: boot id, PID namespace (containers of one system
/// share the boot and number their processes separately) and clock ticks since boot, as `boot/namespace/ticks`. No
/// other process with this id has the same value. `None` if there is no such process, or if the system does not
/// tell.
pub fn process_start_time(pid: u32) -> Option<String> {
    stat(pid).map(|stat| format!("{}/{}/{}", boot(), namespace(), stat.ticks))
}

/// Whether the process `pid` that started at `start_time` runs; `start_time` must be local, see [`is_local`]. If it
/// is empty, any process with that id counts.
pub fn is_running(pid: u32, start_time: &str) -> bool {
    match stat(pid) {
        Some(stat) => {
            !stat.ended
                && StartTime::parse(start_time).is_none_or(|start| start.ticks == stat.ticks.to_string())
        }
        // No such process, or it is hidden from this user.
        None => has_number(pid),
    }
}

/// Whether that start time lies before the last boot (or on another system): such a process has ended.
pub(crate) fn is_from_another_boot(start_time: &str) -> bool {
    let now = boot();
    StartTime::parse(start_time).is_some_and(|start| !now.is_empty() && start.boot != now)
}

/// Whether the start time is from this boot and this PID namespace, so that the process id is valid here. `None`
/// without a start time.
pub fn is_local(start_time: &str) -> Option<bool> {
    let StartTime { boot: then, namespace: then_namespace, .. } = StartTime::parse(start_time)?;
    Some(then == boot() && then_namespace.is_none_or(|then| then == namespace().to_string()))
}

/// Clock ticks since boot. They order processes of one boot, whatever the wall clock said.
pub(crate) fn ticks(start_time: &str) -> Option<u64> {
    StartTime::parse(start_time)?.ticks.parse().ok()
}

/// The parts of a start time.
struct StartTime<'a> {
    boot: &'a str,
    /// Missing in start times that early versions wrote.
    namespace: Option<&'a str>,
    ticks: &'a str,
}

impl<'a> StartTime<'a> {
    fn parse(start_time: &'a str) -> Option<Self> {
        let (place, ticks) = start_time.rsplit_once('/')?;
        let (boot, namespace) =
            place.split_once('/').map_or((place, None), |(boot, namespace)| (boot, Some(namespace)));
        Some(Self { boot, namespace, ticks })
    }
}

/// Id of the PID namespace; 0 if there is none.
fn namespace() -> u64 {
    fs::metadata("/proc/self/ns/pid").map_or(0, |namespace| namespace.ino())
}

/// Id of this boot of the system; empty if there is none.
fn boot() -> String {
    fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default().trim().to_owned()
}

struct Stat {
    /// A zombie: it has ended, and its parent has not reaped it yet.
    ended: bool,
    /// Start time in clock ticks since boot.
    ticks: u64,
}

fn stat(pid: u32) -> Option<Stat> {
    parse(&fs::read_to_string(format!("/proc/{pid}/stat")).ok()?)
}

/// Parses a line of /proc/pid/stat. Field 2, the program name, may contain blanks and parentheses; field 3 is the
/// state, field 22 the start time.
fn parse(line: &str) -> Option<Stat> {
    let (_, fields) = line.rsplit_once(')')?;
    let mut fields = fields.split_whitespace();
    let ended = matches!(fields.next()?, "Z" | "X" | "x");
    Some(Stat { ended, ticks: fields.nth(18)?.parse().ok()? })
}

fn has_number(pid: u32) -> bool {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    // For a process of another user the answer is EPERM: it exists.
    pid.is_some_and(|pid| rustix::process::test_kill_process(pid) != Err(rustix::io::Errno::SRCH))
}

#[cfg(test)]
mod tests {
    use std::process::{Command, Stdio};
    use std::time::{Duration, Instant};

    use super::*;

    #[test]
    fn living_and_dead_processes_are_distinguished() {
        let own = process_start_time(std::process::id()).unwrap();
        assert!(is_running(std::process::id(), &own) && is_running(std::process::id(), ""));
        assert!(!is_running(0, "") && !is_running(u32::MAX, ""));
        assert_eq!(process_start_time(u32::MAX), None);
        let mut child = Command::new("cat").stdin(Stdio::piped()).spawn().unwrap();
        let start_time = process_start_time(child.id()).unwrap();
        assert!(
            is_running(child.id(), &start_time)
                && process_start_time(child.id()).as_ref() == Some(&start_time)
        );
        assert!(!is_from_another_boot(&start_time));
        // It ends, and its parent has not reaped it yet.
        drop(child.stdin.take());
        let started = Instant::now();
        while is_running(child.id(), &start_time) {
            assert!(
                started.elapsed() < Duration::from_secs(60),
                "an ended process is taken for a running one"
            );
            std::thread::sleep(Duration::from_millis(5));
        }
        assert!(has_number(child.id()) && !is_running(child.id(), ""));
        child.wait().unwrap();
        assert!(!is_running(child.id(), &start_time) && !is_running(child.id(), ""));
    }

    #[test]
    fn a_reused_process_id_is_recognized() {
        let (pid, own) = (std::process::id(), process_start_time(std::process::id()).unwrap());
        let (place, ticks) = own.rsplit_once('/').unwrap();
        let earlier = format!("{place}/{}", ticks.parse::<u64>().unwrap() - 1);
        assert!(is_running(pid, &own) && !is_running(pid, &earlier));
        assert!(is_from_another_boot(&format!("another/{ticks}")));
        assert!(!is_from_another_boot(&earlier) && !is_from_another_boot(""));
    }

    #[test]
    fn process_ids_of_other_containers_are_not_local() {
        let (pid, own) = (std::process::id(), process_start_time(std::process::id()).unwrap());
        let [boot, namespace, ticks] = own.split('/').collect::<Vec<_>>().try_into().unwrap();
        assert_eq!(is_local(&own), Some(true));
        assert_eq!(is_local(&format!("{boot}/{namespace}0/{ticks}")), Some(false));
        assert_eq!(is_local(&format!("another/{namespace}/{ticks}")), Some(false));
        assert_eq!(is_local(""), None);
        let without_namespace = format!("{boot}/{ticks}");
        assert_eq!(is_local(&without_namespace), Some(true));
        assert!(is_running(pid, &without_namespace) && !is_running(pid, &format!("{boot}/{ticks}0")));
    }

    #[test]
    fn program_names_do_not_confuse_the_parser() {
        let rest = "0 ".repeat(18);
        let stat = parse(&format!("7 (a) Z (b) S {rest}123456 0")).unwrap();
        assert!(!stat.ended && stat.ticks == 123_456);
        assert!(parse(&format!("7 (sh) Z {rest}1")).unwrap().ended);
        assert!(parse("7 (sh) S 1 2").is_none() && parse("").is_none());
    }
}
