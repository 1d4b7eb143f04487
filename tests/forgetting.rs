//! What a campaign does when its mixture forgets the training data.

use std::fs;
use std::path::Path;

use serde_json::Value as Json;

use crate::common::campaign::Small;
use crate::common::{calmwalk, stderr, succeed};

/// A campaign whose updates replace the covariance by that of the collected structure.
fn write(here: &Path, action: &str, limit: f64) {
    let config = Small::default().write(here);
    let keys =
        format!("[calm]\non_forgetting = \"{action}\"\nforgetting_alarm = {limit}\nalpha_values = [1.0]");
    let text = fs::read_to_string(&config).unwrap().replace("[calm]", &keys);
    fs::write(&config, text).unwrap();
}

fn status(here: &Path) -> Json {
    serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap()
}

#[test]
fn a_campaign_pauses_until_the_limit_is_raised() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, "pause", 0.1);
    let paused = calmwalk(here, ["run", "campaign.toml"]);
    let said = stderr(&paused);
    assert_eq!(paused.status.code(), Some(1), "{said}");
    assert!(said.contains("the campaign is paused: the mixture forgets its training data:"), "{said}");
    let before = status(here);
    assert_eq!((&before["finished"], &before["training_frames"]["alarm"]), (&false.into(), &true.into()));

    // The same again, before anything is done.
    let again = calmwalk(here, ["run", "campaign.toml"]);
    assert_eq!(again.status.code(), Some(1), "{}", stderr(&again));
    assert_eq!(status(here)["candidates"], before["candidates"]);

    write(here, "pause", 1.0);
    succeed(here, ["run", "campaign.toml"]);
    let after = status(here);
    assert_eq!((&after["finished"], &after["training_frames"]["alarm"]), (&true.into(), &false.into()));
    assert!(after["candidates"]["seen"].as_u64() > before["candidates"]["seen"].as_u64());
}

#[test]
fn updates_become_additive_and_a_replay_agrees() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, "additive", 0.1);
    let said = stderr(&calmwalk(here, ["run", "campaign.toml"]));
    assert!(said.contains("Updates are additive from now on (calm.on_forgetting)"), "{said}");
    assert!(succeed(here, ["replay", "campaign"]).contains("all reproduced bit by bit"));
    let text = succeed(here, ["status", "campaign", "--all"]);
    assert!(text.contains("of its training data, Al is forgotten most: σ² × "), "{text}");
}
