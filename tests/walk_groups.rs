//! Groups of walks under several conditions, which share one mixture.

use std::fs;
use std::path::Path;

use atoms::read_extxyz;
use serde_json::{Value as Json, json};

use crate::common::campaign::{Outcome, Small, outcome};
use crate::common::{refuse, succeed};

const GROUPS: &str = r#"
[[walks]]
name = "hot"
temperatures = [500.0, 900.0]
volume_ramps = [{ from = 1.0, to = 1.25 }, { from = 1.0, to = 0.9 }]

[[walks]]
name = "hole"
seed_structures = "seed_structure = vacancy"
temperatures = [600.0]
tau_values = [0.2, 0.4]
repeats = 2
"#;

/// A small campaign with these groups, and with these keys in `[collect]`.
fn write(here: &Path, groups: &str, walkers: usize, keys: &str) {
    let small = Small { walkers, steps: 120, max_per_walk: 2, ..Small::default() };
    let config = small.write(here);
    let text = fs::read_to_string(&config).unwrap().replace("[collect]", &format!("[collect]\n{keys}"));
    fs::write(&config, text + groups).unwrap();
}

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Json {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

fn run(walkers: usize) -> (tempfile::TempDir, Outcome) {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, GROUPS, walkers, "");
    succeed(here, ["run", "campaign.toml"]);
    let outcome = outcome(&here.join("campaign"));
    (directory, outcome)
}

#[test]
fn walks_of_all_groups_share_a_mixture_and_give_the_same_bytes_for_any_number_of_walkers() {
    let ((directory, one), (_other, three)) = (run(1), run(3));
    assert_eq!(one, three);
    let here = directory.path();
    let status = json(here, ["status", "campaign"]);
    let walks: Vec<_> =
        status["walks"].as_array().unwrap().iter().filter(|walk| walk["origin"] == "biased").collect();
    let conditions: Vec<_> = walks
        .iter()
        .map(|walk| {
            let Json::Object(c) = &walk["conditions"] else { panic!("{walk}") };
            (walk["seed_structure"].clone(), c["group"].clone(), c["temperature"].clone(), c["tau"].clone())
        })
        .collect();
    let hot = |seed: &str, t: f64| (json!(seed), json!("hot"), json!(t), json!(0.3));
    let hole = |tau: f64| (json!("vacancy"), json!("hole"), json!(600.0), json!(tau));
    let hots = |seed| [500.0, 500.0, 900.0, 900.0].map(|t| hot(seed, t));
    let expected =
        [hots("fcc-100").to_vec(), hots("vacancy").to_vec(), [0.2, 0.2, 0.4, 0.4].map(hole).to_vec()];
    assert_eq!(conditions, expected.concat());
    assert_eq!(walks[1]["conditions"]["volume_ramp"], json!([1.0, 0.9]));
    // A walk that is compressed ends below the volume of its seed structure.
    let volumes: Vec<_> = walks.iter().map(|walk| walk["relative_volume"].as_f64().unwrap()).collect();
    assert!(volumes[1] < 1.0 && volumes[0] > 1.0, "{volumes:?}");

    let text = succeed(here, ["status", "campaign", "--walks", "50"]);
    assert!(text.contains("vacancy (hole, 600 K, V 1 to 1.25, τ 0.2, #2)"), "{text}");
    for (condition, group, temperature) in
        [("group = hole", "hole", None), ("temperature = 900", "hot", Some(900.0))]
    {
        let arguments = ["export", "campaign", "--control", "--output", "part.extxyz", "--where", condition];
        succeed(here, arguments);
        let frames = read_extxyz(&here.join("part.extxyz")).unwrap();
        assert!(!frames.is_empty());
        for frame in frames {
            assert_eq!(frame.info["group"].text(), Some(group));
            assert_eq!(
                temperature.or(frame.info["temperature"].number()),
                frame.info["temperature"].number()
            );
        }
    }
    succeed(here, ["report", "campaign", "--output", "report"]);
    let table = fs::read_to_string(here.join("report/tables/conditions.csv")).unwrap();
    let groups: Vec<_> =
        table.lines().skip(1).map(|line| line.split(',').next().unwrap().to_owned()).collect();
    assert_eq!(groups, ["hot", "hot", "hot", "hot", "hole", "hole"], "{table}");
    assert!(succeed(here, ["replay", "campaign"]).contains("all reproduced bit by bit"));
}

