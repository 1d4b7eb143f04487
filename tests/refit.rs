//! `calmwalk refitter`: trains, judges and registers a version of the potential, or refuses it.

mod interruptions;
mod wrong_data;

use std::collections::BTreeSet;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Output, Stdio};

use atoms::extxyz::{Frame, LabelKeys};
use atoms::read_extxyz;
use calm::Artifact;
use potentials::grace::GraceModel;
use serde_json::{Value as Json, json};
use store::{ProcessRecord, VersionFiles, VersionRecord, VersionState};

use crate::common::campaign::Small;
use crate::common::label_campaign::on_store;
use crate::common::npz::with_changed_arrays;
use crate::common::processes::{calculation_processes, signal, wait_until};
use crate::common::{Running, config, program, stderr, succeed, write_frames};

const MODEL: &str = "data/al_eam_1l/kokkos.npz";
const MIXTURE: &str = "data/al_eam_1l/gmm_artifacts.npz";
/// Share of the seed structures that are held out.
const HELD_OUT: f64 = 0.5;
/// Number of structures of the replay data.
const REPLAY: usize = 20;

/// Runs a campaign in `here/campaign`, and writes replay data and a test set beside it.
fn prepare(here: &Path) {
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml", "--directory", "campaign"]);
    let frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    write_frames(&here.join("replay.extxyz"), &frames[..REPLAY]);
    write_frames(&here.join("test.extxyz"), &frames[REPLAY..REPLAY + 3]);
}

/// Whether a seed structure is held out. Campaigns rely on this: another rule would train on what was held out.
fn is_held_out(name: &str, rng_seed: u64) -> bool {
    let bytes = [&b"calmwalk held out 1"[..], &rng_seed.to_le_bytes()[..], name.as_bytes()].concat();
    let hash = blake3::hash(&bytes);
    let number = u64::from_le_bytes(hash.as_bytes()[..8].try_into().unwrap()) >> 11;
    (number as f64) / ((1_u64 << 53) as f64) < HELD_OUT
}

/// A random seed that holds out one of the two seed structures.
fn rng_seed() -> u64 {
    (0..).find(|seed| is_held_out("fcc-100", *seed) && !is_held_out("vacancy", *seed)).unwrap()
}

fn hashed(path: PathBuf) -> Json {
    let hash = blake3::hash(&fs::read(&path).unwrap()).to_string();
    json!({ "path": path, "hash": hash })
}

/// The configuration of a refit of a campaign by this method.
fn settings(here: &Path, campaign: &str, method: Json) -> Json {
    let directory = here.join(campaign);
    json!({
        "parent": null,
        "location": directory,
        "directory": directory,
        "parent_version": 0,
        "parent_model": hashed(config(MODEL)),
        "first_model": hashed(config(MODEL)),
        "parent_mixture": hashed(config(MIXTURE)),
        "precision": "double",
        "rng_seed": rng_seed(),
        "settings": {
            "replay": [hashed(here.join("replay.extxyz"))],
            "replay_weight": 1.0,
            "method": method,
            "held_out": HELD_OUT,
            "max_replay_error_ratio": 3.0,
            "max_held_out_error_ratio": 10.0,
            "threads": 1,
            "start": "parent",
            "control_frames": "train",
            "test_sets": [{ "name": "cold", "file": hashed(here.join("test.extxyz")) }],
            "comparisons": [],
        },
        "log": null,
    })
}

fn start(here: &Path, settings: &Json) -> Child {
    let mut command = program(here);
    command.arg("refitter").stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    child.stdin.take().unwrap().write_all(settings.to_string().as_bytes()).unwrap();
    child
}

fn refit(here: &Path, settings: &Json) -> Output {
    start(here, settings).wait_with_output().unwrap()
}

fn versions(campaign: &Path) -> Vec<VersionRecord> {
    on_store(campaign.into(), async |store| store.versions().await.unwrap())
}

