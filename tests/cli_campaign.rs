//! Commands on a campaign: status, queue, export, import.

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use atoms::extxyz::{ExtxyzValue, Frame, FrameLabels, LabelKeys};
use atoms::{Evaluation, NeighbourList, Potential, read_extxyz};
use potentials::{Eam, EamStyle};
use serde_json::Value;

use crate::common::processes::{assert_no_leftovers, wait_until};
use crate::common::{Running, config, deviation, program, refuse, succeed, write_frames};

/// Two seed structures, a few hundred steps, and two structures per walk with their control frames.
const CONFIGURATION: &str = r#"
[potential]
model = "CONFIGS/data/al_eam_1l/kokkos.npz"
[calm]
artifact = "CONFIGS/data/al_eam_1l/gmm_artifacts.npz"
[seed_structures]
files = ["seeds.extxyz"]
[walk]
temperature = 900.0
biased_steps = 150
equilibration_steps = 50
tau = 0.15
volume_ramp = { from = 1.0, to = 1.2 }
[collect]
criterion = { rule = "maximum_grade", threshold = 1.5 }
update_target = { rule = "maximum_grade", target = 1.25 }
min_interval = 20
min_interval_after_decline = 10
max_per_walk = 2
[label]
method = { potential = { kind = "eam_fs", file = "CONFIGS/data/Al_mm.eam.fs" } }
max_attempts = 2
max_force = 1000
[run]
walkers = 2
walks_per_round = 2
steps_per_assignment = 50
"#;

/// Writes `small.toml` and its seed structures; the campaign's directory is `small`.
fn write_campaign(here: &Path, changes: &[(&str, &str)]) {
    let mut text = CONFIGURATION.replace("CONFIGS", config("").to_str().unwrap().trim_end_matches('/'));
    for (from, to) in changes {
        assert!(text.contains(from));
        text = text.replace(from, to);
    }
    let seeds = read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap();
    let wanted =
        |frame: &&Frame| ["fcc-100", "slab-111"].map(ExtxyzValue::from).contains(&frame.info["name"]);
    write_frames(&here.join("seeds.extxyz"), &seeds.iter().filter(wanted).cloned().collect::<Vec<_>>());
    fs::write(here.join("small.toml"), text).unwrap();
}

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Value {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

fn jobs(here: &Path) -> Vec<Value> {
    json(here, ["queue", "small", "list"]).as_array().unwrap().clone()
}

fn text<'a>(frame: &'a Frame, key: &str) -> &'a str {
    frame.info[key].text().unwrap()
}

fn number(frame: &Frame, key: &str) -> f64 {
    frame.info[key].number().unwrap()
}

#[test]
fn a_finished_campaign_is_shown() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &[]);
    succeed(here, ["run", "small.toml"]);
    let status = json(here, ["status", "small"]);
    assert_eq!((&status["finished"], &status["mode"]), (&true.into(), &"reproducible".into()));
    assert_eq!((&status["candidates"]["accepted"], &status["candidates"]["control"]), (&4.into(), &4.into()));
    let declined: u64 =
        status["candidates"]["declined"].as_object().unwrap().values().flat_map(Value::as_u64).sum();
    assert_eq!(status["candidates"]["seen"], 4 + declined);
    assert_eq!((&status["mixture_version"], &status["processes"]), (&4.into(), &serde_json::json!([])));
    let jobs = jobs(here);
    for (state, count) in
        [("labelled", jobs.len()), ("queued", 0), ("leased", 0), ("failed", 0), ("dropped", 0)]
    {
        assert_eq!(status["labels"][state], count);
    }
    let walks = status["walks"].as_array().unwrap();
    assert!(walks.len() == 4 && walks.iter().all(|walk| walk["state"] == "quota_reached"));

    assert_eq!((&status["disk"]["at_the_end"], &status["run_active"]), (&Value::Null, &false.into()));
    let shown = succeed(here, ["status", "small"]);
    assert!(!shown.contains("when all is collected"), "{shown}");
    assert!(
        shown.contains("state       finished") && shown.contains("T (K)") && shown.contains("slab-111"),
        "{shown}"
    );
    assert!(shown.lines().count() < 20 && shown.lines().all(|line| line.chars().count() < 120), "{shown}");

    let id = jobs[0]["candidate"].as_str().unwrap();
    let short = id.split_once('-').unwrap().1;
    let details = json(here, ["queue", "small", "show", short]);
    assert_eq!(
        (&details["candidate"], &details["attempts_made"][0]["outcome"]),
        (&id.into(), &"labelled".into())
    );
    assert!(succeed(here, ["queue", "small", "show", id]).contains(" eV/atom"));
    let table =
        succeed(here, ["queue", "small", "list", "--state", "labelled", "--limit", "2", "--offset", "1"]);
    let order = |a: &Value| (-a["priority"].as_i64().unwrap(), a["job"].as_i64().unwrap());
    let mut sorted = jobs.clone();
    sorted.sort_by_key(order);
    assert!(table.lines().nth(1).unwrap().starts_with(sorted[1]["candidate"].as_str().unwrap()), "{table}");
    assert_eq!(table.lines().count(), 4);

    assert!(
        refuse(here, ["queue", "small", "show", "zzz"])
            .contains("no label job belongs to 'zzz'; similar names: ")
    );
    assert!(refuse(here, ["queue", "small", "drop", id]).contains("its label job is labelled"));
    assert!(refuse(here, ["queue", "small", "show", "0."]).contains("give a longer prefix"));
    assert!(refuse(here, ["status", "nowhere"]).contains("there is no campaign"));
}

