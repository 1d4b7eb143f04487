//! Orchestrator, agents, walkers and labellers are killed at random instants.

use std::thread::sleep;
use std::time::Duration;

use super::server::Campaign;
use crate::common::campaign::{Outcome, Small};
use crate::common::hosts::uninterrupted_outcome;
use crate::common::processes::{processes_running, signal};
use crate::common::{Running, kills, random};

/// A campaign with two agents, whose processes are killed and restarted.
struct Killed {
    campaign: Campaign,
    orchestrator: Running,
    agents: [Running; 2],
}

impl Killed {
    fn new(small: &Small, name: &str) -> Self {
        let campaign = Campaign::new(small, name, 2, "agent_heartbeat_timeout = \"500ms\"");
        let orchestrator = campaign.hosts.start_orchestrator();
        let agents = [campaign.hosts.agent(0), campaign.hosts.agent(1)];
        Self { campaign, orchestrator, agents }
    }

    /// Kills one process; the orchestrator if there is no process of the chosen kind.
    fn kill(&self, choice: u64) {
        let which = |mut pids: Vec<u32>| match pids.len() {
            0 => self.orchestrator.0.id(),
            n => pids.swap_remove((choice / 8) as usize % n),
        };
        let host = (choice / 64) as usize % 2;
        let home = self.campaign.home();
        signal(
            match choice % 8 {
                0 | 1 => self.orchestrator.0.id(),
                2 | 3 => self.agents[host].0.id(),
                4 => which(processes_running(self.campaign.hosts.others[host].path(), "walker")),
                5 => which(processes_running(home, "walker")),
                _ => which(processes_running(home, "labeller")),
            },
            "KILL",
        );
    }

    /// Restarts the processes that were killed. Returns whether the campaign has ended.
    fn start_again(&mut self) -> bool {
        match self.orchestrator.0.try_wait().unwrap().map(|ended| ended.code()) {
            Some(Some(code)) => {
                assert_eq!(code, 0, "{}", self.campaign.hosts.orchestrator_stderr());
                return true;
            }
            Some(None) => self.orchestrator = self.campaign.hosts.start_orchestrator(),
            None => {}
        }
        for (host, agent) in self.agents.iter_mut().enumerate() {
            if let Some(ended) = agent.0.try_wait().unwrap()
                && ended.code() != Some(0)
            {
                assert_eq!(ended.code(), None, "{}", self.campaign.hosts.said(host));
                *agent = self.campaign.hosts.agent(host);
            }
        }
        false
    }

    /// Waits for the end of the campaign and of its agents.
    fn end(mut self) -> Outcome {
        while !self.start_again() {
            sleep(Duration::from_millis(20));
        }
        // An agent that joins after the end waits for the next run of the campaign.
        for (host, agent) in self.agents.iter_mut().enumerate() {
            signal(agent.0.id(), "TERM");
            let ended = agent.0.wait().unwrap();
            assert!(
                matches!(ended.code(), Some(0 | 130) | None),
                "{ended}: {}",
                self.campaign.hosts.said(host)
            );
        }
        self.campaign.outcome()
    }
}

/// Runs campaigns with some kills in each, [`kills`] in total, and passes each outcome to `check`.
fn killed(small: &Small, name: &str, check: impl Fn(&Outcome)) {
    let (mut done, mut campaigns) = (0, 0);
    while done < kills() {
        campaigns += 1;
        let mut killed = Killed::new(small, name);
        while done < kills() {
            // Use other times in each campaign: otherwise a campaign that ends before its first kill would repeat endlessly.
            sleep(Duration::from_millis(random(done + 10_000 * campaigns) % 1500));
            if killed.start_again() {
                break;
            }
            killed.kill(random(9000 + done));
            done += 1;
            // The exit of a killed process is not visible immediately.
            sleep(Duration::from_millis(5));
        }
        check(&killed.end());
    }
}

#[test]
fn kills_change_nothing_in_a_reproducible_campaign() {
    let small = Small::default();
    let expected = uninterrupted_outcome(&small);
    killed(&small, "kills", |outcome| assert_eq!(outcome, &expected));
}

/// The decisions depend on the order of reports; [`Campaign::outcome`] checks that they are consistent.
#[test]
fn kills_lose_and_double_nothing_in_a_live_campaign() {
    killed(&Small { mode: "live", ..Small::default() }, "live", |_| ());
}
