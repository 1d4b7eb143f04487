//! This test program as its own child.

use std::io::{Read, Write};
use std::process::Command;

use rustix::process::{Resource, Rlimit, getpgid, getpid, getrlimit, setrlimit};

use super::*;

/// Arguments that make this test program run only one of its ignored tests.
fn only(test: &str) -> [String; 4] {
    [format!("launcher::tests::itself::{test}"), "--exact".into(), "--ignored".into(), "--nocapture".into()]
}

#[tokio::test]
async fn the_program_starts_itself() {
    let mut children = Children::new(1, NO_RESTART, |_, _| {
        Launch::this_program(only("reads_its_setup"), b"the setup".to_vec())
    });
    let events = rest(&mut children).await;
    assert_eq!(lines(&events), ["read: the setup"]);
    assert_eq!(ends(&events)[0].1.then, ChildState::Exited);
}

#[test]
#[ignore = "runs in a process that another test starts"]
fn reads_its_setup() {
    let mut setup = String::new();
    std::io::stdin().read_to_string(&mut setup).unwrap();
    writeln!(std::io::stderr(), "read: {setup}").unwrap();
}

#[tokio::test]
async fn children_start_when_the_host_has_resources_again() {
    let mut children =
        Children::new(1, NO_RESTART, |_, _| Launch::this_program(only("lacks_descriptors"), Vec::new()));
    let events = rest(&mut children).await;
    assert_eq!(lines(&events), ["started in the end"], "{events:?}");
}

/// In a process of its own, since other tests need file descriptors. Its child must not fail even once.
#[tokio::test]
#[ignore = "runs in a process that another test starts"]
async fn lacks_descriptors() {
    let limit = |current| Rlimit { current, maximum: getrlimit(Resource::Nofile).maximum };
    let before = getrlimit(Resource::Nofile).current;
    let mut children = children(&["exit 0"], NO_RESTART);
    // No more files can be opened from now on.
    setrlimit(Resource::Nofile, limit(Some(3))).unwrap();
    for _ in 0..10 {
        let ChildEvent::Ended { ended, .. } = next(&mut children).await else {
            panic!("it cannot be started")
        };
        assert!(matches!(ended.reason, ExitReason::StartFailed { is_shortage: true, .. }), "{ended:?}");
        assert!(matches!(ended.then, ChildState::BackingOff { .. }), "{ended:?}");
    }
    setrlimit(Resource::Nofile, limit(before)).unwrap();
    let events = rest(&mut children).await;
    // One more start may have failed before the limit was raised.
    let (_, last) = *ends(&events).last().unwrap();
    assert_eq!((&last.reason, last.then), (&exit(0, None), ChildState::Exited));
    writeln!(std::io::stderr(), "started in the end").unwrap();
}

/// 0 if the session leader is in another process namespace, as in a container, which `getsid` of rustix does not
/// expect.
fn session_of(pid: Pid) -> i32 {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero())).unwrap();
    // The name is in parentheses and may contain anything; state, parent, group and session follow.
    stat.rsplit(')').next().unwrap().split_whitespace().nth(3).unwrap().parse().unwrap()
}

#[tokio::test]
async fn groups_and_sessions_are_as_asked_for() {
    let mut children = Children::new(2, LIMITS, |number, _| match number {
        0 => Launch::this_program(only("waits"), b"in its parent's session".to_vec()),
        _ => Launch::this_program(only("waits"), b"in its own".to_vec()).for_own_session(),
    });
    let (mut pids, mut ready) = ([None; 2], 0);
    while ready < 2 {
        match next(&mut children).await {
            ChildEvent::Started { number, pid, .. } => pids[number as usize] = Pid::from_raw(pid as i32),
            ChildEvent::Stderr { .. } => ready += 1,
            event => panic!("{event:?}"),
        }
    }
    assert_eq!(getpgid(pids[0]).unwrap(), pids[0].unwrap(), "Ctrl-C does not reach it");
    assert_eq!(session_of(pids[0].unwrap()), session_of(getpid()));
    assert_eq!(session_of(pids[1].unwrap()), pids[1].unwrap().as_raw_nonzero().get());
    children.stop();
    rest(&mut children).await;
}

#[test]
#[ignore = "runs in a process that another test starts"]
fn waits() {
    let mut setup = String::new();
    std::io::stdin().read_to_string(&mut setup).unwrap();
    if setup == "in its own" {
        start_own_session().unwrap();
    }
    writeln!(std::io::stderr(), "ready").unwrap();
    std::thread::sleep(if setup.is_empty() { Duration::ZERO } else { LONG });
}

/// Starts [`tied`] from a thread that exits when the process has bound itself to its parent, or has failed to.
fn tied_to(parent: u32) -> (std::process::ExitStatus, String) {
    let start = move || {
        let mut command = Command::new("/proc/self/exe");
        command.args(only("tied")).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        child.stdin.take().unwrap().write_all(parent.to_string().as_bytes()).unwrap();
        let mut said = [0; 4];
        child.stderr.as_mut().unwrap().read_exact(&mut said).unwrap();
        (child, String::from_utf8(said.to_vec()).unwrap())
    };
    let (mut child, said) = std::thread::spawn(start).join().unwrap();
    (child.wait().unwrap(), said)
}

#[test]
fn a_process_ends_with_the_thread_that_started_it() {
    use std::os::unix::process::ExitStatusExt;
    let (status, said) = tied_to(std::process::id());
    assert_eq!((status.signal(), said.as_str()), (Some(9), "tied"));
}

#[test]
fn processes_do_not_continue_without_their_parent() {
    let (_, said) = tied_to(std::process::id() + 1);
    assert_eq!(said, "gone");
}

#[test]
#[ignore = "runs in a process that another test starts"]
fn tied() {
    let mut parent = String::new();
    std::io::stdin().read_to_string(&mut parent).unwrap();
    let Ok(parent) = parent.parse() else { return };
    match end_with_parent(parent) {
        Ok(()) => {
            write!(std::io::stderr(), "tied").unwrap();
            std::thread::sleep(LONG);
        }
        Err(ParentExited::Other { .. }) => write!(std::io::stderr(), "gone").unwrap(),
        Err(error) => panic!("{error}"),
    }
}

#[test]
fn process_lists_show_the_name() {
    set_process_name(c"calm-walker").unwrap();
    assert_eq!(std::fs::read_to_string("/proc/thread-self/comm").unwrap(), "calm-walker\n");
}