#[test]
fn an_export_holds_labels_and_grades_in_decision_order() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &[]);
    succeed(here, ["run", "small.toml"]);
    let printed = succeed(here, ["export", "small", "--output", "ase.extxyz"]);
    assert_eq!(printed, "4 structures in ase.extxyz\nall accepted structures are labelled\n");
    let frames = read_extxyz(&here.join("ase.extxyz")).unwrap();
    check_labels(&frames);
    let versions: Vec<_> = frames.iter().map(|frame| number(frame, "mixture_version")).collect();
    assert_eq!(versions, [1.0, 2.0, 3.0, 4.0]);
    for frame in &frames {
        let (id, name) = (text(frame, "candidate_id"), text(frame, "seed_structure"));
        let place = ["walk", "segment", "step"].map(|key| number(frame, key).to_string()).join(".");
        assert_eq!(id.split('-').nth(1), Some(&*place));
        assert!(["fcc-100", "slab-111"].contains(&name) && text(frame, "origin") == "biased");
        assert!(number(frame, "mixture_version_seen") < number(frame, "mixture_version"));
        assert!((1.0..=1.2).contains(&number(frame, "relative_volume")));
        assert_eq!((text(frame, "protocol"), text(frame, "protocol_hash").len()), ("potential", 16));
    }
    check_grades(here, &frames);

    for (keys, name) in [("mace", LabelKeys::Mace), ("grace", LabelKeys::Grace)] {
        succeed(here, ["export", "small", "--output", "other.extxyz", "--keys", keys]);
        let others = read_extxyz(&here.join("other.extxyz")).unwrap();
        for (frame, other) in frames.iter().zip(&others) {
            let mut expected = frame.clone();
            expected.set_labels(&frame.labels().unwrap(), name);
            assert_eq!(&expected, other);
        }
    }
    let printed = succeed(here, ["export", "small", "--output", "all.extxyz", "--control"]);
    assert!(printed.starts_with("8 structures"), "{printed}");
    let all = read_extxyz(&here.join("all.extxyz")).unwrap();
    assert_eq!(all.iter().filter(|frame| text(frame, "origin") == "control").count(), 4);

    // The output must not replace files of the campaign, and its directory must exist.
    for (output, reason) in
        [("small/campaign.sqlite", "a file of the campaign itself"), ("missing/all.extxyz", "cannot write")]
    {
        let message = refuse(here, ["export", "small", "--output", output]);
        assert!(message.contains(reason), "{message}");
    }
    succeed(here, ["status", "small"]);

    // The same campaign with another number of walkers exports the same bytes.
    let again = tempfile::tempdir().unwrap();
    write_campaign(again.path(), &[("walkers = 2", "walkers = 1")]);
    succeed(again.path(), ["run", "small.toml"]);
    succeed(again.path(), ["export", "small", "--output", "ase.extxyz"]);
    assert!(fs::read(here.join("ase.extxyz")).unwrap() == fs::read(again.path().join("ase.extxyz")).unwrap());
}

/// The labels equal evaluations by the reference potential.
fn check_labels(frames: &[Frame]) {
    let mut potential = Eam::load_as(config("data/Al_mm.eam.fs"), EamStyle::FinnisSinclair).unwrap();
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    for frame in frames {
        let mut expected = Evaluation::default();
        neighbours.update(&frame.structure).unwrap();
        potential.evaluate(&frame.structure, &neighbours, &mut expected).unwrap();
        let labels = frame.labels().unwrap();
        assert!(deviation(&[labels.energy.unwrap()], &[expected.energy()]) < 1e-12);
        assert!(deviation(&labels.forces.unwrap().concat(), &expected.forces.concat()) < 1e-10);
        let stress = expected.stress(&frame.structure).unwrap();
        assert!(deviation(&labels.stress.unwrap().concat(), &stress.concat()) < 1e-10);
    }
}

