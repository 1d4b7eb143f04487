//! Clocks that are wrong by an hour, or jump by an hour (NTP, or set manually): no result depends on them. libfaketime sets
//! them.

use std::cell::Cell;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

use serde_json::Value;

use crate::common::campaign::{Counters, Small, outcome};
use crate::common::clock::Clock;
use crate::common::hosts::{Hosts, started, uninterrupted_outcome};
use crate::common::processes::{assert_no_leftovers, pause_walkers, processes_running, signal, wait_until};
use crate::common::{calmwalk, random, through};

#[test]
fn the_clocks_of_these_tests_are_wrong() {
    let directory = tempfile::tempdir().unwrap();
    let clock = Clock::new(directory.path(), "-1h");
    let seconds = |starter: &[String]| {
        let mut command = Command::new(starter.first().map_or("env", String::as_str));
        let output =
            command.args(starter.get(1..).unwrap_or_default()).args(["date", "+%s"]).output().unwrap();
        String::from_utf8(output.stdout).unwrap().trim().parse::<i64>().unwrap()
    };
    let late = |offset: &str| {
        clock.set(offset);
        seconds(&clock.starter()) - seconds(&[])
    };
    for (offset, expected) in [("-1h", -3600), ("+1h", 3600), ("+0", 0)] {
        assert!((late(offset) - expected).abs() < 60, "the package libfaketime is needed");
    }
}

/// The clock of a host jumps for all its processes. `disturb` is called after each jump.
fn jumping(small: &Small, disturb: impl Fn(&Path, u64)) -> tempfile::TempDir {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    small.write(here);
    let clock = Clock::new(here, "+0");
    let mut command = through(&clock.starter(), here);
    let said = here.join("said");
    let mut run = started(command.args(["run", "campaign.toml", "--directory", "."]), &said);
    wait_until("the campaign advances", || Counters::read(".", here).labels > 0);
    let mut before = Counters::read(".", here);
    for jump in 0.. {
        clock.set(["+1h", "-1h", "+0", "-1h", "+1h"][jump as usize % 5]);
        disturb(here, jump);
        sleep(Duration::from_millis(200 + random(jump) % 1000));
        let after = Counters::read(".", here);
        assert!(after.has_not_decreased_since(&before), "{before:?} {after:?}");
        before = after;
        if let Some(ended) = run.0.try_wait().unwrap() {
            assert_eq!(ended.code(), Some(0), "{}", fs::read_to_string(&said).unwrap());
            break;
        }
    }
    assert_eq!(outcome(here), uninterrupted_outcome(small));
    assert_no_leftovers(here);
    directory
}

#[test]
fn a_clock_that_jumps_changes_nothing_and_restarts_no_process() {
    let small = Small { steps: 1600, max_per_walk: 16, ..Small::default() };
    let directory = jumping(&small, |here, _| {
        let status = calmwalk(here, ["status", ".", "--json"]);
        let status: Value = serde_json::from_slice(&status.stdout).unwrap();
        for process in status["processes"].as_array().unwrap() {
            // The record of a stopped process is removed shortly after its exit.
            let state = process["state"].as_str().unwrap();
            assert!(["running", "stopping", "dead"].contains(&state), "{process}");
            assert_eq!(process["restarts"], 0, "{process}");
        }
    });
    let said = fs::read_to_string(directory.path().join("said")).unwrap();
    assert!(!said.contains("unresponsive") && !said.contains("restart"), "{said}");
}

/// The leases of a killed labeller return to the queue, whatever its clock showed.
#[test]
fn labellers_that_are_killed_while_the_clock_jumps_lose_and_duplicate_nothing() {
    let small = Small { steps: 1600, max_per_walk: 16, ..Small::default() };
    let killed = Cell::new(0);
    jumping(&small, |here, jump| {
        // One more kill would reach the limit of restarts.
        if jump % 2 == 0
            && killed.get() < 5
            && let Some(labeller) = processes_running(here, "labeller").first()
        {
            signal(*labeller, "KILL");
            killed.set(killed.get() + 1);
        }
    });
}

/// One agent's clock is an hour ahead, the other's an hour behind, and both jump.
#[test]
fn agents_whose_clocks_are_wrong_take_part_as_others_do() {
    let small = Small {
        steps: 1600,
        max_per_walk: 12,
        walks_per_round: 3,
        seed_structures: &["fcc-100", "vacancy", "fcc-097"],
        ..Small::default()
    };
    let mut hosts = Hosts::new(&small, 2, "agent_heartbeat_timeout = \"1m\"");
    let clocks = tempfile::tempdir().unwrap();
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause_walkers(hosts.home.path(), 1);
    let mut agents = Vec::new();
    let mut set = Vec::new();
    for (host, offset) in ["+1h", "-1h"].into_iter().enumerate() {
        let directory = clocks.path().join(offset);
        fs::create_dir(&directory).unwrap();
        let clock = Clock::new(&directory, offset);
        hosts.through[1] = clock.starter();
        agents.push(hosts.agent(host));
        set.push(clock);
    }
    for host in 0..2 {
        wait_until("the agent has joined", || hosts.said(host).contains("joined: 1 walker,"));
    }
    held.resume();
    for jump in 0.. {
        set[jump % 2].set(["-1h", "+1h", "+0"][jump % 3]);
        sleep(Duration::from_millis(300));
        if orchestrator.0.try_wait().unwrap().is_some() {
            break;
        }
    }
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    for (host, agent) in agents.iter_mut().enumerate() {
        assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", hosts.said(host));
    }
    assert!(!hosts.orchestrator_stderr().contains("sends no heartbeat"), "{}", hosts.orchestrator_stderr());
    assert_eq!(outcome(hosts.home.path()), uninterrupted_outcome(&small));
    hosts.assert_cleaned_up();
}
