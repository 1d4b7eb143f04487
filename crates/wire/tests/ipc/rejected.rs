//! Invalid messages and unexpected walkers are rejected.

use std::time::Duration;

use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::port::client::Client;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::{FileName, Path, SemanticString, ServiceName, ipc_threadsafe};
use serde_json::Value;
use wire::{Candidate, CandidateBlock};

use super::process::{Role, assignment, candidate};
use super::test_server::TestServer;

type Service = ipc_threadsafe::Service;

/// A process that connects and sends arbitrary messages.
struct ForeignSender {
    session: u64,
    port: Client<Service, [u64], (), [u64], ()>,
    wakeup_event: Notifier<Service>,
    _node: Node<Service>,
}

impl ForeignSender {
    fn enter(server: &TestServer) -> Self {
        let door = serde_json::to_value(server.handle.connect_info(0, 0)).unwrap();
        let text = |key: &str| door.get(key).and_then(Value::as_str).unwrap().to_owned();
        let mut config = Config::default();
        config.global.set_root_path(&Path::new(text("directory").as_bytes()).unwrap());
        config.global.prefix = FileName::new(text("prefix").as_bytes()).unwrap();
        config.global.service.event_connection_suffix = FileName::new(b".e").unwrap();
        let node = NodeBuilder::new().config(&config).create::<Service>().unwrap();
        let session = door["sender"]["session"].as_u64().unwrap();
        let name =
            |what: &str| -> ServiceName { format!("{session:016x}/{what}").as_str().try_into().unwrap() };
        let wakeup_event = node.service_builder(&name("server")).event().open().unwrap();
        let requests =
            node.service_builder(&name("requests")).request_response::<[u64], [u64]>().open().unwrap();
        let port = requests.client_builder().initial_max_slice_len(1 << 17).create().unwrap();
        let wakeup_event = wakeup_event.notifier_builder().create().unwrap();
        Self { session, port, wakeup_event, _node: node }
    }

    fn send(&self, bytes: &[u8]) {
        let words = words(bytes);
        let pending =
            self.port.loan_slice_uninit(words.len()).unwrap().write_from_slice(&words).send().unwrap();
        self.wakeup_event.notify().unwrap();
        assert_eq!(pending.number_of_server_connections(), 1);
    }

