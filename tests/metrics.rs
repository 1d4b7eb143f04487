//! `/metrics` of a running campaign and of an agent: format, values, and documentation in docs/metrics.md.

use std::collections::BTreeMap;
use std::fs;
use std::process::Stdio;

use serde_json::Value;

use crate::common::campaign::Small;
use crate::common::hosts::Hosts;
use crate::common::http::{Answer, get, request, said};
use crate::common::processes::{PausedProcesses, signal, wait_for_process, wait_until};
use crate::common::{Running, program, refuse, succeed};

/// Type and samples of each metric; samples by their labels as text.
type Metrics = BTreeMap<String, (String, BTreeMap<String, f64>)>;

/// Parses the text format strictly: HELP, TYPE, then the samples of that name.
fn parse(text: &str) -> Metrics {
    let mut metrics = Metrics::new();
    let (mut helped, mut current) = (String::new(), String::new());
    for line in text.lines() {
        if let Some(rest) = line.strip_prefix("# HELP ") {
            let (name, help) = rest.split_once(' ').unwrap();
            assert!(help.ends_with('.') && !metrics.contains_key(name), "{line}");
            helped = name.to_owned();
        } else if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').unwrap();
            assert!(name == helped && ["counter", "gauge"].contains(&kind), "{line}");
            assert_eq!(kind == "counter", name.ends_with("_total"), "{line}");
            metrics.insert(name.to_owned(), (kind.to_owned(), BTreeMap::new()));
            current = name.to_owned();
        } else {
            let (series, value) = line.rsplit_once(' ').unwrap();
            let (name, labels) = series.split_once('{').unwrap_or((series, "}"));
            assert!(name == current && labels.ends_with('}'), "{line}");
            assert!(
                name.starts_with("calmwalk_") && name.chars().all(|c| c.is_ascii_lowercase() || c == '_')
            );
            let samples = &mut metrics.get_mut(name).unwrap().1;
            assert!(samples.insert(labels.trim_end_matches('}').into(), value.parse().unwrap()).is_none());
        }
    }
    metrics
}

fn are_documented(metrics: &Metrics) {
    let documented = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/metrics.md")).unwrap();
    for (name, (kind, _)) in metrics {
        assert!(documented.contains(&format!("| `{name}` | {kind} |")), "{name}");
    }
}

#[test]
fn a_live_campaign_is_scraped_and_agrees_with_its_status() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = Small::default().write(here);
    let text = fs::read_to_string(&path).unwrap();
    // The campaign collects its structures and then waits for external labels.
    fs::write(&path, text.replace("[label]", "[label]\nconcurrency = 0")).unwrap();
    let arguments = ["run", "campaign.toml", "--metrics", "127.0.0.1:0"];
    let run = program(here).args(arguments).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let mut run = Running(run);
    let [address] = said(&mut run.0, ["metrics at http://"]);
    let address = address.trim_end_matches("/metrics");
    let status =
        || -> Value { serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap() };
    wait_until("all structures are collected", || {
        let status = status();
        let walks = status["walks"].as_array().unwrap();
        let over = |walk: &Value| !["waiting", "running"].contains(&walk["state"].as_str().unwrap());
        walks.len() >= 2 && walks.iter().all(over) && status["labels"]["queued"].as_u64() > Some(0)
    });
    let Answer { status: code, head, body } = get(address, "/metrics");
    assert_eq!(code, 200, "{head}");
    assert!(head.contains("content-type: text/plain; version=0.0.4; charset=utf-8"), "{head}");
    let (metrics, status) = (parse(&body), status());
    let value = |name: &str, labels: &str| metrics[name].1[labels];
    let number = |pointer: &str| status.pointer(pointer).and_then(Value::as_f64).unwrap();
    assert_eq!(value("calmwalk_candidates_total", "fate=\"accepted\""), number("/candidates/accepted"));
    assert_eq!(
        value("calmwalk_candidates_total", "fate=\"covered\""),
        number("/candidates/declined/covered")
    );
    assert_eq!(value("calmwalk_control_frames_total", ""), number("/candidates/control"));
    assert_eq!(value("calmwalk_mixture_version", ""), number("/mixture_version"));
    for state in ["queued", "leased", "labelled", "failed", "dropped", "superseded"] {
        let labels = format!("state=\"{state}\"");
        assert_eq!(value("calmwalk_label_jobs", &labels), number(&format!("/labels/{state}")));
    }
    let walks: f64 = metrics["calmwalk_walks"].1.values().sum();
    assert_eq!(walks as usize, status["walks"].as_array().unwrap().len());
    assert_eq!(value("calmwalk_processes", "kind=\"orchestrator\",state=\"running\""), 1.0);
    are_documented(&metrics);
    assert_eq!(get(address, "/").status, 404);
    let rebound = request(address, "GET", "/metrics", &[("Host", "rebound.example")], "");
    assert!(rebound.status == 403 && !rebound.body.contains("calmwalk_"), "{rebound:?}");
    let other = refuse(here, ["run", "campaign.toml", "--directory", "other", "--metrics", address]);
    assert!(other.contains("cannot listen on"), "{other}");
    let open = refuse(here, ["run", "campaign.toml", "--directory", "other", "--metrics", "0.0.0.0:0"]);
    assert!(open.contains("ssh -L"), "{open}");
    assert!(!here.join("other/campaign.sqlite").exists());
}

