//! Messages that are lost and processes that die.

use std::process::Child;
use std::time::Duration;

use wire::place::Place;
use wire::transport::Incoming;

use super::desk::{Desk, check, files_of, work};
use super::process::{AT_WORK, Role, start};

fn kill(child: &mut Child) {
    child.kill().unwrap();
    child.wait().unwrap();
}

/// The walker speaks before it is expected, and is not heard: as if its offer had been lost.
#[tokio::test(flavor = "multi_thread")]
async fn a_lost_offer_is_found_by_asking() {
    let directory = tempfile::tempdir().unwrap();
    let mut desk = Desk::open(directory.path(), 1, 1 << 16);
    let mut walker = start(&Role::Walker(desk.handle.door(0, 1)));
    while desk.handle.traffic().dropped == 0 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let reason = desk.handle.traffic().last_dropped.unwrap();
    assert_eq!(reason, "a message of walker 0, which is not expected");
    desk.handle.expect(0, 1);
    let first = desk.offer().await;
    let last = desk.go_on(first, 1, (3, 4)).await;
    last.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    desk.close().await;
}

/// A decision may take longer than a walker waits between two questions: it is the same offer all the while.
#[tokio::test(flavor = "multi_thread")]
async fn a_slow_decision_is_waited_for() {
    let directory = tempfile::tempdir().unwrap();
    let mut desk = Desk::open(directory.path(), 1, 1 << 16);
    let mut walker = desk.start(0, 1, Role::Walker);
    let first = desk.offer().await;
    // An offer and two questions: signs of life.
    while desk.heard.lock().unwrap().len() < 3 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    assert!(desk.incoming.try_recv().is_err(), "nothing is offered twice");
    let last = desk.go_on(first, 1, (3, 4)).await;
    last.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    desk.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_walker_is_replaced() {
    let directory = tempfile::tempdir().unwrap();
    let mut desk = Desk::open(directory.path(), 2, 1 << 16);
    for incarnation in 1..8 {
        // Killed in the middle of a turn.
        let mut stuck = desk.start(0, incarnation, Role::Stuck);
        let offer = desk.offer().await;
        assert_eq!((offer.walker, &offer.report), (0, &None));
        offer.reply.send(Some(work(0, 1, (3, 4)))).unwrap();
        assert!(matches!(desk.incoming.recv().await, Some(Incoming::Progress(..))), "it is at work");
        kill(&mut stuck);
        desk.handle.gone(0, incarnation, false);
        assert!(matches!(desk.next().await, Incoming::Gone { walker: 0, fault: false }));

        // Killed while it waits for the answer to a candidate.
        let mut waiting = desk.start(1, incarnation, Role::Walker);
        let offer = desk.offer().await;
        let mut offer = desk.go_on(offer, 1, (3, 4)).await;
        kill(&mut waiting);
        desk.handle.gone(1, incarnation, true);
        assert!(matches!(desk.next().await, Incoming::Gone { walker: 1, fault: true }));
        check(&offer.report.take().unwrap(), 1, 1, (3, 4));
        offer.reply.send(None).expect_err("nobody is there to be answered");
    }
    let mut walker = desk.start(0, 8, Role::Walker);
    let offer = desk.offer().await;
    let offer = desk.go_on(offer, 1, (3, 4)).await;
    offer.reply.send(None).unwrap();
    // Its candidate would keep the walker's memory.
    drop(offer.report);
    assert!(walker.wait().unwrap().success());
    desk.handle.gone(0, 8, false);
    assert!(matches!(desk.next().await, Incoming::Gone { walker: 0, fault: false }));
    assert_eq!(files_of(&desk.place).len(), SERVER_FILES, "{:#?}", files_of(&desk.place));
    desk.close().await;
}

/// The reactor hears of the last walker's end also if the server is closed at once: others may keep its channel open.
#[tokio::test(flavor = "multi_thread")]
async fn an_end_is_told_before_the_server_closes() {
    let directory = tempfile::tempdir().unwrap();
    let mut desk = Desk::open(directory.path(), 1, 1 << 16);
    let mut stuck = desk.start(0, 1, Role::Stuck);
    desk.offer().await.reply.send(Some(work(0, 1, (3, 4)))).unwrap();
    assert!(matches!(desk.incoming.recv().await, Some(Incoming::Progress(..))), "it is at work");
    kill(&mut stuck);
    desk.handle.gone(0, 1, false);
    desk.handle.close();
    assert!(matches!(desk.next().await, Incoming::Gone { walker: 0, fault: false }));
    desk.close().await;
}

/// The successor of a dead walker is expected before somebody says that it is dead: nothing of the successor is freed.
#[tokio::test(flavor = "multi_thread")]
async fn late_news_of_a_death_does_no_harm_to_the_successor() {
    let directory = tempfile::tempdir().unwrap();
    let mut desk = Desk::open(directory.path(), 1, 1 << 16);
    let mut first = desk.start(0, 1, Role::Stuck);
    desk.offer().await.reply.send(Some(work(0, 1, (3, 4)))).unwrap();
    assert!(matches!(desk.incoming.recv().await, Some(Incoming::Progress(..))), "it is at work");
    kill(&mut first);

    let mut second = desk.start(0, 2, Role::Walker);
    assert!(matches!(desk.next().await, Incoming::Gone { walker: 0, fault: false }), "of the first, once");
    let offer = desk.offer().await;
    desk.handle.gone(0, 1, false);
    let offer = desk.go_on(offer, 2, (3, 4)).await;
    offer.reply.send(None).unwrap();
    assert!(second.wait().unwrap().success());
    desk.handle.gone(0, 2, true);
    let gone = desk.next().await;
    assert!(matches!(gone, Incoming::Gone { walker: 0, fault: true }), "{gone:?}");
    desk.close().await;
}

/// Tables of two services, of the server's sockets and data, a counter of processes, and the directory.
const SERVER_FILES: usize = 7;

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_orchestrator_leaves_nothing_that_matters() {
    let directory = tempfile::tempdir().unwrap();
    let place = Place::of(directory.path()).unwrap();
    for _ in 0..2 {
        let mut dead = start(&Role::Orchestrator(directory.path().to_str().unwrap().to_owned()));
        while !directory.path().join(AT_WORK).exists() {
            assert!(dead.try_wait().unwrap().is_none(), "it ended before it was at work");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        kill(&mut dead);
        std::fs::remove_file(directory.path().join(AT_WORK)).unwrap();
    }
    let left = place.prepare(0).unwrap().removed;
    assert!(left.files > 20 && left.bytes > 50_000, "{left:?}");
    assert_eq!(files_of(&place), [place.directory().display().to_string()]);

    let mut desk = Desk::open(directory.path(), 1, 1 << 16);
    let mut walker = desk.start(0, 1, Role::Walker);
    let offer = desk.offer().await;
    let offer = desk.go_on(offer, 1, (3, 4)).await;
    offer.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    desk.close().await;
}