fn files(campaign: &Path, number: u32) -> VersionFiles {
    on_store(campaign.into(), async |store| store.version_files(number).await.unwrap().unwrap())
}

/// Copies a campaign that nothing runs.
fn copy(from: &Path, to: &Path) {
    fs::create_dir(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        if entry.file_type().unwrap().is_file() {
            fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
        }
    }
}

/// Kills a refit as soon as this file of its directory exists.
fn kill_at(here: &Path, settings: &Json, file: &Path) {
    let mut running = Running(start(here, settings));
    wait_until("it comes to a step", || file.exists() || running.0.try_wait().unwrap().is_some());
    signal(running.0.id(), "KILL");
    running.0.wait().unwrap();
}

#[test]
fn a_refit_registers_the_same_version_however_often_it_is_killed() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let [whole, killed] = ["campaign", "killed"].map(|name| here.join(name));
    copy(&whole, &killed);
    let native = json!({ "native": { "epochs": 2, "learning_rate": 1e-4, "validation_share": 0.0 } });

    let output = refit(here, &settings(here, "campaign", native.clone()));
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    for line in ["refit 1: training: epoch 1 of 2, force MAE ", "refit 1: registered version 1"] {
        assert!(said.contains(line), "{said}");
    }
    let all = versions(&whole);
    let [version] = &all[..] else { panic!("one version") };
    check_version(here, version);
    let found = files(&whole, 1);
    assert!(!whole.join("refit/1").exists());
    let left = on_store((&whole).into(), async |store| {
        store.processes(Some(ProcessRecord::REFITTER)).await.unwrap().len()
    });
    assert_eq!(left, 0);
    let [model, mixture] =
        [("model.npz", &found.model), ("mixture.npz", &found.mixture)].map(|(name, bytes)| {
            fs::write(here.join(name), bytes).unwrap();
            here.join(name)
        });
    let loaded = GraceModel::load(&model).unwrap();
    assert!(loaded.projection().is_some());
    assert_eq!(Artifact::load(&mixture).unwrap().symbols, ["Al"]);
    assert!(found.model != fs::read(config(MODEL)).unwrap(), "it is trained");

    // A refit that was killed after this answers the version that it has registered.
    let output = refit(here, &settings(here, "campaign", native.clone()));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(versions(&whole).len(), 1);

    let again = settings(here, "killed", native);
    for step in ["labels.json", "training.json", "errors.json"] {
        kill_at(here, &again, &killed.join("refit/1").join(step));
    }
    let output = refit(here, &again);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(files(&killed, 1) == found, "the files differ");
    let all = versions(&killed);
    let [again] = &all[..] else { panic!("one version") };
    assert_eq!((&again.figures, again.labels), (&version.figures, version.labels));
}

/// Checks what is recorded of the version of a campaign with one seed structure held out.
fn check_version(here: &Path, version: &VersionRecord) {
    let status: Json = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    assert_eq!((version.state, version.parent, &*version.method), (VersionState::Registered, 0, "native"));
    assert_eq!(Some(version.structures), status["candidates"]["accepted"].as_u64());
    assert!(version.seconds > 0.0 && version.core_hours > 0.0 && version.reason.is_empty());
    let sets = version.figures["sets"].as_array().unwrap();
    let names: Vec<_> =
        sets.iter().map(|set| [&set["name"], &set["kind"]].map(|x| x.as_str().unwrap())).collect();
    assert_eq!(names, [["cold", "test"], ["held_out", "held_out"], ["replay", "replay"]]);
    let structures: Vec<_> = sets.iter().map(|set| set["structures"].as_u64().unwrap()).collect();
    assert_eq!((structures[0], structures[2]), (3, REPLAY as u64));
    // A structure that a biased and a control walk found is in the export of both.
    let candidates = ["accepted", "control"].map(|kind| status["candidates"][kind].as_u64().unwrap());
    assert_eq!(structures[1] + version.labels, candidates.iter().sum::<u64>());
    for set in sets {
        for model in ["first", "parent", "version"] {
            assert!(set[model]["force_mae"].as_f64().unwrap() > 0.0, "{set}");
            assert!(set[model]["energy_rmse"].as_f64().unwrap() < 1.0, "{set}");
        }
        assert_eq!(set["first"], set["parent"]);
        assert_ne!(set["parent"], set["version"]);
    }
    let training = &version.figures["training"];
    let [training, validation] = ["structures", "validation"].map(|key| training[key].as_u64().unwrap());
    assert_eq!((training, validation), (REPLAY as u64 + version.labels, 0));
}

