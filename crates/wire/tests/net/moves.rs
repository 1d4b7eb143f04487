//! The orchestrator restarts at another endpoint.

use std::fs;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::timeout;
use wire::net::{Address, AgentClient, Announcement, LinkError, NetError, SlotReport};

use super::test_server::{LIMIT, ServerOptions, TestServer, agent, endpoint, report, work};

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_follows_the_orchestrator_to_another_endpoint() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("endpoint");
    // Written atomically, as seen by a reader.
    let write = |announcement: Announcement| {
        fs::write(path.with_extension("new"), announcement.to_string()).unwrap();
        fs::rename(path.with_extension("new"), &path).unwrap();
    };
    let address = Address::File(path.clone());
    // The agent waits until the orchestrator has started.
    let (why, whys) = std::sync::mpsc::channel();
    let opening = {
        let address = address.clone();
        let waiting = move |error: &NetError| why.send(error.to_string()).unwrap();
        tokio::spawn(async move { AgentClient::open(&address, None, agent("a", 1), waiting).await.unwrap() })
    };
    let mut server = TestServer::open(ServerOptions::default()).await;
    let told = tokio::task::spawn_blocking(move || whys.recv_timeout(LIMIT).unwrap()).await.unwrap();
    assert!(told.contains("endpoint file not found"), "{told}");
    write(Announcement::Endpoint(endpoint(server.port)));
    let client = Arc::new(timeout(LIMIT, opening).await.expect("in time").unwrap());
    let membership = Arc::new(timeout(LIMIT, client.join()).await.expect("in time").unwrap());

    let mut slot = membership.slots().remove(0);
    let mixture = ServerOptions::default().mixture;
    let line = Arc::clone(&membership);
    let exchange = tokio::spawn(async move { (slot.exchange(&line, &SlotReport::Empty).await, slot) });
    server.offer().await.reply.send(Some(work(4, 1, &mixture))).unwrap();
    let (given, mut slot) = exchange.await.unwrap();
    let last_report = SlotReport::Report(Box::new(report(&given.unwrap().unwrap().assignment)));
    let before = server.kill().await;
    let line = Arc::clone(&membership);
    let telling = tokio::spawn(async move { slot.exchange(&line, &last_report).await.map(drop) });
    tokio::time::sleep(Duration::from_millis(300)).await;
    let server = TestServer::open(ServerOptions { session: 2, ..ServerOptions::default() }).await;
    assert_ne!(server.port, before);
    write(Announcement::Endpoint(endpoint(server.port)));
    let refused = timeout(LIMIT, telling).await.expect("in time").unwrap();
    assert!(matches!(refused, Err(LinkError::RejoinRequired(_))), "{refused:?}");
    let membership = timeout(LIMIT, client.join()).await.expect("in time").unwrap();
    assert!(timeout(Duration::from_millis(300), address.wait_until_over()).await.is_err());
    write(Announcement::Over);
    timeout(LIMIT, address.wait_until_over()).await.expect("in time");
    membership.leave().await;
    server.close().await;
}
