//! A campaign on several hosts, simulated on one host: agents are separate processes and connect over TCP.
//!
//! `CALMWALK_KILLS=200 cargo test --test integration hosts::kills` for the long version.

use std::fs;
use std::time::Duration;

use crate::common::campaign::{Small, outcome};
use crate::common::delay_proxy::DelayProxy;
use crate::common::hosts::{Hosts, uninterrupted_outcome};
use crate::common::processes::{pause_walkers, processes_running, signal, wait_until};
use crate::common::{Running, kills, random};

/// The server soon declares a silent agent dead.
fn hosts(small: &Small, others: usize) -> Hosts {
    Hosts::new(small, others, "agent_heartbeat_timeout = \"500ms\"")
}

#[test]
fn a_campaign_on_three_hosts_has_the_same_outcome() {
    let small =
        Small { walks_per_round: 3, seed_structures: &["fcc-100", "vacancy", "fcc-097"], ..Small::default() };
    let hosts = Hosts::new(&small, 2, "");
    // An agent may start before its orchestrator.
    let mut first = hosts.agent(0);
    wait_until("the agent waits", || hosts.said(0).contains("waiting for the orchestrator"));
    let mut orchestrator = hosts.start_orchestrator();
    // The campaign must not end before the second agent joins: the agent would wait for the next run.
    let held = pause_walkers(hosts.home.path(), 1);
    let mut second = hosts.agent(1);
    for host in 0..2 {
        wait_until("the agent has joined", || hosts.said(host).contains("joined: 1 walker,"));
    }
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0));
    assert_eq!((first.0.wait().unwrap().code(), second.0.wait().unwrap().code()), (Some(0), Some(0)));
    for host in 0..2 {
        assert!(hosts.said(host).contains("joined: 1 walker, mixture version "), "{}", hosts.said(host));
    }
    assert_eq!(outcome(hosts.home.path()), uninterrupted_outcome(&small));
    hosts.assert_cleaned_up();
}

#[test]
fn agents_leave_cleanly_and_a_campaign_stops_cleanly() {
    let small = Small::default();
    let hosts = Hosts::new(&small, 2, "");
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause_walkers(hosts.home.path(), 1);
    let mut agents = [hosts.agent(0), hosts.agent(1)];
    let at_work = |host: usize| !processes_running(hosts.others[host].path(), "walker").is_empty();
    wait_until("walkers are running", || at_work(0) && at_work(1));
    signal(agents[0].0.id(), "TERM");
    assert_eq!(agents[0].0.wait().unwrap().code(), Some(130), "{}", hosts.said(0));
    signal(orchestrator.0.id(), "TERM");
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(130));
    assert_eq!(agents[1].0.wait().unwrap().code(), Some(130), "{}", hosts.said(1));
    hosts.assert_cleaned_up();
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause_walkers(hosts.home.path(), 1);
    let joined = hosts.said(0).matches("joined: 1 walker,").count();
    let mut agent = hosts.agent(0);
    wait_until("the agent has joined", || hosts.said(0).matches("joined: 1 walker,").count() > joined);
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0));
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", hosts.said(0));
    assert_eq!(outcome(hosts.home.path()), uninterrupted_outcome(&small));
    hosts.assert_cleaned_up();
}

/// With 100 ms of latency in each direction, an agent with a prefetched assignment works as usual.
#[test]
fn a_slow_connection_changes_nothing() {
    let small =
        Small { walks_per_round: 3, seed_structures: &["fcc-100", "vacancy", "fcc-097"], ..Small::default() };
    let mut hosts = Hosts::new(&small, 1, "agent_heartbeat_timeout = \"30s\"");
    let proxy = DelayProxy::to(hosts.endpoints[0].trim_start_matches("tcp/"), Duration::from_millis(100));
    hosts.endpoints[1] = format!("tcp/{}", proxy.address);
    hosts.options[1] = vec!["--prefetch=1".into()];
    let mut agent = hosts.agent(0);
    let mut orchestrator = hosts.start_orchestrator();
    // On an idle machine, the orchestrator's own walker would finish before the agent has joined.
    let held = pause_walkers(hosts.home.path(), 1);
    wait_until("the agent has joined", || hosts.said(0).contains("joined: 1 walker,"));
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", hosts.said(0));
    assert!(!hosts.orchestrator_stderr().contains("sends no heartbeat"), "{}", hosts.orchestrator_stderr());
    assert!(hosts.said(0).contains("joined: 1 walker,"), "{}", hosts.said(0));
    assert!(
        proxy.bytes_forwarded() > 1_000_000,
        "candidates were sent over the connection: {} bytes",
        proxy.bytes_forwarded()
    );
    assert_eq!(outcome(hosts.home.path()), uninterrupted_outcome(&small));
    hosts.assert_cleaned_up();
}

