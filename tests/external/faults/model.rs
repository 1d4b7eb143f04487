//! An agent whose host does not have the orchestrator's model downloads it. The orchestrator is killed during the download.

use std::fs;
use std::time::Duration;

use crate::common::campaign::{Small, outcome};
use crate::common::config;
use crate::common::delay_proxy::DelayProxy;
use crate::common::hosts::{Hosts, uninterrupted_outcome};
use crate::common::processes::{pause_walkers, processes_running, signal, wait_until};

/// Long enough to kill the orchestrator while a request is in transit.
const DELAY: Duration = Duration::from_millis(500);

#[test]
fn an_orchestrator_is_killed_while_its_model_is_fetched() {
    let small = Small::default();
    let mut hosts = Hosts::new(&small, 1, "agent_heartbeat_timeout = \"30s\"");
    // The agent's host has an empty file system in place of the model's directory.
    let models = hosts.home.path().join("models");
    fs::create_dir(&models).unwrap();
    let (path, model) = (hosts.home.path().join("campaign.toml"), config("data/al_eam_1l/kokkos.npz"));
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(model.to_str().unwrap()));
    fs::copy(&model, models.join("kokkos.npz")).unwrap();
    fs::write(&path, text.replace(model.to_str().unwrap(), "models/kokkos.npz")).unwrap();
    let elsewhere = ["unshare", "--mount", "sh", "-c", "mount -t tmpfs none \"$0\" && exec \"$@\""];
    hosts.through[1] =
        elsewhere.map(str::to_owned).into_iter().chain([models.display().to_string()]).collect();
    let proxy = DelayProxy::to(hosts.endpoints[0].trim_start_matches("tcp/"), DELAY);
    hosts.endpoints[1] = format!("tcp/{}", proxy.address);

    // Keep work for the agent until it has joined, and joined again.
    let pause = || pause_walkers(hosts.home.path(), 1);
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause();
    let mut agent = hosts.agent(0);
    wait_until("the agent asks for the model", || hosts.said(0).contains("downloading the model"));
    signal(orchestrator.0.id(), "KILL");
    orchestrator.0.wait().unwrap();
    wait_until("its walker has exited", || processes_running(hosts.home.path(), "walker").is_empty());
    drop(held);
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause();
    wait_until("the agent has joined it", || hosts.said(0).contains("joined: 1 walker,"));
    held.resume();
    assert!(hosts.said(0).contains("joining again"), "{}", hosts.said(0));
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", hosts.said(0));
    assert_eq!(outcome(hosts.home.path()), uninterrupted_outcome(&small));
    hosts.assert_cleaned_up();
}