#[test]
fn an_agent_is_scraped_before_it_has_joined_and_after_failures() {
    // The campaign does not end without a signal.
    let small = Small { mode: "live", steps: 1_000_000, max_per_walk: 1_000_000, ..Small::default() };
    let mut hosts = Hosts::new(&small, 1, "");
    hosts.options[1] = vec!["--metrics=127.0.0.1:0".into()];
    let mut agent = hosts.agent(0);
    let mut address = String::new();
    wait_until("the agent prints its address", || {
        let said = hosts.said(0);
        let found =
            said.lines().find_map(|line| line.strip_prefix("metrics at http://")?.strip_suffix("/metrics"));
        address = found.unwrap_or_default().to_owned();
        !address.is_empty()
    });
    let scrape = || {
        let Answer { status, head, body } = get(&address, "/metrics");
        assert_eq!(status, 200, "{head}");
        assert!(head.contains("content-type: text/plain; version=0.0.4; charset=utf-8"), "{head}");
        parse(&body)
    };
    let value = |name: &str, labels: &str| {
        let metrics = scrape();
        metrics.get(name).and_then(|(_, samples)| samples.get(labels).copied())
    };
    assert_eq!(value("calmwalk_agent_link_up", ""), Some(0.0));
    assert_eq!(value("calmwalk_agent_assignments_received_total", ""), Some(0.0));
    assert_eq!(value("calmwalk_agent_link_silence_seconds", ""), None, "no orchestrator has answered yet");

    let mut orchestrator = hosts.start_orchestrator();
    let is_above = |name: &str, labels: &str| value(name, labels) > Some(0.0);
    wait_until("the agent delivers candidates", || {
        is_above("calmwalk_agent_assignments_total", "outcome=\"candidate\"")
    });
    wait_until("a question was answered", || is_above("calmwalk_agent_link_round_trip_seconds", ""));
    wait_until("the mixture has moved", || is_above("calmwalk_agent_mixture_version", ""));
    wait_until("its walker is seen", || value("calmwalk_agent_walkers", "state=\"running\"") == Some(1.0));
    let metrics = scrape();
    let number = |name: &str| metrics[name].1[""];
    are_documented(&metrics);
    assert_eq!(number("calmwalk_agent_link_up"), 1.0);
    assert_eq!(number("calmwalk_agent_joins_total"), 1.0);
    let came: f64 = metrics["calmwalk_agent_assignments_total"].1.values().sum();
    let taken = number("calmwalk_agent_assignments_received_total");
    assert!(came > 0.0 && came <= taken && taken <= came + 1.0, "one walker has one assignment: {metrics:?}");
    // An assignment has at most 40 steps.
    let steps = number("calmwalk_agent_steps_total");
    assert!(steps > 0.0 && steps <= 40.0 * taken, "{metrics:?}");

    let walker = wait_for_process(hosts.others[0].path(), "walker");
    signal(walker, "KILL");
    wait_until("the walker is replaced", || {
        value("calmwalk_agent_walker_restarts_total", "") == Some(1.0)
            && value("calmwalk_agent_walkers", "state=\"running\"") == Some(1.0)
    });
    let held = PausedProcesses::new([orchestrator.0.id()]);
    wait_until("the link is down", || value("calmwalk_agent_link_up", "") == Some(0.0));
    assert!(value("calmwalk_agent_link_silence_seconds", "") > Some(1.0));
    held.resume();
    wait_until("the link is up again", || value("calmwalk_agent_link_up", "") == Some(1.0));
    signal(agent.0.id(), "TERM");
    assert_eq!(agent.0.wait().unwrap().code(), Some(130), "{}", hosts.said(0));
    signal(orchestrator.0.id(), "TERM");
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(130), "{}", hosts.orchestrator_stderr());
    let open = refuse(hosts.home.path(), ["agent", "--join", "tcp/127.0.0.1:1", "--metrics", "0.0.0.0:0"]);
    assert!(open.contains("ssh -L"), "{open}");
    hosts.assert_cleaned_up();
}
