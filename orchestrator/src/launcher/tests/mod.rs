//! Tests with real, small processes.

mod adopted;
mod itself;

use std::path::Path;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use tokio::time::timeout;

use super::*;
use crate::supervisor::{ChildExit, ChildState, ExitReason, Limits};

/// Timeout for anything here on a busy machine.
const LONG: Duration = Duration::from_secs(120);

const LIMITS: Limits = Limits {
    heartbeat_timeout: LONG,
    initial_backoff: Duration::from_millis(5),
    max_backoff: Duration::from_millis(20),
    max_restarts: 2,
    grace_period: LONG,
    detached: false,
};

const NO_RESTART: Limits = Limits { max_restarts: 0, ..LIMITS };

impl Launch {
    fn shell(script: &str) -> Self {
        let program = Path::new("/bin/sh").to_owned();
        Self { program, ..Self::this_program(["-c", script], Vec::new()) }
    }
}

fn children(scripts: &'static [&'static str], limits: Limits) -> Children {
    let launch = |number, _| Launch::shell(scripts[number as usize]);
    Children::new(scripts.len() as u32, limits, launch)
}

async fn next(children: &mut Children) -> ChildEvent {
    timeout(LONG, children.next()).await.expect("an event")
}

/// All events until the end, when no process must be left.
async fn rest(children: &mut Children) -> Vec<ChildEvent> {
    let mut events = Vec::new();
    loop {
        match next(children).await {
            ChildEvent::AllExited => break,
            event => events.push(event),
        }
    }
    for event in &events {
        if let ChildEvent::Started { pid, .. } = event {
            assert!(!Path::new(&format!("/proc/{pid}")).exists(), "process {pid} is left");
        }
    }
    events
}

fn ends(events: &[ChildEvent]) -> Vec<(u32, &ChildExit)> {
    let end = events.iter().filter_map(|event| match event {
        ChildEvent::Ended { number, ended } => Some((*number, ended)),
        _ => None,
    });
    end.collect()
}

fn lines(events: &[ChildEvent]) -> Vec<&str> {
    let lines = events.iter().filter_map(|event| match event {
        ChildEvent::Stderr { line, .. } => Some(line.as_str()),
        _ => None,
    });
    lines.collect()
}

fn exit(code: i32, stderr: Option<&str>) -> ExitReason {
    ExitReason::Exit { code, last_line: stderr.map(str::to_owned) }
}

fn signal(pid: u32, signal: Signal) {
    kill_process(Pid::from_raw(pid as i32).unwrap(), signal).unwrap();
}