/// A method that runs this script.
fn script(text: &str) -> Json {
    json!({ "command": { "program": ["sh", "-c", text] } })
}

/// Runs a refit that must be refused. Returns the reason.
fn refused(here: &Path, settings: &Json) -> String {
    let campaign = here.join("campaign");
    let before = versions(&campaign).len();
    let output = refit(here, settings);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let all = versions(&campaign);
    let last = all.last().unwrap();
    assert_eq!((all.len(), last.state, &*last.method), (before + 1, VersionState::Refused, "command"));
    assert!(!campaign.join("refit").join(last.number.to_string()).exists());
    assert!(last.labels > 0 && last.model_hash.is_empty());
    last.reason.clone()
}

/// Writes a model with other numbers.
fn write_model(path: &Path, key: &str, change: impl Fn(f64) -> f64) {
    let changed = with_changed_arrays(&config(MODEL), |name, numbers| {
        if name == key {
            numbers.iter_mut().for_each(|number| *number = change(*number));
        }
    });
    fs::write(path, changed).unwrap();
}

#[test]
fn what_a_program_leaves_is_judged() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let by = |text: &str| settings(here, "campaign", script(text));
    let copy_of = |name: &str| format!("cp '{}' model.npz", here.join(name).display());

    let reason = refused(here, &by("echo out of memory >&2; exit 3"));
    assert!(reason.contains("exit status: 3; its last lines: out of memory"), "{reason}");
    let reason = refused(here, &by("true"));
    assert!(reason.contains("left no model.npz"), "{reason}");
    let reason = refused(here, &by("echo text > model.npz"));
    assert!(reason.contains("the new model cannot be read"), "{reason}");
    // Paths that are relative to the directory of the run, which is not that of the program.
    let find = "for file in \"$CALMWALK_TRAIN\" \"$CALMWALK_HELD_OUT\" \"$CALMWALK_REPLAY\" \"$CALMWALK_PARENT_MODEL\"; do
        test -f \"$file\" || exit 4; done; test -d \"$CALMWALK_REFIT_DIRECTORY\" && exit 7";
    let mut relative = by(find);
    relative["directory"] = json!("campaign");
    relative["settings"]["replay"][0]["path"] = json!("replay.extxyz");
    let reason = refused(here, &relative);
    assert!(reason.contains("exit status: 7"), "{reason}");
    let absent = json!({ "command": { "program": ["./no-such-program"] } });
    let reason = refused(here, &settings(here, "campaign", absent));
    assert!(reason.contains("./no-such-program: cannot be started"), "{reason}");
    let slow = json!({ "command": { "program": ["sleep", "600"], "time_limit": "1s" } });
    let reason = refused(here, &settings(here, "campaign", slow));
    assert!(reason.contains("(refit.method.command.time_limit)"), "{reason}");

    write_model(&here.join("nan.npz"), "energy_mlp_W1", |_| f64::NAN);
    let reason = refused(here, &by(&copy_of("nan.npz")));
    assert!(reason.contains("not finite") || reason.contains("cannot be read"), "{reason}");
    write_model(&here.join("rough.npz"), "output_scale", |scale| 5.0 * scale);
    let reason = refused(here, &by(&copy_of("rough.npz")));
    assert!(reason.contains("the force MAE on the replay data is "), "{reason}");
    assert!(reason.contains("expected at most 3 times (refit.max_replay_error_ratio)"), "{reason}");
    let all = versions(&here.join("campaign"));
    assert_eq!(all.last().unwrap().figures["sets"].as_array().unwrap().len(), 3);
}

