//! Exchange of assignments and reports.

use super::process::Role;
use super::test_server::{Offer, TestServer, check, work};

/// Messages of 1 kB to 4 MB, in memory reserved for smaller ones.
#[tokio::test(flavor = "multi_thread")]
async fn candidates_of_any_size_survive_a_round_trip() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 1, 1 << 17);
    let mut walker = server.start(0, 1, Role::Walker);
    let mut last = server.offer().await;
    assert_eq!((last.walker, &last.report), (0, &None));
    let sizes = [(1, 0), (4, 20), (108, 131), (108, 131), (1000, 500), (1, 1), (500, 1040), (108, 0)];
    for (number, size) in (1..).zip(sizes) {
        last = server.go_on(last, number, size).await;
    }
    last.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    server.handle.lost(0, 1, false);
    assert!(matches!(server.next().await, wire::transport::Incoming::Lost { walker: 0, crashed: false }));

    let traffic = server.handle.traffic();
    assert_eq!((traffic.rejected, traffic.unsent), (0, 0), "{traffic:?}");
    assert!(traffic.received > sizes.len() as u64 && traffic.bytes > 8_000_000, "{traffic:?}");
    let heard = server.heard.lock().unwrap().clone();
    assert_eq!((heard.len() as u64, heard.iter().all(|walker| *walker == 0)), (traffic.received, true));
    server.close().await;
}

/// A round of many walks: the selector holds more candidates than the walker has memory for, even after its exit.
#[tokio::test(flavor = "multi_thread")]
async fn candidates_live_as_long_as_they_are_used() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 1, 1 << 17);
    let mut walker = server.start(0, 1, Role::Walker);
    let mut held = Vec::new();
    let mut last = server.offer().await;
    for number in 1..30 {
        last.reply.send(Some(work(0, number, (20, 30)))).unwrap();
        last = server.offer().await;
        held.push(last.report.take().unwrap());
        if number == 20 {
            held.drain(3..10);
        }
    }
    walker.kill().unwrap();
    walker.wait().unwrap();
    server.handle.lost(0, 1, false);
    assert!(matches!(server.next().await, wire::transport::Incoming::Lost { walker: 0, crashed: false }));
    for report in &held {
        check(report, 0, report.assignment, (20, 30));
    }
    assert_eq!(held.len(), 22);
    assert_eq!(server.handle.traffic().rejected, 0, "{:?}", server.handle.traffic());
    drop(held);
    server.close().await;
}

/// Walkers that send at the same moment, again and again: a wake-up that is lost would leave them without an answer.
#[tokio::test(flavor = "multi_thread")]
async fn bursts_of_messages_are_all_answered() {
    const WALKERS: u32 = 16;
    const ROUNDS: u64 = 300;
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), WALKERS, 1 << 14);
    let mut walkers: Vec<_> = (0..WALKERS).map(|walker| server.start(walker, 1, Role::Walker)).collect();
    for number in 1..=ROUNDS {
        let mut waiting = Vec::new();
        while waiting.len() < walkers.len() {
            waiting.push(server.offer().await);
        }
        for Offer { walker, reply, .. } in waiting {
            reply.send((number < ROUNDS).then(|| work(walker, number, (1, 1)))).unwrap();
        }
    }
    assert!(walkers.iter_mut().all(|walker| walker.wait().unwrap().success()));
    server.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn many_walkers_are_answered_each_for_itself() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 6, 1 << 16);
    let mut walkers: Vec<_> = (0..6).map(|walker| server.start(walker, 3, Role::Walker)).collect();
    let mut assignments = [0; 6];
    let mut finished = 0;
    while finished < walkers.len() {
        let offer = server.offer().await;
        let number = &mut assignments[offer.walker as usize];
        if *number > 0 {
            check(&offer.report.unwrap(), offer.walker, *number, (3, 4));
        }
        *number += 1;
        finished += usize::from(*number == 40);
        offer.reply.send((*number < 40).then(|| work(offer.walker, *number, (3, 4)))).unwrap();
    }
    assert!(walkers.iter_mut().all(|walker| walker.wait().unwrap().success()));
    assert_eq!(server.handle.traffic().rejected, 0);
    server.close().await;
}
