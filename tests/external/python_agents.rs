//! Agents that evaluate a model in Python. Needs a Python with numpy, named by `CALMWALK_PYTHON`, and root for unshare(1).

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use super::python_models::{adapter, build, write_campaign};
use crate::common::campaign::{Outcome, outcome};
use crate::common::hosts::{Hosts, run_in_one_process};
use crate::common::processes::{pause_walkers, processes_running, signal, wait_until};

/// An adapter of the user: the simulated one, whose model is another one for each value of a variable.
const ADAPTER: &str = r#"
import dataclasses
import os

from calmwalk.adapters.simulated import Simulated


class Named(Simulated):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.info = dataclasses.replace(self.info, identity="model of " + os.environ["MODEL"])
"#;

/// A campaign whose model and adapter are in `models`, with this further line in `[potential.python]`.
fn write_files(here: &Path, line: &str) {
    write_campaign(here, &adapter("radial", ""));
    build(here);
    let models = here.join("models");
    fs::create_dir(&models).unwrap();
    fs::write(models.join("named.py"), ADAPTER).unwrap();
    let radial = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/tests/data/radial-al.json");
    fs::copy(&radial, models.join("al.json")).unwrap();
    write_environment(here, "a");
    write_campaign(here, &format!("environment = \"python-a\"\nadapter = \"models/named.py:Named\"\n{line}"));
    let path = here.join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    let text =
        text.replace(&format!("{radial:?}"), "\"models/al.json\"").replace("walkers = 2", "walkers = 1");
    fs::write(path, text).unwrap();
}

/// A Python with the model of this name, which does not start while there is a file `broken`.
fn write_environment(here: &Path, name: &str) {
    let python = std::env::var("CALMWALK_PYTHON").expect("CALMWALK_PYTHON names a Python with numpy");
    let (program, broken) = (here.join(format!("python-{name}")), here.join("broken"));
    let script = format!("#!/bin/sh\n[ -e {broken:?} ] && exit 3\nMODEL={name} exec {python:?} \"$@\"\n");
    fs::write(&program, script).unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
}

/// The campaign with one agent, and its outcome in one process.
fn hosts(line: &str) -> (Hosts, Outcome) {
    let home = tempfile::tempdir().unwrap();
    write_files(home.path(), line);
    let (expected, _) = run_in_one_process(|directory| write_files(directory, line));
    (Hosts::at(home, 1), expected)
}

/// The agent's host has neither the model's file nor the adapter's, another environment and another device.
#[test]
fn an_agent_evaluates_a_model_in_python() {
    let (mut hosts, expected) = hosts("");
    let models = hosts.home.path().join("models");
    let elsewhere = ["unshare", "--mount", "sh", "-c", "mount -t tmpfs none \"$0\" && exec \"$@\""];
    hosts.through[1] =
        elsewhere.map(str::to_owned).into_iter().chain([models.display().to_string()]).collect();
    let environment = hosts.others[0].path().join("python-a");
    write_environment(hosts.others[0].path(), "a");
    hosts.options[1] =
        vec![format!("--python-environment={}", environment.display()), "--device=simulated:1".to_owned()];
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause_walkers(hosts.home.path(), 1);
    let mut agent = hosts.agent(0);
    let works = || !processes_running(hosts.others[0].path(), "walker").is_empty();
    wait_until("the agent's walker runs", works);
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", hosts.said(0));
    let said = hosts.said(0);
    for file in ["models/al.json", "models/named.py"] {
        assert!(said.contains(&format!("{file} of the orchestrator is not on this host")), "{said}");
    }
    assert!(said.contains("on simulated:1: the orchestrator's model"), "{said}");
    assert!(outcome(hosts.home.path()) == expected, "another outcome");
    fs::remove_file(environment).unwrap();
    hosts.assert_cleaned_up();
}

/// Another model is refused with both hashes, and the campaign goes on without the agent.
#[test]
fn an_agent_with_another_model_is_refused() {
    let (mut hosts, expected) = hosts("");
    write_environment(hosts.home.path(), "b");
    let environment = hosts.home.path().join("python-b");
    hosts.options[1] = vec![format!("--python-environment={}", environment.display())];
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause_walkers(hosts.home.path(), 1);
    let mut agent = hosts.agent(0);
    assert_eq!(agent.0.wait().unwrap().code(), Some(2), "{}", hosts.said(0));
    let said = hosts.said(0);
    assert!(said.contains("hash model of b, expected model of a") && said.contains("python-b"), "{said}");
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    assert!(hosts.orchestrator_stderr().contains("left"), "{}", hosts.orchestrator_stderr());
    assert!(outcome(hosts.home.path()) == expected, "another outcome");
    hosts.assert_cleaned_up();
}

/// A program that fails for good ends the agent with the reason, and its walk goes on elsewhere.
#[test]
fn an_agent_whose_program_fails_returns_its_assignments() {
    let count = tempfile::NamedTempFile::new().unwrap();
    let (hosts, expected) = hosts(&format!("options = {{ count = {:?} }}", count.path()));
    let calls = || fs::read_to_string(count.path()).unwrap().lines().count();
    let mut orchestrator = hosts.start_orchestrator();
    let held = pause_walkers(hosts.home.path(), 1);
    let mut agent = hosts.agent(0);
    wait_until("the agent's walker runs", || !processes_running(hosts.others[0].path(), "walker").is_empty());
    let begun = calls();
    wait_until("its program works", || calls() > begun + 20);
    fs::write(hosts.home.path().join("broken"), "").unwrap();
    let servers =
        Command::new("pgrep").args(["-P", &agent.0.id().to_string(), "-f", "calmwalk.server"]).output();
    let servers = String::from_utf8(servers.unwrap().stdout).unwrap();
    servers.lines().for_each(|pid| signal(pid.parse().unwrap(), "KILL"));
    assert_eq!(agent.0.wait().unwrap().code(), Some(1), "{}", hosts.said(0));
    let said = hosts.said(0);
    assert!(said.contains("failed three times in a row") && said.contains("exit status: 3"), "{said}");
    assert!(said.contains("went back to the orchestrator"), "{said}");
    fs::remove_file(hosts.home.path().join("broken")).unwrap();
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    assert!(outcome(hosts.home.path()) == expected, "another outcome");
    hosts.assert_cleaned_up();
}
