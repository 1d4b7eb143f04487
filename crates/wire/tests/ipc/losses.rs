//! Lost messages and dead processes.

use std::process::Child;
use std::time::Duration;

use wire::shm_dir::ShmDir;
use wire::transport::Incoming;

use super::process::{AT_WORK, Role, start};
use super::test_server::{TestServer, check, files_of, work};

fn kill(child: &mut Child) {
    child.kill().unwrap();
    child.wait().unwrap();
}

/// The walker sends its offer before it is expected. The offer is rejected, as if it had been lost.
#[tokio::test(flavor = "multi_thread")]
async fn lost_offers_are_found_by_polling() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 1, 1 << 16);
    let mut walker = start(&Role::Walker(server.handle.connect_info(0, 1)));
    while server.handle.traffic().rejected == 0 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let reason = server.handle.traffic().last_rejected.unwrap();
    assert_eq!(reason, "message of unexpected walker 0");
    server.handle.expect(0, 1);
    let first = server.offer().await;
    let last = server.go_on(first, 1, (3, 4)).await;
    last.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    server.close().await;
}

/// A decision may take longer than the walker's poll interval; the offer remains the same.
#[tokio::test(flavor = "multi_thread")]
async fn walkers_wait_for_slow_decisions() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 1, 1 << 16);
    let mut walker = server.start(0, 1, Role::Walker);
    let first = server.offer().await;
    // An offer and two polls are heartbeats.
    while server.heard.lock().unwrap().len() < 3 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    assert!(server.incoming.try_recv().is_err(), "nothing is offered twice");
    let last = server.go_on(first, 1, (3, 4)).await;
    last.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    server.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_walker_is_replaced() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 2, 1 << 16);
    for incarnation in 1..8 {
        // Killed while working on an assignment.
        let mut stuck = server.start(0, incarnation, Role::Stuck);
        let offer = server.offer().await;
        assert_eq!((offer.walker, &offer.report), (0, &None));
        offer.reply.send(Some(work(0, 1, (3, 4)))).unwrap();
        assert!(matches!(server.incoming.recv().await, Some(Incoming::Progress(..))), "it is at work");
        kill(&mut stuck);
        server.handle.lost(0, incarnation, false);
        assert!(matches!(server.next().await, Incoming::Lost { walker: 0, crashed: false }));

        // Killed while waiting for the answer to a candidate.
        let mut waiting = server.start(1, incarnation, Role::Walker);
        let offer = server.offer().await;
        let mut offer = server.go_on(offer, 1, (3, 4)).await;
        kill(&mut waiting);
        server.handle.lost(1, incarnation, true);
        assert!(matches!(server.next().await, Incoming::Lost { walker: 1, crashed: true }));
        check(&offer.report.take().unwrap(), 1, 1, (3, 4));
        offer.reply.send(None).expect_err("the walker is dead");
    }
    let mut walker = server.start(0, 8, Role::Walker);
    let offer = server.offer().await;
    let offer = server.go_on(offer, 1, (3, 4)).await;
    offer.reply.send(None).unwrap();
    // Its candidate would keep the walker's memory mapped.
    drop(offer.report);
    assert!(walker.wait().unwrap().success());
    server.handle.lost(0, 8, false);
    assert!(matches!(server.next().await, Incoming::Lost { walker: 0, crashed: false }));
    assert_eq!(files_of(&server.place).len(), SERVER_FILES, "{:#?}", files_of(&server.place));
    server.close().await;
}

/// The reactor learns of the last walker's exit even if the server is closed immediately: others may keep its channel
/// open.
#[tokio::test(flavor = "multi_thread")]
async fn exits_are_forwarded_before_the_server_closes() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 1, 1 << 16);
    let mut stuck = server.start(0, 1, Role::Stuck);
    server.offer().await.reply.send(Some(work(0, 1, (3, 4)))).unwrap();
    assert!(matches!(server.incoming.recv().await, Some(Incoming::Progress(..))), "it is at work");
    kill(&mut stuck);
    server.handle.lost(0, 1, false);
    server.handle.close();
    assert!(matches!(server.next().await, Incoming::Lost { walker: 0, crashed: false }));
    server.close().await;
}

/// A successor is expected before the death of its predecessor is reported: the successor's resources are not freed.
#[tokio::test(flavor = "multi_thread")]
async fn late_reports_of_an_exit_do_not_affect_the_successor() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 1, 1 << 16);
    let mut first = server.start(0, 1, Role::Stuck);
    server.offer().await.reply.send(Some(work(0, 1, (3, 4)))).unwrap();
    assert!(matches!(server.incoming.recv().await, Some(Incoming::Progress(..))), "it is at work");
    kill(&mut first);

    let mut second = server.start(0, 2, Role::Walker);
    assert!(
        matches!(server.next().await, Incoming::Lost { walker: 0, crashed: false }),
        "of the first, once"
    );
    let offer = server.offer().await;
    server.handle.lost(0, 1, false);
    let offer = server.go_on(offer, 2, (3, 4)).await;
    offer.reply.send(None).unwrap();
    assert!(second.wait().unwrap().success());
    server.handle.lost(0, 2, true);
    let gone = server.next().await;
    assert!(matches!(gone, Incoming::Lost { walker: 0, crashed: true }), "{gone:?}");
    server.close().await;
}

/// Tables of two services, of the server's sockets and data, a counter of processes, and the directory.
const SERVER_FILES: usize = 7;

#[tokio::test(flavor = "multi_thread")]
async fn the_remains_of_a_killed_orchestrator_are_cleaned_up() {
    let directory = tempfile::tempdir().unwrap();
    let place = ShmDir::for_campaign(directory.path()).unwrap();
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

    let mut server = TestServer::open(directory.path(), 1, 1 << 16);
    let mut walker = server.start(0, 1, Role::Walker);
    let offer = server.offer().await;
    let offer = server.go_on(offer, 1, (3, 4)).await;
    offer.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    server.close().await;
}
