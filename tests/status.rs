//! `calmwalk status` of a running campaign, of a killed one, and of a copy.

use std::fs;
use std::process::Stdio;
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::Value;

use crate::common::campaign::Small;
use crate::common::processes::wait_until;
use crate::common::{Running, program, refuse, succeed};

/// Two walks that collect nothing and run for a long time.
fn endless() -> String {
    let text = Small { steps: 1_000_000, ..Small::default() }.text();
    text.replace("threshold = 1.0", "threshold = 1e6")
}

#[test]
fn walks_are_seen_to_advance_and_a_copy_says_the_same() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    fs::write(Small::default().write(here), endless()).unwrap();
    let status =
        |of: &str| -> Value { serde_json::from_str(&succeed(here, ["status", of, "--json"])).unwrap() };
    let run =
        program(here).args(["run", "campaign.toml"]).stderr(Stdio::null()).stdout(Stdio::null()).spawn();
    let run = Running(run.unwrap());
    wait_until("there is a campaign", || here.join("campaign/campaign.sqlite").exists());
    let mut seen = Value::Null;
    wait_until("both walks advance", || {
        seen = status("campaign");
        let walks = seen["walks"].as_array().unwrap();
        walks.len() == 2 && walks.iter().all(|walk| walk["steps_per_second"].as_f64() > Some(0.0))
    });
    wait_until("the expected end is known", || {
        seen = status("campaign");
        seen["expected_end"]["time"].is_i64()
    });
    let all = seen["steps_per_second"].as_f64().unwrap();
    let left: f64 = seen["walks"]
        .as_array()
        .unwrap()
        .iter()
        .map(|walk| 1e6 + 20.0 - walk["step"].as_f64().unwrap())
        .sum();
    let hours = seen["expected_end"]["walks_hours"].as_f64().unwrap();
    assert!((hours - left / all / 3600.0).abs() < 1e-6 * hours, "{seen}");
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as f64;
    let end = seen["expected_end"]["time"].as_f64().unwrap();
    assert!((end - now - 3.6e6 * hours).abs() < 60_000.0, "{end} {now}");
    for walk in seen["walks"].as_array().unwrap() {
        assert!(walk["temperature"].as_f64() > Some(1.0) && walk["gamma_max"].as_f64() > Some(0.0), "{walk}");
    }
    let shown = succeed(here, ["status", "campaign"]);
    assert!(shown.contains(" steps/s") && shown.contains("expected within "), "{shown}");
    let one = succeed(here, ["status", "campaign", "--walks", "1"]);
    assert!(one.contains("… and 1 more walks") && one.contains("orchestrator"), "{one}");

    succeed(here, ["walks", "campaign", "pause", "0"]);
    let paused = status("campaign");
    assert_eq!(
        (&paused["walks"][0]["paused"], &paused["walks"][0]["steps_per_second"]),
        (&true.into(), &Value::Null)
    );
    assert_eq!(paused["run_active"], true);
    assert!(paused["disk"]["at_the_end"].as_u64() >= paused["disk"]["bytes"].as_u64(), "{paused}");

    drop(run);
    let killed = status("campaign");
    assert_eq!((&killed["expected_end"]["time"], &killed["finished"]), (&Value::Null, &false.into()));
    assert_eq!((&killed["run_active"], &killed["steps_per_second"]), (&false.into(), &Value::Null));
    assert!(
        killed["walks"].as_array().unwrap().iter().all(|walk| walk["steps_per_second"].is_null()),
        "{killed}"
    );
    let shown = succeed(here, ["status", "campaign"]);
    assert!(shown.contains("walks       2 unfinished\n") && !shown.contains(" steps/s\n"), "{shown}");
    assert!(shown.contains(" stopped ") && shown.contains(" paused "), "{shown}");
    succeed(here, ["store", "backup", "campaign", "copy"]);
    let copy = status("copy");
    for key in ["version", "campaign", "candidates", "labels", "mixture_version", "budget", "imported"] {
        assert_eq!(copy[key], killed[key], "{key}");
    }
    let refused = refuse(here, ["watch", "copy"]);
    assert!(refused.contains("standard output is not a terminal"), "{refused}");
    assert!(copy["version"] == 1 && copy["walks"].as_array().unwrap().len() == 2);
}