fn text(frame: &Frame, key: &str) -> String {
    frame.info[key].text().unwrap().to_owned()
}

fn ids(frames: &[Frame]) -> Vec<String> {
    frames.iter().map(|frame| text(frame, "candidate_id")).collect()
}

#[test]
fn no_label_of_a_held_out_seed_structure_is_trained_on() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let export = |output: &str| {
        succeed(here, ["export", "campaign", "--control", "--output", output]);
        read_extxyz(&here.join(output)).unwrap()
    };
    let of_vacancy = |frame: &&Frame| text(frame, "seed_structure") == "vacancy";
    let excluded = text(export("all.extxyz").iter().find(of_vacancy).unwrap(), "candidate_id");
    succeed(here, ["exclude", "campaign", &excluded, "--reason", "a test"]);

    // A file of the configuration with another content is no reason to refuse a version.
    let keep = format!(
        "test \"$CALMWALK_REPLAY\" = '{}' && cp \"$CALMWALK_TRAIN\" \"$CALMWALK_HELD_OUT\" '{}' && \
         cp \"$CALMWALK_PARENT_MODEL\" \"$CALMWALK_REFIT_DIRECTORY/model.npz\" && test -s \"$CALMWALK_PARENT_MIXTURE\"",
        here.join("replay.extxyz").display(),
        here.display()
    );
    let mut wanted = settings(here, "campaign", script(&keep));
    let replay = wanted["settings"]["replay"][0]["hash"].take();
    wanted["settings"]["replay"][0]["hash"] = "0".repeat(64).into();
    let output = refit(here, &wanted);
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert!(stderr(&output).contains("replay.extxyz: the file has another content"), "{}", stderr(&output));
    assert_eq!(versions(&here.join("campaign")), []);

    wanted["settings"]["replay"][0]["hash"] = replay;
    // The parent's model has the parent's errors.
    wanted["settings"]["max_held_out_error_ratio"] = 1.0.into();
    let output = refit(here, &wanted);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let all = versions(&here.join("campaign"));
    let [version] = &all[..] else { panic!("one version") };
    assert_eq!((version.state, &*version.reason), (VersionState::Registered, ""));
    assert!(files(&here.join("campaign"), 1).model == fs::read(config(MODEL)).unwrap());

    let [training, held_out] =
        ["train.extxyz", "held_out.extxyz"].map(|name| read_extxyz(&here.join(name)).unwrap());
    let names = |frames: &[Frame]| -> BTreeSet<String> {
        frames.iter().map(|frame| text(frame, "seed_structure")).collect()
    };
    assert_eq!(names(&training), BTreeSet::from(["vacancy".to_owned()]));
    assert_eq!(names(&held_out), BTreeSet::from(["fcc-100".to_owned()]));
    assert_eq!(training.len() as u64, version.labels);
    // Both are what an export writes, in its order.
    let left = export("left.extxyz");
    assert!(!ids(&left).contains(&excluded));
    let (of_vacancy, others): (Vec<_>, Vec<_>) =
        left.into_iter().partition(|frame| text(frame, "seed_structure") == "vacancy");
    assert_eq!((ids(&training), ids(&held_out)), (ids(&of_vacancy), ids(&others)));
    assert!(training.iter().any(|frame| text(frame, "origin") == "control"));
}

