//! The actions of a campaign whose mixture forgets the training data.

use std::fs;
use std::path::Path;

use serde_json::Value as Json;
use store::Location;

use crate::common::campaign::Small;
use crate::common::label_campaign::on_store;
use crate::common::{calmwalk, stderr, succeed};

/// Writes a campaign whose updates replace the covariance by that of the collected structure.
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

    // Running it again unchanged fails again.
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
    let training = &status(here)["training_frames"];
    let growth = check_elements(here, training);
    assert!(text.contains(&format!("component 0 of Al is forgotten most: σ² × {growth:.2}")), "{text}");
    assert!(
        text.contains("\ntraining data of  component  atoms with γ > 1 (%)  mean σ² × start\nAl "),
        "{text}"
    );
    assert_eq!(training["elements"][0]["share_above_one"], training["share_above_one"]);
    // The log has the fields of earlier versions.
    let decisions = on_store(Location::from(&*here.join("campaign")), async |store| {
        store.decisions(1..=i64::MAX).await.unwrap()
    });
    let logged = decisions.iter().filter_map(|decision| decision.detail["forgetting"]["elements"].get(0));
    let without = |element: &Json| element["mean_square_growth"].is_f64() && element["components"].is_null();
    assert!(logged.map(without).reduce(|all, one| all && one).unwrap());
}

/// Checks the forgetting of aluminium, which has one component, in JSON and in the report. Returns the growth of its mean σ².
fn check_elements(here: &Path, training: &Json) -> f64 {
    let [element] = training["elements"].as_array().unwrap().as_slice() else { panic!("{training}") };
    let growth = element["mean_square_growth"].as_f64().unwrap();
    let [component] = element["components"].as_array().unwrap().as_slice() else { panic!("{training}") };
    assert_eq!((&element["element"], &component["component"]), (&"Al".into(), &0.into()));
    assert!((component["mean_square_growth"].as_f64().unwrap() / growth - 1.0).abs() < 1e-12, "{training}");
    succeed(here, ["report", "campaign", "--output", "report"]);
    let table = fs::read_to_string(here.join("report/tables/summary.csv")).unwrap();
    let row = table.lines().find(|line| line.contains("mean σ² of training atoms")).unwrap();
    assert!(row.contains(&format!("Al × {growth:.2} (")), "{row}");
    assert!(row.contains(&format!("component 0 × {growth:.2})")), "{row}");
    let row = |name: &str| -> Vec<String> {
        let text = fs::read_to_string(here.join(format!("report/tables/{name}.csv"))).unwrap();
        let [_, row] = text.lines().collect::<Vec<_>>()[..] else { panic!("{text}") };
        row.split(',').map(str::to_owned).collect()
    };
    let is = |cell: &str, expected: f64| (cell.parse::<f64>().unwrap() / expected - 1.0).abs() < 1e-12;
    let (of_element, of_component) = (row("forgetting"), row("forgetting-components"));
    match element["share_above_one"].as_f64() {
        Some(share) => {
            let shown: f64 = of_element[1].parse().unwrap();
            assert!((shown - 100.0 * share).abs() < 1e-9, "{of_element:?}");
        }
        None => assert_eq!(of_element[1], ""),
    }
    assert!(of_element[0] == "Al" && is(&of_element[2], growth), "{of_element:?}");
    assert!(of_component[..2] == ["Al", "0"] && is(&of_component[2], growth), "{of_component:?}");
    growth
}

#[test]
fn the_covariances_raise_the_alarm_without_training_frames() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, "warn", 0.1);
    let path = here.join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    let limit = "max_mean_square_growth = 1.05\n# training_frames = ";
    fs::write(&path, text.replace("training_frames = ", limit)).unwrap();
    let run = calmwalk(here, ["run", "campaign.toml"]);
    let said = stderr(&run);
    assert_eq!(run.status.code(), Some(0), "{said}");
    let alarm = "ALARM: the mixture forgets its training data: the mean σ² of the training atoms of Al is ";
    assert!(said.contains(alarm) && said.contains("(calm.max_mean_square_growth: 1.05)"), "{said}");
    let training = &status(here)["training_frames"];
    assert_eq!((&training["alarm"], &training["share_above_one"]), (&true.into(), &Json::Null));
    assert_eq!(
        (&training["level_of_share"], &training["level_of_growth"]),
        (&0.0_f64.into(), &training["level"])
    );
    let growth = check_elements(here, training);
    assert!((training["level"].as_f64().unwrap() / (growth / 1.05) - 1.0).abs() < 1e-12, "{training}");
    assert!(training["elements"][0]["share_above_one"].is_null());
}
