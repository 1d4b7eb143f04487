//! Campaigns whose walks have a barostat, with and without a bias on the cell.

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use serde_json::{Value, json};

use crate::common::campaign::{Outcome, Small, outcome};
use crate::common::processes::{processes_running, signal, wait_until};
use crate::common::{Running, calmwalk, program, refuse, stderr, succeed, write_frames};

/// Two volumes at the start with a biased cell, and one walk under pressure without.
const GROUPS: &str = r#"
[[walks]]
name = "driven"
pressures = [1.0]
start_volumes = [0.97, 1.05]
cell_bias = true

[[walks]]
name = "pressed"
seed_structures = "seed_structure = vacancy"
pressures = [50000.0]
cell_bias = false
"#;

const KEYS: &str =
    "reference_steps = 40\n[walk.cell_bias]\nwindow = 20\ngain = 0.05\nend_after_collected = 1000\n";

/// Number of times that a campaign is interrupted.
const INTERRUPTIONS: u64 = 4;

/// Writes a small campaign without a volume ramp, with these keys at the end of `[walk]` and these groups.
fn write(here: &Path, walkers: usize, keys: &str, groups: &str) {
    let config = Small { walkers, steps: 120, max_per_walk: 2, ..Small::default() }.write(here);
    let text = fs::read_to_string(&config).unwrap();
    let ramp = "volume_ramp = { from = 1.0, to = 1.25 }\n";
    assert!(text.contains(ramp));
    fs::write(config, text.replace(ramp, keys) + groups).unwrap();
}

/// A pressure that tears the cell apart ends its walks with the reason, and the campaign goes on to its end.
#[test]
fn a_campaign_outlives_walks_whose_cells_are_torn_apart() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let groups =
        "[[walks]]\nname = \"torn\"\npressures = [-9e6]\n[[walks]]\nname = \"whole\"\npressures = [1.0]\n";
    write(here, 2, "reference_steps = 0\n", groups);
    succeed(here, ["run", "campaign.toml"]);
    let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    assert_eq!(status["finished"], true);
    let walks = status["walks"].as_array().unwrap();
    let biased = || walks.iter().filter(|walk| walk["origin"] == "biased");
    assert_eq!(biased().count(), 4);
    for walk in biased() {
        let is_torn = walk["conditions"]["group"] == "torn";
        let reason = walk["reason"].as_str().unwrap();
        assert_eq!(walk["state"] == "diverged", is_torn, "{walk}");
        if is_torn {
            assert!(reason.contains("the volume is") || reason.contains("the cell changes by"), "{walk}");
        }
    }
}

/// A slab without a third lattice vector has no volume on which the bias could act.
#[test]
fn a_biased_cell_needs_a_volume() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let barostat = "barostat = {}\ncell_bias = { stress_scale = 76.0 }\n";
    for (keys, groups, expected) in [
        (barostat, "", "walk.cell_bias: the lattice vectors do not span space"),
        (
            "barostat = {}\n",
            "[[walks]]\nname = \"a\"\ncell_bias = true\n",
            "group 'a' has a bias on the cell: the lattice vectors do not span space",
        ),
    ] {
        write(here, 1, keys, groups);
        let mut frame = atoms::read_extxyz(&here.join("seeds.extxyz")).unwrap().remove(0);
        frame.structure.periodic = [true, true, false];
        frame.structure.cell.0[2] = [0.0; 3];
        write_frames(&here.join("seeds.extxyz"), &[frame]);
        let said = refuse(here, ["validate", "campaign.toml"]);
        assert!(said.contains(expected), "{said}");
    }
    // Without a bias, its periodic directions may move.
    let config = fs::read_to_string(here.join("campaign.toml")).unwrap();
    fs::write(here.join("campaign.toml"), config.replace("cell_bias = true", "cell_bias = false")).unwrap();
    succeed(here, ["validate", "campaign.toml"]);
}

/// Interruptions in a reference run, also within an assignment, are no steps of it: a walk would begin a round earlier.
#[test]
fn interruptions_of_reference_runs_change_nothing() {
    let written = || {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), 1, &KEYS.replace("= 40", "= 400"), GROUPS);
        let config = directory.path().join("campaign.toml");
        let text = fs::read_to_string(&config).unwrap();
        assert!(text.contains("steps_per_assignment = 40\n"));
        fs::write(&config, text.replace("steps_per_assignment = 40\n", "steps_per_assignment = 100\n"))
            .unwrap();
        directory
    };
    let (alone, disturbed) = (written(), written());
    succeed(alone.path(), ["run", "campaign.toml"]);
    let expected = outcome(&alone.path().join("campaign"));
    let here = disturbed.path();
    let mut interruptions = 0;
    loop {
        let mut command = program(here);
        let command = command.args(["run", "campaign.toml"]).stdout(Stdio::null()).stderr(Stdio::null());
        let mut running = Running(command.spawn().unwrap());
        if interruptions < INTERRUPTIONS {
            wait_until("a walker runs", || !processes_running(here, "walker").is_empty());
            std::thread::sleep(Duration::from_millis(100 + 50 * interruptions));
            signal(running.0.id(), "INT");
            interruptions += 1;
        }
        match running.0.wait().unwrap().code() {
            Some(0) => break,
            code => assert!(matches!(code, Some(130) | None), "{code:?}"),
        }
    }
    assert_eq!(interruptions, INTERRUPTIONS, "the campaign ended before it was interrupted often enough");
    assert_eq!(outcome(&here.join("campaign")), expected);
}

