//! The server is restarted, or down for longer.

use std::thread::sleep;
use std::time::Duration;

use super::server::{Campaign, Halted, control};
use crate::common::campaign::Small;
use crate::common::hosts::uninterrupted_outcome;
use crate::common::processes::{processes_running, signal, wait_for_process, wait_until};
use crate::common::random;

/// About 20 s of work for two walkers.
fn long() -> Small {
    Small { steps: 1600, max_per_walk: 16, ..Small::default() }
}

/// Restarts the server in order and after crashes, while walkers and labellers work on two hosts.
#[test]
fn restarts_change_nothing() {
    let small = long();
    let expected = uninterrupted_outcome(&small);
    let campaign = Campaign::new(&small, "restarts", 1, "");
    let (mut orchestrator, mut agent) = (campaign.hosts.start_orchestrator(), campaign.hosts.agent(0));
    // From the first candidate on: a fast machine may end the campaign before the last restart otherwise.
    campaign.wait_until(&mut orchestrator, "candidates are sent", || campaign.counters().sent > 0);
    let (mut before, mut restarts) = (campaign.counters(), 0);
    while restarts < 4 {
        // Either counter: the walks may end before a labeller tries again.
        wait_until("the campaign advances or ends", || {
            let now = campaign.counters();
            now.sent > before.sent
                || now.labels > before.labels
                || orchestrator.0.try_wait().unwrap().is_some()
        });
        if orchestrator.0.try_wait().unwrap().is_some() {
            break;
        }
        before = campaign.counters();
        sleep(Duration::from_millis(random(restarts) % 500));
        control(if restarts % 3 == 0 { "restart" } else { "crash" });
        restarts += 1;
        let after = campaign.counters();
        assert!(after.has_not_decreased_since(&before), "{before:?} {after:?}");
    }
    assert!(restarts > 1, "the campaign ended after {restarts} restarts");
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", campaign.hosts.orchestrator_stderr());
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", campaign.hosts.said(0));
    assert_eq!(campaign.outcome(), expected);
}

/// The same in a single process, which is several times faster.
#[test]
fn restarts_change_nothing_in_one_process() {
    let small = Small { steps: 4000, max_per_walk: 40, ..Small::default() };
    let expected = uninterrupted_outcome(&small);
    let mut campaign = Campaign::new(&small, "one", 0, "");
    campaign.hosts.listens = false;
    campaign.hosts.options[0] = vec!["--in-process".into()];
    let mut orchestrator = campaign.hosts.start_orchestrator();
    for restart in 0..2 {
        let before = campaign.counters();
        campaign.wait_until(&mut orchestrator, "the campaign advances", || {
            let now = campaign.counters();
            now.sent > before.sent || now.labels > before.labels
        });
        sleep(Duration::from_millis(random(50 + restart) % 500));
        control("crash");
    }
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", campaign.hosts.orchestrator_stderr());
    assert_eq!(campaign.outcome(), expected);
}

/// The server is down for longer than the heartbeat timeouts. A labeller that dies during this time is replaced by one that
/// also waits.
#[test]
fn a_server_that_is_away_for_a_minute_is_waited_for() {
    let small = long();
    let expected = uninterrupted_outcome(&small);
    let campaign = Campaign::new(&small, "away", 1, "");
    let (mut orchestrator, mut agent) = (campaign.hosts.start_orchestrator(), campaign.hosts.agent(0));
    campaign.wait_until(&mut orchestrator, "labels are made", || campaign.counters().labels > 0);
    let before = campaign.counters();
    let halted = Halted::now();
    let said = |words: &str| campaign.hosts.orchestrator_stderr().contains(words);
    campaign.wait_until(&mut orchestrator, "the orchestrator reports why it waits", || {
        said("waiting for the database: the database server does not answer")
    });
    let labeller = wait_for_process(campaign.home(), "labeller");
    signal(labeller, "KILL");
    wait_until("another labeller is running", || {
        processes_running(campaign.home(), "labeller").first().is_some_and(|other| *other != labeller)
    });
    sleep(Duration::from_secs(60));
    assert!(orchestrator.0.try_wait().unwrap().is_none(), "{}", campaign.hosts.orchestrator_stderr());
    assert!(agent.0.try_wait().unwrap().is_none(), "{}", campaign.hosts.said(0));
    drop(halted);
    wait_until("the orchestrator reports that the database answers", || said("the database answers again"));
    let after = campaign.counters();
    assert!(after.has_not_decreased_since(&before), "{before:?} {after:?}");
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", campaign.hosts.orchestrator_stderr());
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", campaign.hosts.said(0));
    assert_eq!(campaign.outcome(), expected);
}
