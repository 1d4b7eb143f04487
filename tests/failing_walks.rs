//! A campaign whose walks all diverge fails: it reports, counts and notifies the causes, and exits with code 1.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use serde_json::Value;

use crate::common;
use crate::common::campaign::Small;
use crate::common::{calmwalk, stderr, succeed};

const SEED_STRUCTURES: &[&str] = &["fcc-100", "vacancy", "fcc-097", "fcc-103"];

/// Writes a campaign in which all walks soon exceed the maximum temperature, or none.
fn write(here: &Path, all_fail: bool) {
    let small = Small { steps: 40, seed_structures: SEED_STRUCTURES, walks_per_round: 4, ..Small::default() };
    let path = small.write(here);
    let mut text = small.text();
    if all_fail {
        // The energy of a displaced atom heats the cell above this limit.
        text = text.replace("temperature = 700.0", "temperature = 1.0");
        text = text.replace("[guard]", "[guard]\nmax_temperature = 2.0");
        let mut frames = atoms::read_extxyz(&here.join("seeds.extxyz")).unwrap();
        frames.iter_mut().for_each(|frame| frame.structure.positions[0][0] += 0.3);
        common::write_frames(&here.join("seeds.extxyz"), &frames);
    }
    let script = here.join("tell.sh");
    fs::write(
        &script,
        format!("#!/bin/sh\necho \"$CALMWALK_EVENT $CALMWALK_MESSAGE\" >> '{}/events'\n", here.display()),
    )
    .unwrap();
    fs::set_permissions(&script, fs::Permissions::from_mode(0o755)).unwrap();
    fs::write(path, format!("{text}\n[notify]\ncommand = [\"./tell.sh\"]\n")).unwrap();
}

#[test]
fn a_campaign_whose_walks_all_diverge_has_failed() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, true);
    let output = calmwalk(here, ["run", "campaign.toml"]);
    let (summary, said) = (String::from_utf8_lossy(&output.stdout), stderr(&output));
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(summary.contains("ended: 4 diverged (too hot)"), "{summary}");
    assert!(
        summary.contains("4 too hot, such as walk ") && summary.contains(" is above the allowed 2 K"),
        "{summary}"
    );
    assert!(summary.contains("what to change: a smaller walk.time_step"), "{summary}");
    // The warning counts three or four walks, which may end together.
    assert!(said.contains("WARNING: ") && said.contains(" finished walks ended early ("), "{said}");
    assert!(said.contains("the campaign has failed: 4 of 4 finished walks"), "{said}");

    let shown = succeed(here, ["status", "campaign"]);
    assert!(shown.contains("4 ended (4 diverged)") && shown.contains("too hot: try a smaller"), "{shown}");
    let all = succeed(here, ["status", "campaign", "--all"]);
    assert!(all.contains("4 too hot, such as walk ") && all.contains("what to change: "), "{all}");
    let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    let ends = status["ends"].as_array().unwrap();
    assert_eq!((ends.len(), &ends[0]["end"], &ends[0]["cause"]), (1, &"diverged".into(), &"too_hot".into()));
    assert_eq!(ends[0]["walks"], 4);

    // Running the same command again fails again, and sends no second notification.
    assert_eq!(calmwalk(here, ["run", "campaign.toml"]).status.code(), Some(1));
    let events = fs::read_to_string(here.join("events")).unwrap();
    let told: Vec<_> = events.lines().filter(|line| line.starts_with("failing_walks ")).collect();
    assert!(told.len() == 1 && told[0].contains("finished walks ended early"), "{events}");
}

#[test]
fn walks_that_find_nothing_are_a_result() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, false);
    let path = here.join("campaign.toml");
    fs::write(&path, fs::read_to_string(&path).unwrap().replace("threshold = 1.0", "threshold = 1e6"))
        .unwrap();
    let summary = succeed(here, ["run", "campaign.toml"]);
    assert!(summary.contains("ended: 4 completed\n") && !summary.contains("what to change"), "{summary}");
    let events = fs::read_to_string(here.join("events")).unwrap();
    assert!(!events.contains("failing_walks"), "{events}");
}
