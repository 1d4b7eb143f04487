//! Guards refuse structures before any cost arises; the cost estimate before a campaign starts.

use std::fs;
use std::path::Path;

use atoms::NeighbourList;
use atoms::extxyz::Frame;
use serde_json::Value as Json;

use crate::common::campaign::{Small, outcome};
use crate::common::{calmwalk, refuse, stderr, succeed};

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Json {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

/// A small campaign with these keys in `[label]`.
fn write(here: &Path, keys: &str) {
    let config = Small { seed_structures: &["fcc-100"], max_per_walk: 2, ..Small::default() }.write(here);
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("[label]", &format!("[label]\n{keys}"))).unwrap();
}

fn names(jobs: &Json, state: &str) -> Vec<String> {
    let jobs = jobs.as_array().unwrap().iter().filter(|job| job["state"] == state);
    jobs.map(|job| job["candidate"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn structures_that_a_guard_refuses_are_labelled_on_request() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, r#"guard = { min_bond_lengths = { "Al-Al" = 3.5 } }"#);
    let summary = succeed(here, ["run", "campaign.toml"]);
    let refused = names(&json(here, ["queue", "campaign", "list"]), "failed");
    assert!(refused.len() > 1 && summary.contains("structures failed"), "{summary}");
    let details = json(here, ["queue", "campaign", "show", &refused[0]]);
    let attempt = &details["attempts_made"][0];
    assert_eq!(attempt["class"], "rejected_by_label_guard");
    let log = attempt["log"].as_str().unwrap();
    assert!(log.contains("Å apart, where label.guard.min_bond_lengths of Al-Al is 3.5"), "{log}");
    let status = json(here, ["status", "campaign"]);
    assert_eq!(status["failures"][0]["class"], "rejected_by_label_guard");
    assert_eq!(status["failures"][0]["failed"], refused.len());

    // After `queue retry`, the same labellers label one structure; the others stay refused.
    succeed(here, ["queue", "campaign", "retry", &refused[0]]);
    succeed(here, ["run", "campaign.toml"]);
    let jobs = json(here, ["queue", "campaign", "list"]);
    assert_eq!(names(&jobs, "labelled"), refused[..1]);
    assert_eq!(names(&jobs, "failed").len(), refused.len() - 1);
}

#[test]
fn near_duplicates_of_labelled_structures_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    // Structures from the same seed structure are closer than this tolerance.
    write(here, "guard = { duplicate_tolerance = 1.0 }");
    succeed(here, ["run", "campaign.toml"]);
    let jobs = json(here, ["queue", "campaign", "list"]);
    let (labelled, refused) = (names(&jobs, "labelled"), names(&jobs, "failed"));
    assert!(!labelled.is_empty() && !refused.is_empty(), "{jobs}");
    let details = json(here, ["queue", "campaign", "show", &refused[0]]);
    let log = details["attempts_made"][0]["log"].as_str().unwrap();
    assert!(labelled.iter().any(|name| log.contains(name.as_str())), "{log}");
}

/// The guard of biased walks does not limit the distances in control frames.
#[test]
fn control_frames_with_atoms_too_close_are_left_out() {
    const LIMIT: f64 = 2.55;
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let config = Small::default().write(here);
    let text = fs::read_to_string(&config).unwrap();
    let pairs = format!("min_distances = {{ rule = \"per_pair\", pairs = {{ \"Al-Al\" = {LIMIT} }} }}");
    fs::write(&config, text.replace("[guard]", &format!("[guard]\n{pairs}"))).unwrap();
    let mut outcomes = Vec::new();
    for (name, walkers) in [("one", "1"), ("two", "2")] {
        let text = fs::read_to_string(&config).unwrap();
        fs::write(&config, text.replace("walkers = 2", &format!("walkers = {walkers}"))).unwrap();
        let output = calmwalk(here, ["run", "campaign.toml", "--directory", name]);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(0), "{said}");
        assert!(
            said.contains("Al-Al atoms at ") && said.contains("closer than the limit of 2.550 Å"),
            "{said}"
        );
        outcomes.push(outcome(&here.join(name)));
    }
    assert!(outcomes[0] == outcomes[1]);
    let status = json(here, ["status", "one"]);
    let count = |what: &str| status["candidates"][what].as_u64().unwrap();
    let (accepted, control, left_out) = (count("accepted"), count("control"), count("left_out"));
    assert!(control > 0 && left_out > 0 && control + left_out <= accepted, "{status}");
    let told = succeed(here, ["status", "one"]);
    assert!(told.contains(&format!("{left_out} left out (the decision log has the reasons)")), "{told}");
    // These frames were not labelled.
    succeed(here, ["export", "one", "--control", "--output", "all.extxyz"]);
    let frames = atoms::read_extxyz(&here.join("all.extxyz")).unwrap();
    let shortest = |frame: &Frame| {
        let mut neighbours = NeighbourList::new(5.0, 0.0);
        neighbours.update(&frame.structure).unwrap();
        atoms::shortest_distance(&frame.structure, &neighbours).unwrap().2
    };
    let shortest = frames.iter().map(shortest).min_by(f64::total_cmp);
    assert!(shortest >= Some(LIMIT), "{shortest:?} Å");
    let replayed = json(here, ["replay", "one"]);
    assert_eq!(
        (&replayed["difference"], &replayed["same_mixture"]),
        (&Json::Null, &true.into()),
        "{replayed}"
    );
    succeed(here, ["report", "one", "--output", "report"]);
    let page = fs::read_to_string(here.join("report/report.html")).unwrap();
    assert!(page.contains("control frames with atoms too close"));
}

