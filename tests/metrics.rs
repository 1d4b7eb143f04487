//! `/metrics` of a campaign that runs: its format, its numbers, and that docs/metrics.md lists what is there.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::process::Stdio;

use common::campaign::Small;
use common::http::{Answer, get, request, said};
use common::processes::wait_until;
use common::{Running, program, refuse, succeed};
use serde_json::Value;

/// A metric: its type, and its samples by labels as they are written.
type Metrics = BTreeMap<String, (String, BTreeMap<String, f64>)>;

/// Reads the text format, strictly: HELP, TYPE, then the samples of that name.
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

#[test]
fn a_live_campaign_is_scraped_and_agrees_with_its_status() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = Small::default().write(here);
    let text = fs::read_to_string(&path).unwrap();
    // All is collected, and then it waits for labels from elsewhere.
    fs::write(&path, text.replace("[label]", "[label]\nslots = 0")).unwrap();
    let arguments = ["run", "campaign.toml", "--metrics", "127.0.0.1:0"];
    let run = program(here).args(arguments).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let mut run = Running(run);
    let [address] = said(&mut run.0, ["metrics at http://"]);
    let address = address.trim_end_matches("/metrics");
    let status =
        || -> Value { serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap() };
    wait_until("all is collected", || {
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
    let documented = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/metrics.md")).unwrap();
    for (name, (kind, _)) in &metrics {
        assert!(documented.contains(&format!("| `{name}` | {kind} |")), "{name}");
    }
    assert_eq!(get(address, "/").status, 404);
    let rebound = request(address, "GET", "/metrics", &[("Host", "rebound.example")], "");
    assert!(rebound.status == 403 && !rebound.body.contains("calmwalk_"), "{rebound:?}");
    let other = refuse(here, ["run", "campaign.toml", "--directory", "other", "--metrics", address]);
    assert!(other.contains("cannot listen on"), "{other}");
    let open = refuse(here, ["run", "campaign.toml", "--directory", "other", "--metrics", "0.0.0.0:0"]);
    assert!(open.contains("ssh -L"), "{open}");
    assert!(!here.join("other/campaign.sqlite").exists());
}