#[test]
fn walks_of_one_seed_structure_end_together_at_its_limit() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, GROUPS, 2, "max_per_seed_structure = 1");
    succeed(here, ["run", "campaign.toml"]);
    let status = json(here, ["status", "campaign"]);
    let walks = status["walks"].as_array().unwrap().iter().filter(|walk| walk["origin"] == "biased");
    let (mut accepted, mut ends) = (0, Vec::new());
    for walk in walks {
        accepted += walk["accepted"].as_u64().unwrap();
        ends.push(walk["state"].as_str().unwrap());
    }
    assert_eq!(accepted, 2, "one of each seed structure");
    assert!(ends.iter().all(|end| *end == "quota_reached"), "{ends:?}");
}

#[test]
fn wrong_groups_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for (groups, expected) in [
        ("[[walks]]\ntemperatures = [300.0]\n", "missing key `name`"),
        ("[[walks]]\nname = \"\"\n", "walks.0.name is \"\"; expected a name that no other group has"),
        ("[[walks]]\nname = \"a\"\n[[walks]]\nname = \"a\"\n", "walks.1.name is \"a\""),
        (
            "[[walks]]\nname = \"a\"\ntemperature = 300.0\n",
            "unknown key `temperature`, expected one of `name`, `seed_structures`, `temperatures`",
        ),
        ("[[walks]]\nname = \"a\"\ntau_values = [0.1, -1.0]\n", "found -1, expected a finite number above 0"),
        ("[[walks]]\nname = \"a\"\ntau_values = [5000.0]\n", "walks.0.tau_values is 5000; expected"),
        ("[[walks]]\nname = \"a\"\ntemperatures = [30000.0]\n", "more than walks.0.temperatures = 30000 K"),
        (
            "[[walks]]\nname = \"a\"\nvolume_ramps = [{ from = 1.0, to = 140.0 }]\n",
            "walks.0.volume_ramps is 140; expected 0.05 to 20 V/V₀",
        ),
        ("[[walks]]\nname = \"a\"\nrepeats = 5000\n", "walks.0.repeats is 5000; expected at most 1000"),
        (
            "[[walks]]\nname = \"a\"\nseed_structures = \"seed_structure = bcc\"\n",
            "no seed structure is selected by 'seed_structure = bcc'; expected at least one",
        ),
        (
            "[[walks]]\nname = \"a\"\nseed_structures = \"gamma > 1\"\n",
            "'gamma > 1': found 'gamma', expected one of atoms, element, seed",
        ),
        ("[[walks]]\nname = \"a\"\nseed_structures = \"atoms >\"\n", "'atoms >': at character 8"),
    ] {
        write(here, groups, 1, "");
        let message = refuse(here, ["validate", "campaign.toml"]);
        assert!(message.contains(expected), "{groups}: {message}");
        assert!(message.contains("campaign.toml:"), "{message}");
    }
    // A seed structure that no group selects gets no walk.
    write(here, "[[walks]]\nname = \"a\"\nseed_structures = \"seed_structure = vacancy\"\n", 1, "");
    let output = crate::common::calmwalk(here, ["validate", "campaign.toml"]);
    let said = crate::common::stderr(&output);
    assert!(output.status.success() && said.contains("seed structure 'fcc-100'"), "{said}");
    assert!(said.contains("is in no group: no walk starts from it"), "{said}");
}