/// The limit is near the distance of neighbours in the crystal, so that the guard refuses nearly every structure.
#[test]
fn walks_without_rollbacks_go_on_after_refusals() {
    let keys = "max_consecutive_rejections = 2\nmax_rollbacks = 1\n\
                min_distances = { rule = \"per_pair\", pairs = { \"Al-Al\" = 2.8 } }";
    for rollback in [true, false] {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        let config =
            Small { seed_structures: &["fcc-100"], max_per_walk: 100, ..Small::default() }.write(here);
        let text = fs::read_to_string(&config).unwrap();
        let text = text.replace("[campaign]", "[campaign]\ncontrol = false");
        fs::write(&config, text.replace("[guard]", &format!("[guard]\nrollback = {rollback}\n{keys}")))
            .unwrap();
        // The walk is trapped after its last rollback. A campaign without a whole walk fails.
        let code = calmwalk(here, ["run", "campaign.toml"]).status.code();
        assert_eq!(code, Some(i32::from(rollback)));
        let status = json(here, ["status", "campaign"]);
        let walk = &status["walks"][0];
        let number = |what: &str| walk[what].as_u64().unwrap();
        assert_eq!(status["candidates"]["rejected_by_guards"], walk["rejected"]);
        if rollback {
            assert_eq!(
                (&walk["state"], number("rollbacks"), number("segment")),
                (&"trapped".into(), 1, 1),
                "{walk}"
            );
            continue;
        }
        assert!(number("rejected") > 2, "{walk}");
        assert_eq!((number("rollbacks"), number("segment"), number("step")), (0, 0, 260), "{walk}");
        assert_eq!(walk["state"], "completed", "{walk}");
        assert!(succeed(here, ["replay", "campaign"]).contains("all reproduced bit by bit"));
    }
}

#[test]
fn impossible_guards_are_wrong_input() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for (guard, said) in [
        ("{ min_angle = 120.0 }", "label.guard.min_angle"),
        (r#"{ min_bond_lengths = { "Xx-Al" = 1.0 } }"#, "'Xx-Al' is not a pair of elements"),
        ("{ smallest_volume = 1.0 }", "smallest_volume"),
    ] {
        write(here, &format!("guard = {guard}"));
        let error = refuse(here, ["validate", "campaign.toml"]);
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn a_campaign_has_a_bill_before_it_begins() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    // Two seed structures with four structures each, and a control frame for each of those.
    let plan = json(here, ["estimate", "campaign.toml"]);
    assert_eq!((&plan["labels"], &plan["core_hours"]), (&16.into(), &Json::Null));
    assert!(succeed(here, ["estimate", "campaign.toml"]).contains("cost unknown"));
    let walks = |of: &Json| ["biased", "control"].map(|kind| of["walk_hours"][kind].as_f64().unwrap());
    let (all, seeds) = (walks(&plan), [0, 1].map(|k| walks(&plan["seed_structures"][k])));
    assert!(all.iter().all(|hours| *hours > 0.0), "{plan}");
    for (k, sum) in all.into_iter().enumerate() {
        assert!((sum / (seeds[0][k] + seeds[1][k]) - 1.0).abs() < 1e-9, "{plan}");
    }
    let priced = json(here, ["estimate", "campaign.toml", "--core-seconds", "3600"]);
    let hours = |plan: &Json| plan["core_hours"]["expected"].as_f64().unwrap();
    let first = priced["seed_structures"][0]["core_hours_each"]["expected"].as_f64().unwrap();
    // One hour, times the ratio of mean and median of the predicted cost.
    assert!((0.9..1.2).contains(&first), "{priced}");
    // The second cell has 47 atoms instead of 32: (47/32)² times the cost by the prior exponent.
    let expected = 8.0 * first * (1.0 + (47.0_f64 / 32.0).powi(2));
    assert!((hours(&priced) / expected - 1.0).abs() < 1e-9, "{priced}");
    // A limit on structures also limits the cost.
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    fs::write(
        here.join("less.toml"),
        text.replace("max_per_walk = 4", "max_per_walk = 4\nmax_structures = 2"),
    )
    .unwrap();
    let less = json(here, ["estimate", "less.toml", "--core-seconds", "3600"]);
    assert_eq!((&less["labels"], &less["limited_by"]), (&4.into(), &"collect.max_structures".into()));
    assert!((hours(&less) / hours(&priced) - 0.25).abs() < 1e-9);

    assert!(refuse(here, ["estimate", "campaign.toml", "--cost-from", "less"]).contains("less"));
    succeed(here, ["run", "less.toml"]);
    let like = json(here, ["estimate", "campaign.toml", "--cost-from", "less"]);
    assert!(hours(&like) > 0.0 && hours(&like) < 1.0, "{like}");
}

#[test]
fn a_wall_needs_a_cluster() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let text = Small::default().text().replace("[guard]\n", "[guard]\nwall = {}\n");
    assert!(text.contains("wall"));
    fs::write(Small::default().write(here), &text).unwrap();
    let said = refuse(here, ["validate", "campaign.toml"]);
    assert!(said.contains("guard.wall") && said.contains("every seed structure is periodic"), "{said}");
    fs::write(here.join("campaign.toml"), text.replace("wall = {}", "wall = { margin = 0.0 }")).unwrap();
    let said = refuse(here, ["validate", "campaign.toml"]);
    assert!(said.contains("guard.wall.margin: found 0"), "{said}");
}