#[test]
fn what_a_killed_agent_leaves_is_removed_by_the_next() {
    let hosts = hosts(&Small::default(), 1);
    let directories = || {
        let entries = fs::read_dir(hosts.others[0].path()).unwrap().map(|entry| entry.unwrap().path());
        entries.filter(|path| path.is_dir()).collect::<Vec<_>>()
    };
    let waits = || hosts.said(0).matches("waiting for the orchestrator").count();
    let mut killed = hosts.agent(0);
    wait_until("the first waits", || waits() == 1);
    kill(&mut killed);
    let left = directories();
    assert_eq!(left.len(), 1);
    let (mut second, third) = (hosts.agent(0), hosts.agent(0));
    wait_until("two others wait", || waits() == 3);
    assert!(directories().len() == 2 && !directories().contains(&left[0]), "{:?}", directories());
    for agent in [&second, &third] {
        signal(agent.0.id(), "TERM");
    }
    assert_eq!(second.0.wait().unwrap().code(), Some(130), "{}", hosts.said(0));
    hosts.assert_cleaned_up();
}

/// Kills a process and waits for its exit.
fn kill(running: &mut Running) {
    running.0.kill().unwrap();
    running.0.wait().unwrap();
}

/// What an agent has of the orchestrator's settings is that of the orchestrator that runs.
#[test]
fn an_agent_takes_up_the_settings_of_the_next_orchestrator() {
    let small = Small::default();
    let hosts = hosts(&small, 1);
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause_walkers(hosts.home.path(), 1);
    let mut agent = hosts.agent(0);
    wait_until("the agent works", || !processes_running(hosts.others[0].path(), "walker").is_empty());
    kill(&mut orchestrator);
    drop(held);
    let path = hosts.home.path().join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("[run]\n", "[run]\nmax_restarts = 7\n")).unwrap();
    let mut orchestrator = hosts.start_orchestrator();
    // The campaign must not end before the agent is back.
    let held = pause_walkers(hosts.home.path(), 1);
    wait_until("the agent joins again", || {
        let said = hosts.said(0);
        said.contains("other settings now: joining again") && said.matches("joined: 1 walker,").count() == 2
    });
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", hosts.said(0));
    assert_eq!(outcome(hosts.home.path()), uninterrupted_outcome(&small));
    hosts.assert_cleaned_up();
}

/// Kills the orchestrator, an agent, or a walker of an agent, and restarts what was killed.
#[test]
fn kills_on_every_host_change_nothing() {
    let small = Small::default();
    let expected = uninterrupted_outcome(&small);
    let (mut done, mut campaigns) = (0, 0);
    while done < kills() {
        campaigns += 1;
        let hosts = hosts(&small, 2);
        let mut orchestrator = hosts.start_orchestrator();
        let mut agents = [hosts.agent(0), hosts.agent(1)];
        let ended = loop {
            // Use other times in each campaign: otherwise a campaign that ends before its first kill would repeat endlessly.
            std::thread::sleep(Duration::from_millis(random(done + 10_000 * campaigns) % 1500));
            match orchestrator.0.try_wait().unwrap() {
                Some(ended) if ended.code().is_some() => break ended,
                Some(_) => orchestrator = hosts.start_orchestrator(),
                None => {}
            }
            for (host, agent) in agents.iter_mut().enumerate() {
                if let Some(ended) = agent.0.try_wait().unwrap()
                    && ended.code() != Some(0)
                {
                    assert_eq!(ended.code(), None, "{}", hosts.said(host));
                    *agent = hosts.agent(host);
                }
            }
            if done == kills() {
                break orchestrator.0.wait().unwrap();
            }
            let choice = random(9000 + done);
            let host = (choice / 4) as usize % 2;
            match choice % 4 {
                0 => kill(&mut orchestrator),
                1 | 2 => kill(&mut agents[host]),
                _ => {
                    let walkers = processes_running(hosts.others[host].path(), "walker");
                    walkers.into_iter().for_each(|pid| signal(pid, "KILL"));
                }
            }
            done += 1;
        };
        assert_eq!(ended.code(), Some(0), "after {done} kills");
        // An agent that joins after the end waits for the next run of the campaign.
        for (host, agent) in agents.iter_mut().enumerate() {
            signal(agent.0.id(), "TERM");
            let ended = agent.0.wait().unwrap();
            assert!(matches!(ended.code(), Some(0 | 130) | None), "{ended}: {}", hosts.said(host));
        }
        assert_eq!(outcome(hosts.home.path()), expected, "after {done} kills");
    }
}