/// Grading the export with the original mixture gives the exported grades.
fn check_grades(here: &Path, frames: &[Frame]) {
    let kokkos = config("data/al_eam_1l/kokkos.npz");
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz");
    let (kokkos, artifact) = (kokkos.to_str().unwrap(), artifact.to_str().unwrap());
    let arguments = ["--model", kokkos, "--artifact", artifact, "ase.extxyz", "--output", "graded.extxyz"];
    succeed(here, ["calm", "score"].into_iter().chain(arguments));
    let graded = read_extxyz(&here.join("graded.extxyz")).unwrap();
    for (frame, graded) in frames.iter().zip(&graded) {
        for column in ["gamma", "gamma_nbr"] {
            let [found, expected] = [frame, graded].map(|frame| frame.arrays[column].reals().unwrap());
            assert!(deviation(&found, &expected) < 1e-10, "{column}");
        }
        assert_eq!(frame.labels().unwrap(), graded.labels().unwrap());
    }
}

#[test]
fn failed_labels_are_shown_retried_and_dropped() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &[("max_force = 1000", "max_force = 1e-3")]);
    succeed(here, ["run", "small.toml"]);
    let failed = jobs(here);
    assert!(failed.iter().all(|job| job["state"] == "failed" && job["attempts"] == 2));
    let id = |k: usize| failed[k]["candidate"].as_str().unwrap();
    let shown = succeed(here, ["queue", "small", "show", id(0)]);
    assert!(shown.contains("failed") && shown.contains("eV/Å") && shown.contains("2 failed"), "{shown}");
    let message = refuse(here, ["export", "small", "--output", "out.extxyz"]);
    assert!(message.contains(&format!(
        "nothing to export: no structure has a label (0 not labelled yet, {}",
        failed.len()
    )));
    assert!(!here.join("out.extxyz").exists());

    let retried = json(here, ["queue", "small", "retry", id(0), id(1), id(2)]);
    assert!(retried.as_array().unwrap().iter().all(|job| job["state"] == "queued" && job["failures"] == 0));
    let prioritised = succeed(here, ["queue", "small", "prioritise", id(2), "-5"]);
    assert_eq!(prioritised, format!("{} now has priority -5\n", id(2)));
    succeed(here, ["queue", "small", "prioritise", id(1), "99"]);
    let queued = json(here, ["queue", "small", "list", "--state", "queued"]);
    let order: Vec<_> =
        queued.as_array().unwrap().iter().map(|job| job["candidate"].as_str().unwrap()).collect();
    assert_eq!(order, [id(1), id(0), id(2)]);
    assert!(succeed(here, ["queue", "small", "drop", id(2)]).contains("is dropped"));
    assert!(refuse(here, ["queue", "small", "drop", id(2)]).contains("its label job is dropped"));
    assert!(refuse(here, ["queue", "small", "prioritise", id(3), "1"]).contains("its label job is failed"));

    // The campaign continues with a limit that accepts the labels.
    let before = fs::read_to_string(here.join("small.toml")).unwrap();
    fs::write(here.join("small.toml"), before.replace("max_force = 1e-3", "max_force = 1000")).unwrap();
    succeed(here, ["run", "small.toml"]);
    let printed = succeed(here, ["export", "small", "--output", "out.extxyz"]);
    let expected = format!(
        "accepted structures without a label: 0 not labelled yet, {} failed, 1 dropped\n",
        failed.len() - 3
    );
    assert!(printed.starts_with("2 structures") && printed.ends_with(&expected), "{printed}");
    let exported = read_extxyz(&here.join("out.extxyz")).unwrap();
    assert_eq!(exported.iter().map(|frame| text(frame, "candidate_id")).collect::<Vec<_>>(), [id(0), id(1)]);
}