fn run(walkers: usize) -> (tempfile::TempDir, Outcome) {
    let directory = tempfile::tempdir().unwrap();
    write(directory.path(), walkers, KEYS, GROUPS);
    succeed(directory.path(), ["run", "campaign.toml"]);
    let outcome = outcome(&directory.path().join("campaign"));
    (directory, outcome)
}

#[test]
fn walks_at_constant_pressure_give_the_same_bytes_for_any_number_of_walkers() {
    let ((directory, one), (_other, three)) = (run(1), run(3));
    assert_eq!(one, three);
    let here = directory.path();
    let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    let walks: Vec<_> =
        status["walks"].as_array().unwrap().iter().filter(|walk| walk["origin"] == "biased").collect();
    let constant = |walk: &Value| walk["conditions"]["constant_pressure"].clone();
    let driven = |start: f64| json!({ "pressure": 1.0, "start_volume": start, "cell_bias": true });
    let pressed = json!({ "pressure": 50000.0, "start_volume": 1.0, "cell_bias": false });
    let expected = [driven(0.97), driven(1.05), driven(0.97), driven(1.05), pressed];
    assert_eq!(walks.iter().map(|walk| constant(walk)).collect::<Vec<_>>(), expected);
    // V₀ is that of the reference run: the same for the walks from one seed structure at one pressure, whatever their start.
    let volumes: Vec<_> = walks.iter().map(|walk| walk["reference_volume"].as_f64().unwrap()).collect();
    assert_eq!((volumes[0], volumes[2]), (volumes[1], volumes[3]));
    assert!(volumes[4] < volumes[3] && volumes[4] > 0.5 * volumes[3], "{volumes:?}");
    assert!(walks.iter().all(|walk| walk["reference_step"].is_null()));
    let text = succeed(here, ["status", "campaign", "--walks", "50"]);
    assert!(text.contains("vacancy (driven, 1 bar from V 1.05, biased cell)"), "{text}");
    assert!(succeed(here, ["replay", "campaign"]).contains("all reproduced bit by bit"));
    // Volumes move from where they start; the trace has the gain.
    let trace = succeed(here, ["walks", "campaign", "trace", "1"]);
    let mut lines = trace.lines();
    let titles: Vec<_> = lines.next().unwrap().split(',').collect();
    let column = |name: &str| titles.iter().position(|title| *title == name).unwrap();
    let rows: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
    let number = |row: &[&str], name: &str| row[column(name)].parse::<f64>().unwrap();
    assert!((number(&rows[0], "relative_volume") - 1.05).abs() < 1e-9, "{trace}");
    let last = rows.last().unwrap();
    assert!((number(last, "relative_volume") - 1.05).abs() > 1e-3, "{trace}");
    assert!(number(last, "cell_gain") > 0.0, "{trace}");
}

#[test]
fn impossible_combinations_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let barostat = "barostat = {}\n";
    let group = |keys: &str| format!("[[walks]]\nname = \"a\"\n{keys}\n");
    for (keys, groups, expected) in [
        (
            "barostat = {}\nvolume_ramp = { from = 1.0, to = 1.2 }\n",
            String::new(),
            "walk.volume_ramp is given together with walk.barostat",
        ),
        ("barostat = { relaxation_time = 0.0 }\n", String::new(), "walk.barostat.relaxation_time is 0"),
        (
            "barostat = { pressure = 1e9 }\n",
            String::new(),
            "expected -1e7 to 1e7 bar: it is in bar: 1 GPa is 10000 bar",
        ),
        ("barostat = { cell = \"loose\" }\n", String::new(), "loose"),
        (
            "start_volume = 1.1\n",
            String::new(),
            "walk.start_volume is given without a barostat; expected walk.barostat",
        ),
        (
            "cell_bias = {}\n",
            String::new(),
            "walk.cell_bias is given without a barostat; expected walk.barostat",
        ),
        (
            "barostat = {}\ncell_bias = { gain = 0.2 }\n",
            String::new(),
            "walk.cell_bias.gain_range is [0.005, 0.1] with gain = 0.2",
        ),
        (
            "barostat = {}\ncell_bias = { min_drift = 0.05 }\n",
            String::new(),
            "walk.cell_bias.max_drift is 0.03; expected more than min_drift = 0.05",
        ),
        (
            "barostat = {}\ncell_bias = { volume_range = [1.1, 1.3] }\n",
            String::new(),
            "walk.cell_bias.volume_range is [1.1, 1.3]",
        ),
        (
            "barostat = {}\nstart_volume = 1.4\ncell_bias = {}\n",
            String::new(),
            "walk.start_volume is 1.4; expected within walk.cell_bias.volume_range",
        ),
        ("", group("start_volumes = [1.1]"), "walks.0.start_volumes is given without a barostat"),
        ("", group("cell_bias = true"), "walks.0.cell_bias is given without a barostat"),
        (
            "",
            group("pressures = [1.0]\nvolume_ramps = [{ from = 1.0, to = 1.2 }]"),
            "walks.0.volume_ramps is given together with pressures",
        ),
        (barostat, group("start_volumes = [100.0]"), "walks.0.start_volumes is 100; expected 0.25 to 4 V/V₀"),
        (barostat, group("pressures = [1e8]"), "walks.0.pressures is 100000000"),
    ] {
        write(here, 1, keys, &groups);
        let output = calmwalk(here, ["validate", "campaign.toml"]);
        assert_eq!(output.status.code(), Some(2), "{keys}{groups}: {}", stderr(&output));
        let said = stderr(&output);
        assert!(said.contains(expected) && said.contains("campaign.toml:"), "{keys}{groups}: {said}");
    }
}