    /// Sends bytes and checks that they are rejected for this reason.
    async fn refused(&self, server: &TestServer, bytes: &[u8], reason: &str) {
        let before = server.handle.traffic().rejected;
        self.send(bytes);
        while server.handle.traffic().rejected == before {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let found = server.handle.traffic().last_rejected.unwrap();
        assert!(found.contains(reason), "found '{found}', expected '{reason}'");
    }

    /// An envelope as walkers encode it.
    fn letter(&self, (walker, incarnation): (u32, u32), words: &[u8]) -> Vec<u8> {
        let caller = postcard::to_stdvec(&(self.session, walker, incarnation)).unwrap();
        [caller.as_slice(), words].concat()
    }
}

/// The bytes padded to whole words, as they are sent.
fn words(bytes: &[u8]) -> Vec<u64> {
    let word = |bytes: &[u8]| std::array::from_fn(|k| bytes.get(k).copied().unwrap_or(0));
    bytes.chunks(8).map(|bytes| u64::from_le_bytes(word(bytes))).collect()
}

/// Plain data as a control message.
fn sealed(content: &[u8]) -> Vec<u8> {
    [b"CALM\x06".as_slice(), &crc32fast::hash(content).to_le_bytes(), content].concat()
}

/// A request with a control message and the bytes after it.
fn framed(control: &[u8], behind: &[u8]) -> Vec<u8> {
    let padding = control.len().next_multiple_of(8) - control.len();
    [&(control.len() as u64).to_le_bytes()[..], control, &[0; 8][..padding], behind].concat()
}

/// The payload of an offer whose report names this candidate.
fn offer(sequence: u8, candidate: &Candidate) -> Vec<u8> {
    let id = candidate.id;
    let (progress, trace) = (wire::messages::WalkProgress::default(), Vec::<wire::TracePoint>::new());
    let frames = Vec::<wire::WalkFrame>::new();
    let start = None::<wire::messages::AssignmentStart>;
    let report = (id.walk.0, 1_u64, start, 0_u8, id, &[1_u8, 2][..], progress, trace, frames);
    [&[0, sequence, 1][..], &postcard::to_stdvec(&report).unwrap()].concat()
}

const NOTHING: &[u8] = &[0, 1, 0];
const QUESTION: &[u8] = &[1, 1];

#[tokio::test(flavor = "multi_thread")]
async fn invalid_messages_are_rejected_and_counted() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 2, 1 << 16);
    let mut walker = server.start(0, 1, Role::Walker);
    let mut last = server.offer().await;
    let sender = ForeignSender::enter(&server);

    sender.refused(&server, &[], "request too short: 0 bytes").await;
    sender
        .refused(
            &server,
            &[0xff; 304],
            "request of 304 bytes, but its control message should have 18446744073709551615",
        )
        .await;
    sender.refused(&server, &framed(b"", b""), "control message too short: 0 bytes").await;
    last = server.go_on(last, 1, (3, 4)).await;

    let good = sealed(&sender.letter((7, 2), QUESTION));
    let changed = |at: usize, byte: u8| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        framed(&bytes, b"")
    };
    sender.refused(&server, &changed(0, b'B'), "not a control message").await;
    sender.refused(&server, &changed(4, 1), "control message of version 1,").await;
    sender.refused(&server, &changed(12, 0x55), "damaged control message").await;
    let trailing = sealed(&[sender.letter((7, 2), QUESTION).as_slice(), &[0]].concat());
    sender.refused(&server, &framed(&trailing, b""), "1 extra bytes after the end").await;
    let unknown = sealed(&sender.letter((7, 2), &[9]));
    sender.refused(&server, &framed(&unknown, b""), "cannot decode control message").await;
    last = server.go_on(last, 2, (3, 4)).await;

    let of = |caller, words: &[u8]| framed(&sealed(&sender.letter(caller, words)), b"");
    sender.refused(&server, &of((7, 2), QUESTION), "message of unexpected walker 7").await;
    sender
        .refused(
            &server,
            &of((0, 2), NOTHING),
            "message of incarnation 2 of walker 0, expected incarnation 1",
        )
        .await;
    let other = ForeignSender { session: !sender.session, ..ForeignSender::enter(&server) };
    let bytes = framed(&sealed(&other.letter((0, 1), QUESTION)), b"");
    other.refused(&server, &bytes, "message of session ffffffff").await;
    last = server.go_on(last, 3, (3, 4)).await;

    last.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    assert!(
        server.heard.lock().unwrap().iter().all(|walker| *walker == 0),
        "unexpected senders give no heartbeats"
    );
    drop((sender, other));
    server.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn offers_with_invalid_candidates_change_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 2, 1 << 16);
    server.handle.expect(7, 2);
    let sender = ForeignSender::enter(&server);
    let candidate = candidate(&assignment(3, 1, (5, 6)));
    let block = CandidateBlock::encode(&candidate);
    let with = |words: &[u8], behind: &[u8]| framed(&sealed(&sender.letter((7, 2), words)), behind);
    let one = offer(1, &candidate);

    sender
        .refused(
            &server,
            &with(&offer(9, &candidate), block.as_bytes()),
            "offer 9 of walker 7 is out of order: the last was 0",
        )
        .await;
    sender.refused(&server, &with(&one, b""), "the attached block is none").await;
    sender
        .refused(&server, &with(&one, &block.as_bytes()[..104]), "candidate block too short: 104 bytes")
        .await;
    let mut damaged = block.as_bytes().to_vec();
    *damaged.last_mut().unwrap() ^= 1;
    sender.refused(&server, &with(&one, &damaged), "damaged candidate block").await;
    let mut other = candidate.clone();
    other.id.step += 1;
    let other = CandidateBlock::encode(&other);
    sender.refused(&server, &with(&one, other.as_bytes()), "the attached block is 07070707-3.0.2-").await;
    let unexpected = "bytes: the message names none";
    sender.refused(&server, &with(NOTHING, block.as_bytes()), unexpected).await;
    assert!(server.incoming.try_recv().is_err() && server.heard.lock().unwrap().is_empty());

    // The valid offer is accepted; repeated, it is not accepted again.
    for _ in 0..3 {
        sender.send(&with(&one, block.as_bytes()));
    }
    let taken = server.offer().await;
    assert_eq!(taken.walker, 7);
    while server.heard.lock().unwrap().len() < 3 {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    assert!(server.incoming.try_recv().is_err());
    drop((sender, taken));
    server.close().await;
}

/// A flood of garbage does not block the server for other walkers.
#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_messages_does_not_block_walkers() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = TestServer::open(directory.path(), 2, 1 << 16);
    let mut walker = server.start(0, 1, Role::Walker);
    let sender = ForeignSender::enter(&server);
    let flood = std::thread::spawn(move || {
        for k in 0..20_000_u32 {
            let words = vec![u64::from(k) << 32 | u64::from(k); k as usize % 60 + 1];
            // Full buffers drop messages.
            let _ = sender.port.loan_slice_uninit(words.len()).unwrap().write_from_slice(&words).send();
            let _ = sender.wakeup_event.notify();
        }
    });
    let mut last = server.offer().await;
    for number in 1..50 {
        last = server.go_on(last, number, (3, 4)).await;
    }
    last.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    tokio::task::spawn_blocking(|| flood.join().unwrap()).await.unwrap();
    assert!(server.handle.traffic().rejected > 10, "{:?}", server.handle.traffic());
    server.close().await;
}