/// A label that was pending when the training set was fixed judges the version, although its decision is an early one.
#[test]
fn labels_that_come_while_a_version_is_trained_judge_it() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    succeed(here, ["export", "campaign", "--control", "--output", "all.extxyz"]);
    let first = text(&read_extxyz(&here.join("all.extxyz")).unwrap()[0], "candidate_id");
    // Excluded labels are in no set, and included ones in the next.
    succeed(here, ["exclude", "campaign", &first, "--reason", "a test"]);
    let include = format!(
        "'{}' exclude '{}' '{first}' --undo && cp \"$CALMWALK_PARENT_MODEL\" model.npz",
        env!("CARGO_BIN_EXE_calmwalk"),
        here.join("campaign").display()
    );
    let output = refit(here, &settings(here, "campaign", script(&include)));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let all = versions(&here.join("campaign"));
    let sets = all[0].figures["sets"].as_array().unwrap();
    let since: Vec<_> = sets.iter().filter(|set| set["kind"] == "since").collect();
    // A structure that two walks found has one label, and is in the export of both.
    let again = ids(&read_extxyz(&here.join("all.extxyz")).unwrap());
    let [since] = since[..] else { panic!("one set of labels since: {sets:?}") };
    let structures = since["structures"].as_u64().unwrap() as usize;
    assert!((1..again.len()).contains(&structures), "{since}");
}

#[test]
fn energies_far_from_the_others_are_told_and_recorded() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let mut frames = read_extxyz(&here.join("replay.extxyz")).unwrap();
    let mut labels = frames[1].labels().unwrap();
    labels.energy = labels.energy.map(|energy| energy + 100.0);
    frames[1].set_labels(&labels, LabelKeys::Ase);
    write_frames(&here.join("replay.extxyz"), &frames);
    let native = json!({ "native": { "epochs": 1, "learning_rate": 1e-3, "validation_share": 0.0 } });
    let output = refit(here, &settings(here, "campaign", native));
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(
        said.contains("refit 1: training: the energies of 1 structure are far from the others'"),
        "{said}"
    );
    let all = versions(&here.join("campaign"));
    let training = &all[0].figures["training"];
    // Frames of 108 atoms have 110 lines.
    assert_eq!(training["energy_spread"]["far"][0]["place"], "replay.extxyz:111", "{training}");
    assert_eq!(training["energy_zero"]["shifts"], json!([]));
}

/// Test sets may change while a refit is interrupted.
#[test]
fn errors_are_those_of_the_test_sets_as_they_are() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let native = json!({ "native": { "epochs": 1, "learning_rate": 1e-3, "validation_share": 0.0 } });
    let structures = |sets: &Json| sets[0]["structures"].as_u64();
    kill_at(here, &settings(here, "campaign", native.clone()), &here.join("campaign/refit/1/errors.json"));
    let kept = fs::read(here.join("campaign/refit/1/errors.json")).unwrap();
    assert_eq!(structures(&serde_json::from_slice(&kept).unwrap()), Some(3));
    let frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    write_frames(&here.join("test.extxyz"), &frames[REPLAY..REPLAY + 2]);
    let output = refit(here, &settings(here, "campaign", native));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let all = versions(&here.join("campaign"));
    assert_eq!(structures(&all[0].figures["sets"]), Some(2), "{}", all[0].figures);
}

#[test]
fn the_program_ends_with_the_refit_that_is_stopped_or_killed() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let refits = here.join("campaign/refit");
    let endless = settings(here, "campaign", script("touch begun; sleep 600 & sleep 600"));
    for kind in ["KILL", "TERM"] {
        let _ = fs::remove_file(refits.join("1/begun"));
        let mut running = Running(start(here, &endless));
        wait_until("the program runs", || refits.join("1/begun").exists());
        signal(running.0.id(), kind);
        let code = running.0.wait().unwrap().code();
        assert_eq!(code, (kind == "TERM").then_some(130), "{kind}");
        wait_until("its processes have ended", || calculation_processes(&refits).is_empty());
        assert!(refits.join("1/labels.json").exists() && versions(&here.join("campaign")).is_empty());
    }
    // The same refit goes on.
    let copy = format!("cp '{}' model.npz", config(MODEL).display());
    let output = refit(here, &settings(here, "campaign", script(&copy)));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(versions(&here.join("campaign"))[0].state, VersionState::Registered);
}