/// Stops a process and waits until it is stopped, since a concurrent SIGTERM would come first.
async fn hold(pid: u32) {
    signal(pid, Signal::STOP);
    while !std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap().contains(") T ") {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

#[tokio::test]
async fn exit_codes_come_with_the_last_line() {
    let mut children = children(&["echo first >&2; printf 'last words' >&2; exit 3"], NO_RESTART);
    let events = rest(&mut children).await;
    assert!(matches!(events[0], ChildEvent::Started { number: 0, incarnation: 1, .. }), "{events:?}");
    assert_eq!(lines(&events), ["first", "last words"]);
    let ended = ChildExit { incarnation: 1, reason: exit(3, Some("last words")), then: ChildState::Failed };
    assert_eq!(ends(&events), [(0, &ended)]);
    assert_eq!(ended.reason.to_string(), "exit code 3: last words");
    let nothing_more = timeout(Duration::from_millis(50), children.next()).await;
    assert!(nothing_more.is_err(), "all gone is the end");
}

#[tokio::test]
async fn setups_larger_than_a_pipe_arrive_completely() {
    let numbers: Vec<String> = (0..100_000).map(|number| number.to_string()).collect();
    let setup = numbers.join("\n").into_bytes();
    let launch = move |_, _| Launch { setup: setup.clone(), ..Launch::shell("cat >&2") };
    let mut children = Children::new(1, NO_RESTART, launch);
    let mut found = Vec::new();
    let ended = loop {
        // Waiting can be cancelled at any time.
        match timeout(Duration::from_micros(200), children.next()).await {
            Ok(ChildEvent::Stderr { line, .. }) => found.push(line),
            Ok(ChildEvent::Ended { ended, .. }) => break ended,
            Ok(ChildEvent::Started { .. }) | Err(_) => {}
            Ok(ChildEvent::AllExited) => panic!("without an end"),
        }
    };
    assert_eq!(found, numbers);
    assert_eq!((ended.reason, ended.then), (exit(0, Some("99999")), ChildState::Exited));
}

#[tokio::test]
async fn unread_setups_do_not_block() {
    let launch = |_, _| Launch { setup: vec![b'x'; 1 << 20], ..Launch::shell("exit 5") };
    let mut children = Children::new(1, NO_RESTART, launch);
    assert_eq!(ends(&rest(&mut children).await)[0].1.reason, exit(5, None));
}

#[tokio::test]
async fn repeated_failures_do_not_affect_other_children() {
    let mut children = children(&["echo no model >&2; exit 7", "exec sleep 1000"], LIMITS);
    let (mut incarnations, mut pauses) = (Vec::new(), Vec::new());
    loop {
        match next(&mut children).await {
            ChildEvent::Started { number: 0, incarnation, .. } => incarnations.push(incarnation),
            ChildEvent::Ended { number, ended } => {
                assert_eq!((number, ended.reason), (0, exit(7, Some("no model"))));
                match ended.then {
                    ChildState::BackingOff { left } => pauses.push(left.as_millis()),
                    then => break assert_eq!(then, ChildState::Failed),
                }
            }
            ChildEvent::Started { .. } | ChildEvent::Stderr { .. } => {}
            ChildEvent::AllExited => panic!("one is left"),
        }
    }
    assert_eq!((incarnations, pauses), (vec![1, 2, 3], vec![5, 10]));
    let status = children.status();
    assert_eq!((status[0].state, status[0].restarts), (ChildState::Failed, 2));
    assert_eq!(status[1].state, ChildState::Starting);
    children.heartbeats().heartbeat(1);
    assert_eq!(children.status()[1].state, ChildState::Running);
    children.stop();
    assert_eq!(ends(&rest(&mut children).await).len(), 1);
    assert_eq!(children.status()[1].last_failure, None);
}

#[tokio::test]
async fn a_delivery_before_the_exit_resets_failures() {
    let mut children = children(&["echo done >&2; exit 1"], Limits { max_restarts: 1, ..LIMITS });
    for _ in 0..5 {
        loop {
            match next(&mut children).await {
                ChildEvent::Stderr { number, .. } => children.heartbeats().delivered(number),
                ChildEvent::Ended { ended, .. } => {
                    break assert!(matches!(ended.then, ChildState::BackingOff { .. }), "{ended:?}");
                }
                _ => {}
            }
        }
    }
}

#[tokio::test]
async fn unread_deliveries_count() {
    let directory = tempfile::tempdir().unwrap();
    let go = directory.path().join("go");
    let script = format!("cd {}; until rm go; do sleep 0.01; done 2>&-; exit 1", directory.path().display());
    let launch = move |_, _| Launch::shell(&script);
    let mut children = Children::new(1, Limits { max_restarts: 1, ..LIMITS }, launch);
    // After a failure without a delivery, only a delivery prevents the next failure from being the last.
    for delivers in [false, true, true] {
        assert!(matches!(next(&mut children).await, ChildEvent::Started { .. }));
        let heartbeats = children.heartbeats();
        let deliver = async {
            // The monitor waits for the exit by now.
            tokio::time::sleep(Duration::from_millis(20)).await;
            if delivers {
                heartbeats.delivered(0);
            }
            std::fs::write(&go, "").unwrap();
        };
        let (event, ()) = tokio::join!(next(&mut children), deliver);
        let ChildEvent::Ended { ended, .. } = event else { panic!("{event:?}") };
        assert_eq!(ended.then, ChildState::BackingOff { left: LIMITS.initial_backoff });
    }
}

#[tokio::test]
async fn processes_without_any_heartbeat_are_killed() {
    let silence = Duration::from_millis(200);
    let mut children = children(&["exec sleep 1000"], Limits { heartbeat_timeout: silence, ..NO_RESTART });
    let events = rest(&mut children).await;
    assert_eq!(ends(&events)[0].1.reason, ExitReason::Unresponsive(silence));
}

#[tokio::test]
async fn stopped_processes_are_killed_and_restarted() {
    const BEATS: u32 = 75;
    let silence = Duration::from_secs(3);
    let beat = "while :; do echo alive >&2; sleep 0.05; done";
    let launch = move |_, _| Launch::shell(beat);
    let mut children = Children::new(1, Limits { heartbeat_timeout: silence, ..LIMITS }, launch);
    let (mut beats, mut first) = (0, 0);
    loop {
        match next(&mut children).await {
            ChildEvent::Started { incarnation: 1, pid, .. } => first = pid,
            ChildEvent::Started { incarnation, .. } => break assert_eq!(incarnation, 2),
            ChildEvent::Stderr { .. } => {
                beats += 1;
                children.heartbeats().heartbeat(0);
                // After more than the heartbeat timeout: it lives as long as it sends heartbeats.
                if beats == BEATS {
                    signal(first, Signal::STOP);
                }
            }
            ChildEvent::Ended { ended, .. } => {
                assert!(beats >= BEATS, "killed while it spoke");
                assert_eq!(ended.reason, ExitReason::Unresponsive(silence));
                assert!(!Path::new(&format!("/proc/{first}")).exists());
            }
            ChildEvent::AllExited => panic!("it is to be started again"),
        }
    }
    children.stop();
    rest(&mut children).await;
}

#[tokio::test]
async fn stopping_kills_children_that_do_not_exit() {
    const SCRIPTS: [&str; 3] = [
        "trap 'exit 130' TERM; echo ready >&2; while :; do sleep 0.02; done",
        "trap '' TERM; echo ready >&2; while :; do sleep 0.02; done",
        "echo ready >&2; exec sleep 1000",
    ];
    let grace = Duration::from_secs(3);
    let mut children = children(&SCRIPTS, Limits { grace_period: grace, ..LIMITS });
    let (mut ready, mut last) = (0, 0);
    while ready < SCRIPTS.len() {
        match next(&mut children).await {
            ChildEvent::Started { number: 2, pid, .. } => last = pid,
            event => ready += usize::from(matches!(event, ChildEvent::Stderr { .. })),
        }
    }
    hold(last).await;
    children.stop();
    children.stop();
    let events = rest(&mut children).await;
    let mut ends = ends(&events);
    ends.sort_by_key(|(number, _)| *number);
    let endings: Vec<_> = ends.iter().map(|(_, ended)| ended.reason.clone()).collect();
    let lingering = ExitReason::StopTimeout(grace);
    assert_eq!(endings, [exit(130, Some("ready")), lingering.clone(), lingering]);
    assert!(ends.iter().all(|(_, ended)| ended.then == ChildState::Exited));
}

#[tokio::test]
async fn exits_by_signal_are_reported() {
    let mut children = children(&["kill -9 $$", "kill -SEGV $$"], NO_RESTART);
    let events = rest(&mut children).await;
    let mut reasons: Vec<_> =
        ends(&events).iter().map(|(number, ended)| (*number, ended.reason.to_string())).collect();
    reasons.sort();
    assert_eq!(reasons[0].1, "killed by signal 9 (SIGKILL)");
    assert_eq!(reasons[1].1, "killed by signal 11 (SIGSEGV)");
}

#[tokio::test]
async fn orphaned_processes_do_not_delay_the_exit() {
    // The orphaned process keeps the pipe of the standard error open.
    let mut children = children(&["echo here >&2; sleep 20 & printf last >&2; exit 4"], NO_RESTART);
    let begun = std::time::Instant::now();
    let events = rest(&mut children).await;
    assert_eq!(ends(&events)[0].1.reason, exit(4, Some("last")));
    assert!(begun.elapsed() < Duration::from_secs(20), "waited for the wrong process");
}

#[tokio::test]
async fn the_last_lines_wait_for_a_slow_reader() {
    let mut children = children(&["seq 5000 >&2; echo the reason >&2; exit 4"], NO_RESTART);
    let mut found = 0;
    let reason = loop {
        match next(&mut children).await {
            ChildEvent::Stderr { .. } => found += 1,
            ChildEvent::Ended { ended, .. } => break ended.reason,
            event => assert!(matches!(event, ChildEvent::Started { .. })),
        }
        // It exits long before all lines are received.
        if found % 500 == 0 {
            tokio::time::sleep(child_monitor::STDERR_DRAIN_TIMEOUT).await;
        }
    };
    assert_eq!((found, reason), (5001, exit(4, Some("the reason"))));
}

#[tokio::test]
async fn failed_starts_are_reported() {
    let launch = |_, _| Launch { program: "/no/such/program".into(), ..Launch::shell("") };
    let mut children = Children::new(1, LIMITS, launch);
    let events = rest(&mut children).await;
    let ends = ends(&events);
    assert_eq!((events.len(), ends.len()), (3, 3), "nothing but ends");
    assert!(ends[0].1.reason.to_string().contains("No such file"), "{}", ends[0].1.reason);
}
