//! Broken links, and dead agents and orchestrators: nothing is lost or delivered twice.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::{sleep, timeout};
use wire::net::{AgentEvent, LinkError, SlotReport};
use wire::transport::Incoming;

use super::link::{Link, State};
use super::test_server::{
    LIMIT, ServerOptions, TestServer, agent, join, mixture, next_version, report, work,
};

/// The link is cut or silently dead before the offer, while it is pending, and during the answer.
#[tokio::test(flavor = "multi_thread")]
async fn reports_over_a_breaking_link_arrive_once() {
    let mut server = TestServer::open(ServerOptions::default()).await;
    let link = Link::to(server.port).await;
    let (_client, membership) = join(link.port, agent("a", 1)).await;
    let mut slot = membership.slots().remove(0);
    let line = Arc::clone(&membership);
    let working = tokio::spawn(async move {
        let mut last_report = SlotReport::Empty;
        while let Some(work) = slot.exchange(&line, &last_report).await.unwrap() {
            sleep(Duration::from_millis(300)).await;
            last_report = SlotReport::Report(Box::new(report(&work.assignment)));
        }
    });
    let mut mixture = Arc::new(mixture());
    let mut expected = None;
    let breaks = [State::Cut, State::Dead, State::Cut];
    for number in 1..=6_u64 {
        let offer = server.offer().await;
        assert_eq!(offer.report, expected, "assignment {number}: each report once, in order");
        mixture = next_version(&mixture, 0, 0);
        let work = work(2, number, &mixture);
        expected = Some(report(&work.assignment));
        let state = breaks[number as usize % breaks.len()];
        if number % 2 == 0 {
            // Cut while the offer is pending.
            link.set(state);
            sleep(Duration::from_millis(500)).await;
            offer.reply.send(Some(work)).unwrap();
            sleep(Duration::from_millis(500)).await;
        } else {
            // Cut while the walker works.
            offer.reply.send(Some(work)).unwrap();
            sleep(Duration::from_millis(200)).await;
            link.set(state);
            sleep(Duration::from_secs(2)).await;
        }
        link.set(State::Whole);
    }
    let offer = server.offer().await;
    assert_eq!(offer.report, expected);
    offer.reply.send(None).unwrap();
    timeout(LIMIT, working).await.expect("in time").unwrap();
    membership.leave().await;
    server.close().await;
}

/// An agent that was unresponsive for too long has lost its slots before this is reported, and is rejected when it
/// comes back.
#[tokio::test(flavor = "multi_thread")]
async fn lost_agents_stay_lost_and_may_join_again() {
    let agent_timeout = Duration::from_millis(700);
    let mut server = TestServer::open(ServerOptions { agent_timeout, ..ServerOptions::default() }).await;
    let link = Link::to(server.port).await;
    let (client, membership) = join(link.port, agent("a", 2)).await;
    let mut slots = membership.slots();
    let mixture = Arc::new(mixture());
    let line = Arc::clone(&membership);
    let mut slot = slots.remove(0);
    let exchange = tokio::spawn(async move { (slot.exchange(&line, &SlotReport::Empty).await, slot) });
    let first = server.offer().await;
    first.reply.send(Some(work(2, 1, &mixture))).unwrap();
    let (given, mut slot) = exchange.await.unwrap();
    let assignment = given.unwrap().unwrap().assignment;
    // The other slot waits for its assignment.
    let line = Arc::clone(&membership);
    let mut other = slots.remove(0);
    let waiting = tokio::spawn(async move { other.exchange(&line, &SlotReport::Empty).await.map(drop) });
    let second = server.offer().await;

    link.set(State::Cut);
    server.event(|event| matches!(event, AgentEvent::Unresponsive(_))).await;
    for walker in [first.walker, second.walker] {
        let gone = server.next().await;
        assert!(matches!(gone, Incoming::Lost { walker: found, .. } if found == walker), "{gone:?}");
    }
    assert!(second.reply.send(Some(work(3, 1, &mixture))).is_err(), "no walker would get this assignment");
    server.event(|event| matches!(event, AgentEvent::Lost(_))).await;

    link.set(State::Whole);
    let last_report = SlotReport::Report(Box::new(report(&assignment)));
    let refused = timeout(LIMIT, slot.exchange(&membership, &last_report)).await.expect("in time");
    assert!(matches!(refused, Err(LinkError::RejoinRequired(_))), "{refused:?}");
    assert!(matches!(waiting.await.unwrap(), Err(LinkError::RejoinRequired(_))));
    let membership = Arc::new(timeout(LIMIT, client.join()).await.expect("in time").unwrap());
    let mut slot = membership.slots().remove(0);
    let line = Arc::clone(&membership);
    let telling = tokio::spawn(async move { slot.exchange(&line, &last_report).await.unwrap().is_none() });
    let offer = server.offer().await;
    assert!(offer.walker > second.walker, "numbers are never used again");
    assert_eq!(offer.report, Some(report(&assignment)));
    offer.reply.send(None).unwrap();
    assert!(telling.await.unwrap());
    membership.leave().await;
    server.close().await;
}

/// An orchestrator dies and another replaces it at the same endpoint.
#[tokio::test(flavor = "multi_thread")]
async fn an_agent_finds_the_next_run_of_its_orchestrator() {
    let mut server = TestServer::open(ServerOptions::default()).await;
    let (client, membership) = join(server.port, agent("a", 1)).await;
    let mut slot = membership.slots().remove(0);
    let mixture = next_version(&mixture(), 1, 1);
    let line = Arc::clone(&membership);
    let exchange = tokio::spawn(async move { (slot.exchange(&line, &SlotReport::Empty).await, slot) });
    server.offer().await.reply.send(Some(work(4, 1, &mixture))).unwrap();
    let (given, mut slot) = exchange.await.unwrap();
    let assignment = given.unwrap().unwrap().assignment;
    let port = server.kill().await;
    let last_report = SlotReport::Report(Box::new(report(&assignment)));
    let line = Arc::clone(&membership);
    let telling = tokio::spawn(async move { slot.exchange(&line, &last_report).await.map(drop) });
    sleep(Duration::from_millis(500)).await;
    let mut server =
        TestServer::open(ServerOptions { port, session: 2, mixture, ..ServerOptions::default() }).await;
    let refused = timeout(LIMIT, telling).await.expect("in time").unwrap();
    assert!(matches!(refused, Err(LinkError::RejoinRequired(_))), "{refused:?}");
    let membership = timeout(LIMIT, client.join()).await.expect("in time").unwrap();
    assert_eq!(membership.newest().await.version(), 1);
    let mut slot = membership.slots().remove(0);
    let last_report = SlotReport::Report(Box::new(report(&assignment)));
    let telling = async { slot.exchange(&membership, &last_report).await.unwrap().is_none() };
    let (dismissed, found) = tokio::join!(telling, async {
        let offer = server.offer().await;
        offer.reply.send(None).unwrap();
        offer.report
    });
    assert!(dismissed);
    assert_eq!(found, Some(report(&assignment)));
    membership.leave().await;
    server.close().await;
}
