//! The link between an orchestrator and an agent breaks, as programs on two hosts see it. The agent has one walker and may
//! prefetch one assignment, so its walker works for one or two assignments without the link, and then waits.

use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use super::cable::{Cable, HEAD, NODE};
use super::must;
use crate::common::Running;
use crate::common::campaign::{Counters, Outcome, Small, outcome};
use crate::common::hosts::{Hosts, uninterrupted_outcome};
use crate::common::processes::{pause_walkers, processes_running, wait_until};

/// Three concurrent walks: one for the orchestrator's own walker, two for the agent.
fn small() -> Small {
    Small {
        walks_per_round: 3,
        seed_structures: &["fcc-100", "vacancy", "fcc-097"],
        steps: 1600,
        max_per_walk: 8,
        ..Small::default()
    }
}

/// A campaign on two hosts, with certificates.
struct Linked {
    hosts: Hosts,
    cable: Cable,
    orchestrator: Running,
    agent: Running,
}

impl Linked {
    /// Starts both hosts. The server declares an agent dead after `heartbeat_timeout` (s), and the agent gives up after
    /// `wait_timeout` (min).
    fn new(heartbeat_timeout: f64, wait_timeout: f64) -> Self {
        let linked = Self::with_cable(Cable::new(), heartbeat_timeout, wait_timeout);
        linked.are_at_work();
        linked
    }

    fn with_cable(cable: Cable, heartbeat_timeout: f64, wait_timeout: f64) -> Self {
        let mut hosts =
            Hosts::new(&small(), 1, &format!("agent_heartbeat_timeout = \"{heartbeat_timeout}s\""));
        hosts.through = cable.through();
        hosts.endpoints = ["0.0.0.0", HEAD].map(|address| format!("tcp/{address}:7447"));
        let certificates = hosts.home.path().join("certificates");
        certify(&certificates);
        let tls = |name: &str| ["--tls".to_owned(), certificates.join(name).display().to_string()];
        let [prefetch, timeout] =
            ["--prefetch=1".to_owned(), format!("--wait-timeout={}s", (60.0 * wait_timeout) as u64)];
        hosts.options = [tls(HEAD).into(), tls(NODE).into_iter().chain([prefetch, timeout]).collect()];
        let (orchestrator, agent) = (hosts.start_orchestrator(), hosts.agent(0));
        Self { hosts, cable, orchestrator, agent }
    }

    fn are_at_work(&self) {
        // The orchestrator's walker must not end the campaign before the other host has joined.
        let held = pause_walkers(self.hosts.home.path(), 1);
        wait_until("the other host is running", || {
            !processes_running(self.hosts.others[0].path(), "walker").is_empty()
        });
        held.resume();
        wait_until("structures are found", || self.counters().accepted > 0);
    }

    fn counters(&self) -> Counters {
        Counters::read(".", self.hosts.home.path())
    }

    fn agent_says(&self, words: &str) -> bool {
        self.hosts.said(0).contains(words)
    }

    fn head_says(&self, words: &str) -> bool {
        self.hosts.orchestrator_stderr().contains(words)
    }

    /// Waits until the agent's walker is idle.
    fn walker_waits(&self) {
        let said = "unsent reports, 1 of 1 walkers idle";
        wait_until("the agent's walker waits", || self.agent_says(said));
    }

    /// Waits for the end, and checks that no counter has decreased. Returns the exit code of the agent.
    fn ends_as(mut self, expected: &Outcome, before: Counters) -> (Option<i32>, Hosts) {
        let ended = self.orchestrator.0.wait().unwrap();
        assert_eq!(ended.code(), Some(0), "{}", self.hosts.orchestrator_stderr());
        let agent = self.agent.0.wait().unwrap();
        let after = self.counters();
        assert!(after.has_not_decreased_since(&before), "{before:?} {after:?}");
        assert_eq!(&outcome(self.hosts.home.path()), expected, "{}", self.hosts.said(0));
        self.hosts.assert_cleaned_up();
        (agent.code(), self.hosts)
    }
}

fn certify(directory: &Path) {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/certificates.sh");
    must(&format!("sh {script} {} {HEAD} {NODE}", directory.display()));
}

