//! Broken links, and dead agents and orchestrators: nothing is lost or delivered twice.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::{sleep, timeout};
use wire::net::{AgentEvent, LinkError, SlotReport};
use wire::transport::Incoming;

use super::link::{Link, State};
use super::test_server::{LIMIT, TestServer, Wanted, agent, join, mixture, next_version, report, work};

/// The link is cut or silently dead before the offer, while it is pending, and during the answer.
#[tokio::test(flavor = "multi_thread")]
async fn reports_over_a_breaking_link_arrive_once() {
    let mut head = TestServer::open(Wanted::default()).await;
    let link = Link::to(head.port).await;
    let (_uplink, joined) = join(link.port, agent("a", 1)).await;
    let mut slot = joined.slots().remove(0);
    let line = Arc::clone(&joined);
    let working = tokio::spawn(async move {
        let mut last_report = SlotReport::Empty;
        while let Some(work) = slot.exchange(&line, &last_report).await.unwrap() {
            sleep(Duration::from_millis(300)).await;
            last_report = SlotReport::Report(report(&work.assignment));
        }
    });
    let mut mixture = Arc::new(mixture());
    let mut expected = None;
    let breaks = [State::Cut, State::Dead, State::Cut];
    for number in 1..=6_u64 {
        let offer = head.offer().await;
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
    let offer = head.offer().await;
    assert_eq!(offer.report, expected);
    offer.reply.send(None).unwrap();
    timeout(LIMIT, working).await.expect("in time").unwrap();
    joined.leave().await;
    head.close().await;
}

/// An agent that was unresponsive for too long has lost its slots before this is reported, and is rejected when it
/// comes back.
#[tokio::test(flavor = "multi_thread")]
async fn lost_agents_stay_lost_and_may_join_again() {
    let patience = Duration::from_millis(700);
    let mut head = TestServer::open(Wanted { patience, ..Wanted::default() }).await;
    let link = Link::to(head.port).await;
    let (uplink, joined) = join(link.port, agent("a", 2)).await;
    let mut slots = joined.slots();
    let mixture = Arc::new(mixture());
    let line = Arc::clone(&joined);
    let mut slot = slots.remove(0);
    let exchange = tokio::spawn(async move { (slot.exchange(&line, &SlotReport::Empty).await, slot) });
    let first = head.offer().await;
    first.reply.send(Some(work(2, 1, &mixture))).unwrap();
    let (given, mut slot) = exchange.await.unwrap();
    let assignment = given.unwrap().unwrap().assignment;
    // The other slot waits for its assignment.
    let line = Arc::clone(&joined);
    let mut other = slots.remove(0);
    let waiting = tokio::spawn(async move { other.exchange(&line, &SlotReport::Empty).await.map(drop) });
    let second = head.offer().await;

    link.set(State::Cut);
    head.event(|event| matches!(event, AgentEvent::Unresponsive(_))).await;
    for walker in [first.walker, second.walker] {
        let gone = head.next().await;
        assert!(matches!(gone, Incoming::Lost { walker: found, .. } if found == walker), "{gone:?}");
    }
    assert!(second.reply.send(Some(work(3, 1, &mixture))).is_err(), "no walker would get this assignment");
    head.event(|event| matches!(event, AgentEvent::Lost(_))).await;

    link.set(State::Whole);
    let last_report = SlotReport::Report(report(&assignment));
    let refused = timeout(LIMIT, slot.exchange(&joined, &last_report)).await.expect("in time");
    assert!(matches!(refused, Err(LinkError::RejoinRequired(_))), "{refused:?}");
    assert!(matches!(waiting.await.unwrap(), Err(LinkError::RejoinRequired(_))));
    let joined = Arc::new(timeout(LIMIT, uplink.join()).await.expect("in time").unwrap());
    let mut slot = joined.slots().remove(0);
    let line = Arc::clone(&joined);
    let telling = tokio::spawn(async move { slot.exchange(&line, &last_report).await.unwrap().is_none() });
    let offer = head.offer().await;
    assert!(offer.walker > second.walker, "numbers are never used again");
    assert_eq!(offer.report, Some(report(&assignment)));
    offer.reply.send(None).unwrap();
    assert!(telling.await.unwrap());
    joined.leave().await;
    head.close().await;
}

/// An orchestrator dies and another replaces it at the same endpoint.
#[tokio::test(flavor = "multi_thread")]
async fn an_agent_finds_the_next_run_of_its_orchestrator() {
    let mut head = TestServer::open(Wanted::default()).await;
    let (uplink, joined) = join(head.port, agent("a", 1)).await;
    let mut slot = joined.slots().remove(0);
    let mixture = next_version(&mixture(), 1, 1);
    let line = Arc::clone(&joined);
    let exchange = tokio::spawn(async move { (slot.exchange(&line, &SlotReport::Empty).await, slot) });
    head.offer().await.reply.send(Some(work(4, 1, &mixture))).unwrap();
    let (given, mut slot) = exchange.await.unwrap();
    let assignment = given.unwrap().unwrap().assignment;
    let port = head.kill().await;
    let last_report = SlotReport::Report(report(&assignment));
    let line = Arc::clone(&joined);
    let telling = tokio::spawn(async move { slot.exchange(&line, &last_report).await.map(drop) });
    sleep(Duration::from_millis(500)).await;
    let mut head = TestServer::open(Wanted { port, session: 2, mixture, ..Wanted::default() }).await;
    let refused = timeout(LIMIT, telling).await.expect("in time").unwrap();
    assert!(matches!(refused, Err(LinkError::RejoinRequired(_))), "{refused:?}");
    let joined = timeout(LIMIT, uplink.join()).await.expect("in time").unwrap();
    assert_eq!(joined.newest().await.version(), 1);
    let mut slot = joined.slots().remove(0);
    let last_report = SlotReport::Report(report(&assignment));
    let telling = async { slot.exchange(&joined, &last_report).await.unwrap().is_none() };
    let (home, found) = tokio::join!(telling, async {
        let offer = head.offer().await;
        offer.reply.send(None).unwrap();
        offer.report
    });
    assert!(home);
    assert_eq!(found, Some(report(&assignment)));
    joined.leave().await;
    head.close().await;
}
