//! Exchange of assignments, reports, mixtures and files.

use std::collections::BTreeMap;
use std::sync::Arc;

use wire::WalkId;
use wire::messages::WalkProgress;
use wire::net::{AgentEvent, LinkError, SlotReport};
use wire::transport::Incoming;

use super::test_server::{ServerOptions, TestServer, agent, join, mixture, next_version, report, work};

#[tokio::test(flavor = "multi_thread")]
async fn assignments_and_reports_survive_a_round_trip() {
    let mut server = TestServer::open(ServerOptions::default()).await;
    let (_client, membership) = join(server.port, agent("a", 1)).await;
    assert_eq!(membership.setup, b"the setup");
    let mut slot = membership.slots().remove(0);
    let line = Arc::clone(&membership);
    let working = tokio::spawn(async move {
        let mut last_report = SlotReport::Empty;
        let mut assignments = 0;
        while let Some(work) = slot.exchange(&line, &last_report).await.unwrap() {
            assignments += 1;
            assert_eq!(work.assignment.number, assignments);
            assert_eq!(work.mixture.version(), assignments, "the version of the assignment");
            slot.progress(Arc::clone(&line), work.assignment.walk, WalkProgress::default()).await;
            last_report = SlotReport::Report(Box::new(report(&work.assignment)));
        }
        assignments
    });
    let mut mixture = Arc::new(mixture());
    assert_eq!(membership.original.at_version(mixture.version()), *mixture);
    let mut expected = None;
    for number in 1..=20 {
        let mut offer = server.next().await;
        while let Incoming::Progress(walk, _) = offer {
            assert_eq!(walk, WalkId(5));
            offer = server.next().await;
        }
        let Incoming::Idle { report: found, reply, .. } = offer else { panic!("{offer:?}") };
        assert_eq!(found, expected);
        mixture = next_version(&mixture, number % 2, number % 2);
        let work = work(5, number as u64, &mixture);
        expected = Some(report(&work.assignment));
        reply.send(Some(work)).unwrap();
    }
    let last = loop {
        if let Incoming::Idle { report, reply, .. } = server.next().await {
            reply.send(None).unwrap();
            break report;
        }
    };
    assert_eq!(last, expected);
    assert_eq!(working.await.unwrap(), 20);
    // The received mixture is bitwise equal, whatever deltas led to it.
    let newest = membership.newest().await;
    assert_eq!(newest.version(), mixture.version());
    for ((_, _, sent), (_, _, received)) in mixture.iter().zip(newest.iter()) {
        assert_eq!(sent.to_bytes(), received.to_bytes());
    }
    membership.leave().await;
    server.event(|event| matches!(event, AgentEvent::Left(_))).await;
    server.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn agents_that_join_late_have_the_original_mixture() {
    let original = Arc::new(mixture());
    let newest = next_version(&next_version(&original, 0, 1), 1, 0);
    let options = ServerOptions { mixture: Arc::clone(&newest), original, ..ServerOptions::default() };
    let server = TestServer::open(options).await;
    let (_client, membership) = join(server.port, agent("a", 1)).await;
    assert_eq!(*membership.newest().await, *newest);
    let (found, original) = (&membership.original, mixture());
    assert_eq!(found.at_version(original.version()), original);
    // What the newest version has not changed is one component for both.
    let newest = membership.newest().await;
    let both = newest.iter().zip(found.iter()).filter(|((.., new), (.., old))| Arc::ptr_eq(new, old));
    assert_eq!(both.count(), original.iter().count() - 2);
    membership.leave().await;
    server.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn lost_walkers_are_reported_and_their_slots_continue() {
    let mut server = TestServer::open(ServerOptions::default()).await;
    let (_client, membership) = join(server.port, agent("a", 2)).await;
    let mut slot = membership.slots().remove(1);
    let mixture = Arc::new(mixture());
    for fault in [true, false] {
        let line = Arc::clone(&membership);
        let last_report = if fault { SlotReport::Empty } else { SlotReport::Lost { crashed: true } };
        let exchange = tokio::spawn(async move {
            let work = slot.exchange(&line, &last_report).await.unwrap();
            (slot, work)
        });
        if !fault {
            let gone = server.next().await;
            assert!(matches!(&gone, Incoming::Lost { crashed, .. } if *crashed), "{gone:?}");
        }
        let offer = server.offer().await;
        assert_eq!(offer.report, None);
        offer.reply.send(Some(work(1, 1, &mixture))).unwrap();
        let work;
        (slot, work) = exchange.await.unwrap();
        assert!(work.is_some());
    }
    membership.leave().await;
    for _ in 0..2 {
        assert!(matches!(server.next().await, Incoming::Lost { crashed: false, .. }));
    }
    let last_report = SlotReport::Empty;
    assert!(
        matches!(slot.exchange(&membership, &last_report).await, Err(LinkError::RejoinRequired(_))),
        "it has left"
    );
    server.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn agents_fetch_files_by_hash_and_learn_of_a_stop() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model");
    let content: Vec<u8> = (0..9_500_000_u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    std::fs::write(&path, &content).unwrap();
    let files = BTreeMap::from([("0123".to_owned(), path)]);
    let server = TestServer::open(ServerOptions { files, ..ServerOptions::default() }).await;
    let (_client, membership) = join(server.port, agent("a", 1)).await;
    assert!(membership.fetch_file("0123").await.unwrap() == content);
    let refused = membership.fetch_file("../../etc/passwd").await.unwrap_err();
    assert!(
        matches!(&refused, LinkError::Rejected(why) if why.contains("has no file with hash")),
        "{refused}"
    );
    assert_eq!(membership.is_stopping().await.unwrap(), Some(false));
    server.tokens.stopping.cancel();
    assert_eq!(membership.is_stopping().await.unwrap(), Some(true));
    membership.leave().await;
    server.close().await;
}
