//! Groups of walks under several conditions, which share a mixture.

use std::fs;
use std::path::Path;

use atoms::extxyz::{ExtxyzValue, Frame};
use atoms::read_extxyz;
use serde_json::{Value, json};

use crate::common::campaign::{Outcome, Small, outcome};
use crate::common::{calmwalk, refuse, stderr, succeed, write_frames};

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

/// Writes a small campaign with these groups, and with these keys in `[collect]`.
fn write(here: &Path, groups: &str, walkers: usize, keys: &str) {
    let small = Small { walkers, steps: 120, max_per_walk: 2, ..Small::default() };
    let config = small.write(here);
    let text = fs::read_to_string(&config).unwrap().replace("[collect]", &format!("[collect]\n{keys}"));
    fs::write(&config, text + groups).unwrap();
}

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Value {
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
            let Value::Object(c) = &walk["conditions"] else { panic!("{walk}") };
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

/// Equilibration at the start of the ramp, and no jump from the volume of the seed structure.
#[test]
fn ramps_begin_at_their_own_volume() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let groups = "[[walks]]\nname = \"wide\"\nvolume_ramps = [{ from = 1.1, to = 1.25 }]\n";
    write(here, groups, 2, "");
    succeed(here, ["run", "campaign.toml"]);
    succeed(here, ["export", "campaign", "--control", "--output", "all.extxyz"]);
    let seeds = read_extxyz(&here.join("seeds.extxyz")).unwrap();
    let frames = read_extxyz(&here.join("all.extxyz")).unwrap();
    let origins = |origin: &str| frames.iter().any(|frame| frame.info["origin"].text() == Some(origin));
    assert!(origins("biased") && origins("control"));
    for frame in &frames {
        let number = |key: &str| frame.info[key].number().unwrap();
        // 20 steps of equilibration, and 120 steps of the ramp.
        let expected = 1.1 + 0.15 * (number("step") - 20.0) / 120.0;
        let of = |seed: &&Frame| seed.info["name"].text() == frame.info["seed_structure"].text();
        let before = seeds.iter().find(of).unwrap().structure.cell.volume();
        let volume = frame.structure.cell.volume() / before;
        assert!(number("step") > 20.0 && (number("relative_volume") - expected).abs() < 1e-9, "{expected}");
        assert!((volume - expected).abs() < 1e-6, "{volume}, not {expected}");
    }
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
    let output = calmwalk(here, ["validate", "campaign.toml"]);
    let said = stderr(&output);
    assert!(output.status.success() && said.contains("seed structure 'fcc-100'"), "{said}");
    assert!(said.contains("is in no group: no walk starts from it"), "{said}");
}

/// Writes a small campaign with these groups; its seed structures are a crystal and `clusters` clusters without a cell.
fn write_with_clusters(here: &Path, groups: &str, clusters: usize) {
    write(here, groups, 1, "");
    let seeds = here.join("seeds.extxyz");
    let mut frames = read_extxyz(&seeds).unwrap();
    frames.truncate(1);
    for number in 0..clusters {
        let mut cluster = frames[0].clone();
        cluster.structure.periodic = [false; 3];
        cluster.info.insert("name".to_owned(), ExtxyzValue::Text(format!("cluster-{number}")));
        frames.push(cluster);
    }
    write_frames(&seeds, &frames);
}

/// Standard error of a command that succeeds.
fn warnings(here: &Path, command: &str) -> String {
    let output = calmwalk(here, [command, "campaign.toml"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    said
}

fn biased_walks(here: &Path) -> Vec<(String, Value)> {
    let status = json(here, ["status", "campaign"]);
    let walks = status["walks"].as_array().unwrap().iter().filter(|walk| walk["origin"] == "biased");
    let walk = |walk: &Value| {
        (walk["seed_structure"].as_str().unwrap().to_owned(), walk["conditions"]["volume_ramp"].clone())
    };
    walks.map(walk).collect()
}

const DENSE: &str = "[[walks]]\nname = \"dense\"\nvolume_ramps = [{ from = 1.0, to = 0.9 }]\n";

#[test]
fn a_structure_without_a_volume_is_skipped_where_all_its_walks_would_change_it() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let alone = "[[walks]]\nname = \"alone\"\nseed_structures = \"seed_structure = cluster-0\"\n";
    write_with_clusters(here, &format!("{DENSE}{alone}"), 1);
    let said = warnings(here, "run");
    let expected = [
        "seed structure 'cluster-0' (seeds.extxyz:",
        ") is skipped: group 'dense' changes the volume, but the structure has no periodic direction",
        "group 'alone' has no walk: none can start from the seed structures that it selects",
    ];
    assert!(expected.iter().all(|words| said.contains(words)), "{said}");
    assert_eq!(biased_walks(here), [("fcc-100".to_owned(), json!([1.0, 0.9]))]);
    succeed(here, ["validate", "campaign.toml", "--csv", "seeds.csv"]);
    let csv = fs::read_to_string(here.join("seeds.csv")).unwrap();
    assert!(csv.lines().nth(1).unwrap().starts_with("cluster-0,") && csv.contains(",skipped,"), "{csv}");

    // With `on_invalid = "error"` every seed structure needs a walk; otherwise at least one does.
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let strict = text.replace("[seed_structures]", "[seed_structures]\non_invalid = \"error\"");
    fs::write(here.join("strict.toml"), strict).unwrap();
    let message = refuse(here, ["validate", "strict.toml"]);
    assert!(message.contains("walks.0") && message.contains("group 'dense' changes the volume"), "{message}");
    write_with_clusters(here, alone, 1);
    let message = refuse(here, ["validate", "campaign.toml"]);
    assert!(message.contains("no walk can start: group 'alone' changes the volume"), "{message}");
}

#[test]
fn a_structure_without_a_volume_keeps_the_walks_that_do_not_change_it() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let both =
        "[[walks]]\nname = \"both\"\nvolume_ramps = [{ from = 1.0, to = 0.9 }, { from = 1.0, to = 1.0 }]\n";
    write_with_clusters(here, both, 1);
    let said = warnings(here, "run");
    assert!(said.contains("walks at its own volume only: group 'both' changes the volume"), "{said}");
    let own = json!([1.0, 1.0]);
    let expected = [("fcc-100", json!([1.0, 0.9])), ("fcc-100", own.clone()), ("cluster-0", own)];
    assert_eq!(biased_walks(here), expected.map(|(name, ramp)| (name.to_owned(), ramp)));
}

#[test]
fn long_lists_of_structures_without_walks_are_cut() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_with_clusters(here, DENSE, 22);
    let said = warnings(here, "validate");
    assert_eq!(said.matches(") is skipped: group").count(), 20, "{said}");
    assert!(said.contains("2 more seed structures are skipped"), "{said}");
    let crystal = "[[walks]]\nname = \"crystal\"\nseed_structures = \"seed_structure = fcc-100\"\n";
    write_with_clusters(here, crystal, 22);
    let said = warnings(here, "validate");
    assert_eq!(said.matches("is in no group: no walk starts from it").count(), 20, "{said}");
    assert!(said.contains("2 more seed structures are in no group"), "{said}");
}
