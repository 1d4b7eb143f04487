//! Processes that are not our children.

use std::process::Command;

use super::*;

/// A process that is not a child of this process.
fn adopted_process() -> (u32, String) {
    let script = "sleep 1000 <&- >&- 2>&- & echo $!";
    let output = Command::new("/bin/sh").args(["-c", script]).output().unwrap();
    let pid = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
    (pid, store::process_start_time(pid).unwrap())
}

#[tokio::test]
async fn an_adopted_process_is_watched_and_ended() {
    let (pid, start_time) = adopted_process();
    let mut children = children(&["exit 0", "exit 0"], LIMITS);
    children.adopt(1, pid, &start_time).unwrap();
    assert!(matches!(children.adopt(1, pid, &start_time), Err(AdoptError::NotAdoptable { number: 1, .. })));
    assert!(matches!(children.adopt(2, pid, &start_time), Err(AdoptError::NotAdoptable { number: 2, .. })));
    // The other child starts and exits in the meantime.
    while !matches!(next(&mut children).await, ChildEvent::Ended { number: 0, .. }) {}
    assert_eq!(children.status()[1].incarnation, 0);
    children.stop();
    let ended = ChildExit { incarnation: 0, reason: ExitReason::Unknown, then: ChildState::Exited };
    assert_eq!(ends(&rest(&mut children).await), [(1, &ended)]);
}

#[tokio::test]
async fn an_adopted_process_that_dies_is_replaced() {
    let (pid, start_time) = adopted_process();
    let mut children = children(&["exit 0"], LIMITS);
    children.adopt(0, pid, &start_time).unwrap();
    signal(pid, Signal::KILL);
    let events = rest(&mut children).await;
    let ended = ends(&events);
    assert_eq!((ended[0].1.incarnation, &ended[0].1.reason), (0, &ExitReason::Unknown));
    assert_eq!((ended[1].1.incarnation, ended[1].1.then), (1, ChildState::Exited));
}

#[test]
fn processes_of_earlier_runs_are_asked_to_exit() {
    let (pid, start_time) = adopted_process();
    assert!(matches!(request_exit(pid, "another/1"), Err(AdoptError::Gone { .. })));
    assert!(store::process_start_time(pid).is_some());
    request_exit(pid, &start_time).unwrap();
    let begun = std::time::Instant::now();
    let lives =
        || std::fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| !stat.contains(") Z "));
    while lives() {
        assert!(begun.elapsed() < LONG, "it is still there");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[tokio::test]
async fn reused_process_ids_are_not_adopted() {
    let own = std::process::id();
    let mut children = children(&["exit 0"], LIMITS);
    for (pid, start_time) in [(own, "another/1"), (own, ""), (0, ""), (u32::MAX, ""), (i32::MAX as u32, "")] {
        assert!(matches!(children.adopt(0, pid, start_time), Err(AdoptError::Gone { .. })), "{pid}");
    }
    // The failed adoption has no effect: the child is started normally.
    assert!(matches!(next(&mut children).await, ChildEvent::Started { incarnation: 1, .. }));
    rest(&mut children).await;
}