#[test]
fn labelled_structures_are_imported_once() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &[]);
    succeed(here, ["run", "small.toml"]);
    succeed(here, ["export", "small", "--output", "own.extxyz"]);
    let seeds = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    write_frames(&here.join("new.extxyz"), &seeds[..3]);
    // One frame without forces makes the import of all files fail.
    let mut bad = seeds[3..5].to_vec();
    bad[1].arrays.remove("forces");
    write_frames(&here.join("bad.extxyz"), &bad);
    let message = refuse(here, ["import", "small", "new.extxyz", "bad.extxyz"]);
    assert!(
        message.contains("bad.extxyz:111: the frame has no forces: expected forces or REF_forces"),
        "{message}"
    );
    assert_eq!(json(here, ["status", "small"])["imported"], 0);

    let counts = |labels, checks, known, protocol| {
        let checks = if checks == 1 { "1 check".to_owned() } else { format!("{checks} checks") };
        format!("imported {labels} labels and {checks} of protocol '{protocol}'; {known} already known\n")
    };
    assert_eq!(succeed(here, ["import", "small", "new.extxyz"]), counts(3, 0, 0, "potential"));
    assert_eq!(succeed(here, ["import", "small", "new.extxyz", "own.extxyz"]), counts(0, 0, 7, "potential"));
    let mut other = seeds[..1].to_vec();
    let labels = FrameLabels { energy: Some(-364.0), ..other[0].labels().unwrap() };
    other[0].set_labels(&labels, LabelKeys::Mace);
    write_frames(&here.join("other.extxyz"), &other);
    assert_eq!(succeed(here, ["import", "small", "other.extxyz"]), counts(0, 1, 0, "potential"));
    succeed(here, ["export", "small", "--output", "all.extxyz", "--imported"]);
    let all = read_extxyz(&here.join("all.extxyz")).unwrap();
    assert_eq!(all.len(), 7);
    for (frame, seed) in all[4..].iter().zip(&seeds) {
        assert_eq!((text(frame, "origin"), text(frame, "source_file")), ("imported", "new.extxyz"));
        assert_eq!((&frame.structure, frame.labels()), (&seed.structure, seed.labels()));
    }

    assert_eq!(
        succeed(here, ["import", "small", "new.extxyz", "--protocol", "other code"]),
        counts(3, 0, 0, "other code")
    );
    let message = refuse(here, ["export", "small", "--output", "both.extxyz", "--imported"]);
    assert!(
        message.contains("several protocols") && message.contains("'potential', 'other code'"),
        "{message}"
    );
    assert!(!here.join("both.extxyz").exists());
    // Without the imports, all labels have one protocol.
    succeed(here, ["export", "small", "--output", "again.extxyz"]);
    assert_eq!(fs::read(here.join("own.extxyz")).unwrap(), fs::read(here.join("again.extxyz")).unwrap());
    let other = ["export", "small", "--output", "both.extxyz", "--imported", "--protocol", "other code"];
    assert!(succeed(here, other).starts_with("3 structures"));
    let message = refuse(here, ["export", "small", "--output", "x.extxyz", "--protocol", "none"]);
    assert!(message.contains("no protocol 'none'; it has 'potential', 'other code'"), "{message}");
    // The campaign still labels with its own protocol.
    succeed(here, ["run", "small.toml"]);
    assert!(jobs(here).iter().all(|job| job["protocol"] == "potential"));
}

#[test]
fn status_works_while_a_campaign_runs_and_after_it_was_killed() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(
        here,
        &[("biased_steps = 150", "biased_steps = 100000000"), ("threshold = 1.5", "threshold = 1e6")],
    );
    let command = ["run", "small.toml"];
    let run = program(here).args(command).stderr(Stdio::null()).stdout(Stdio::null()).spawn().unwrap();
    let run = Running(run);
    let begun = Instant::now();
    let walked = loop {
        assert!(begun.elapsed() < Duration::from_secs(60), "no step is made");
        std::thread::sleep(Duration::from_millis(100));
        if !here.join("small/campaign.sqlite").exists() {
            continue;
        }
        let status = json(here, ["status", "small"]);
        if status["walks"].as_array().unwrap().iter().any(|walk| walk["step"].as_u64() > Some(0)) {
            break status;
        }
    };
    assert_eq!(
        (&walked["finished"], &walked["processes"][0]["kind"]),
        (&false.into(), &"orchestrator".into())
    );
    assert_eq!(walked["processes"][0]["pid"], run.0.id());
    assert!(succeed(here, ["status", "small"]).contains("state       running"));
    fs::write(
        here.join("l.extxyz"),
        "1\nProperties=species:S:1:pos:R:3:forces:R:3 energy=1\nAl 0 0 0 0 0 0\n",
    )
    .unwrap();
    // Imports determine which candidates are duplicates, so a running campaign refuses them.
    let message = refuse(here, ["import", "small", "l.extxyz"]);
    assert!(message.contains("only one process may run a campaign"), "{message}");
    drop(run);
    assert!(succeed(here, ["import", "small", "l.extxyz"]).starts_with("imported 1 label and "));
    let killed = json(here, ["status", "small"]);
    assert_eq!(killed["processes"][0]["state"], "dead");
    let not_running = "not running (resume with calmwalk run)";
    wait_until("the labeller has left", || succeed(here, ["status", "small"]).contains(not_running));
    assert!(succeed(here, ["clean", "small"]).contains("files from shared memory"));
    assert_no_leftovers(&here.join("small"));
}