/// The server declares no agent dead: the walker delivers what it found during the cut, and continues.
#[test]
fn cut_for_five_seconds() {
    let linked = Linked::new(60.0, 60.0);
    let before = linked.counters();
    linked.cable.cut();
    sleep(Duration::from_secs(5));
    linked.cable.mend();
    let (agent, hosts) = linked.ends_as(&uninterrupted_outcome(&small()), before);
    assert_eq!(agent, Some(0), "{}", hosts.said(0));
    assert!(
        !hosts.orchestrator_stderr().contains("its walks go to other walkers"),
        "{}",
        hosts.orchestrator_stderr()
    );
}

/// Twice the heartbeat timeout: the server reassigns the walks to the orchestrator's own walker. The host joins again
/// after the cut; the server discards its results for walks that were reassigned or finished.
#[test]
fn cut_for_half_a_minute() {
    let linked = Linked::new(15.0, 60.0);
    let before = linked.counters();
    linked.cable.cut();
    let begun = Instant::now();
    linked.walker_waits();
    wait_until("the walks are reassigned", || linked.head_says("its walks go to other walkers"));
    let handed_on = linked.counters();
    wait_until("another walker continues the walks", || linked.counters().sent > handed_on.sent);
    // Keep work for the host until it is back.
    let held = pause_walkers(linked.hosts.home.path(), 1);
    sleep(Duration::from_secs(30).saturating_sub(begun.elapsed()));
    linked.cable.mend();
    wait_until("the agent is back", || linked.agent_says("the orchestrator answers again"));
    wait_until("the agent joins again", || {
        linked.hosts.orchestrator_stderr().matches("): joined").count() >= 2
    });
    held.resume();
    let (agent, hosts) = linked.ends_as(&uninterrupted_outcome(&small()), before);
    assert_eq!(agent, Some(0), "{}", hosts.said(0));
}

/// The campaign ends without the second host, and its agent gives up.
#[test]
fn cut_for_good() {
    let linked = Linked::new(2.0, 0.3);
    let before = linked.counters();
    linked.cable.cut();
    linked.walker_waits();
    let (agent, hosts) = linked.ends_as(&uninterrupted_outcome(&small()), before);
    assert_eq!(agent, Some(1), "{}", hosts.said(0));
    let last_words = "calmwalk: no answer from the orchestrator for 0.3 min";
    assert!(hosts.said(0).contains(last_words), "{}", hosts.said(0));
    assert!(
        hosts.orchestrator_stderr().contains("its walks go to other walkers"),
        "{}",
        hosts.orchestrator_stderr()
    );
}

/// The link drops messages in one direction, then in the other: each time both sides notice it, and then resume.
#[test]
fn one_way() {
    let linked = Linked::new(300.0, 60.0);
    let before = linked.counters();
    let all = "ip protocol tcp";
    for (comes_in, leaves) in [(Some(all), None), (None, Some(all))] {
        let said = |words| linked.hosts.said(0).matches(words).count();
        let back = said("the orchestrator answers again");
        let waits = said("1 of 1 walkers idle");
        linked.cable.drop_where(comes_in, leaves);
        wait_until("the walker waits", || said("1 of 1 walkers idle") > waits);
        linked.cable.drop_where(None, None);
        wait_until("the orchestrator is heard again", || said("the orchestrator answers again") > back);
    }
    let (agent, hosts) = linked.ends_as(&uninterrupted_outcome(&small()), before);
    assert_eq!(agent, Some(0), "{}", hosts.said(0));
    assert!(
        !hosts.orchestrator_stderr().contains("its walks go to other walkers"),
        "{}",
        hosts.orchestrator_stderr()
    );
}

/// The link drops one packet in five, in both directions and from the start: the walkers only wait longer.
#[test]
fn a_fifth_is_lost() {
    let cable = Cable::new();
    let some = Some("numgen random mod 100 < 20");
    cable.drop_where(some, some);
    let linked = Linked::with_cable(cable, 300.0, 60.0);
    linked.are_at_work();
    let before = linked.counters();
    let (agent, hosts) = linked.ends_as(&uninterrupted_outcome(&small()), before);
    assert_eq!(agent, Some(0), "{}", hosts.said(0));
}
