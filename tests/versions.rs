//! `calmwalk versions` and `calmwalk refit`.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use calm::Artifact;
use serde_json::{Value, json};
use store::{CampaignLock, CampaignRecord, Commit, Store, VersionFiles, VersionRecord, VersionState};
use tempfile::TempDir;
use wire::CampaignId;

use crate::common::campaign::Small;
use crate::common::processes::wait_until;
use crate::common::{Running, calmwalk, config, program, refuse, stderr, succeed};

const MODEL: &str = "data/al_eam_1l/kokkos.npz";
const MIXTURE: &str = "data/al_eam_1l/gmm_artifacts.npz";

fn real(path: &str) -> Vec<u8> {
    fs::read(config(path)).unwrap()
}

fn hash(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_string()
}

fn real_files() -> VersionFiles {
    VersionFiles { model: real(MODEL), mixture: real(MIXTURE) }
}

fn small_files(number: u32) -> VersionFiles {
    let bytes = |name: &str| format!("{name} of version {number}").into_bytes();
    VersionFiles { model: bytes("model"), mixture: bytes("mixture") }
}

/// Force MAE of version 0, the parent and the version on a data set.
fn set(name: &str, structures: u64, errors: [f64; 3]) -> Value {
    let [first, parent, version] =
        errors.map(|error| json!({ "energy_mae": 0.1 * error, "force_mae": error }));
    json!({ "name": name, "kind": name, "structures": structures, "first": first, "parent": parent,
            "version": version })
}

fn record(number: u32, parent: u32, sets: Value, files: Option<&VersionFiles>) -> VersionRecord {
    let hashes = files.map(|files| [&files.model, &files.mixture].map(|bytes| hash(bytes)));
    let [model_hash, mixture_hash] = hashes.unwrap_or_default();
    VersionRecord {
        number,
        parent,
        state: if files.is_some() { VersionState::Registered } else { VersionState::Refused },
        reason: if files.is_some() { String::new() } else { "the loss is not finite".into() },
        method: "native".into(),
        structures: 50 * u64::from(number),
        last_decision: 70 * i64::from(number),
        labels: 40 * u64::from(number),
        model_hash,
        mixture_hash,
        figures: json!({ "sets": sets, "training": { "epochs": 5 } }),
        seconds: 12.0,
        core_hours: 0.25,
        time: 951_827_696_000,
    }
}

/// Does something with the campaign in `here`.
fn on_store<T>(here: &Path, act: impl AsyncFnOnce(&Store) -> T) -> T {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open(&here.join("here")).await.unwrap();
        let done = act(&store).await;
        store.close().await;
        done
    })
}

/// A campaign without walks in `here`, whose files of version 0 are those of the demo.
fn campaign(mode: &str) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let location = directory.path().join("here");
    fs::create_dir(&location).unwrap();
    let files = json!({ "potential.model": hash(&real(MODEL)), "calm.artifact": hash(&real(MIXTURE)) });
    let campaign = CampaignRecord {
        id: CampaignId([7; 16]),
        program_version: "0.1.0".into(),
        mode: mode.into(),
        configuration: String::new(),
        resolved_configuration: json!({ "files": files }).to_string(),
        configuration_in_force: "{}".into(),
    };
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::create(&location, &campaign, &[], 0).await.unwrap();
        let paths = json!({ "potential.model": config(MODEL), "calm.artifact": config(MIXTURE) });
        store.set_grade_files(&paths).await.unwrap();
        store.close().await;
    });
    directory
}

/// Version 1, which is in force; version 2, which was refused; version 3, which no walk uses yet.
fn three_versions(mode: &str) -> TempDir {
    let directory = campaign(mode);
    on_store(directory.path(), async |store| {
        for (number, parent, held_out, errors) in
            [(1, 0, 3, [0.4, 0.4, 0.3]), (2, 1, 5, [0.5, 0.4, 0.9]), (3, 1, 6, [0.5, 0.4, 0.1])]
        {
            let files = (number != 2).then(|| small_files(number));
            let sets = json!([set("held_out", held_out, errors), set("replay", 9, [0.02, 0.02, 0.04])]);
            let record = record(number, parent, sets, files.as_ref());
            store.add_version(&record, files.as_ref()).await.unwrap();
        }
        let values = vec![("version".to_owned(), "1".to_owned())];
        store.commit(&Commit { values, ..Commit::default() }).await.unwrap();
    });
    directory
}

fn json_of<const N: usize>(here: &Path, arguments: [&str; N]) -> Value {
    let output = succeed(here, ["versions", "here"].into_iter().chain(arguments).chain(["--json"]));
    serde_json::from_str(&output).unwrap()
}

fn words(line: &str) -> Vec<&str> {
    line.split_whitespace().collect()
}

#[test]
fn versions_are_listed_and_shown_with_their_errors() {
    let directory = three_versions("reproducible");
    let here = directory.path();
    let list = succeed(here, ["versions", "here"]);
    let lines: Vec<_> = list.lines().collect();
    assert_eq!(
        words(lines[1]),
        ["0", "registered", "–", "configuration", "–", "–", "–", "–", "0.4000", "0.0200"]
    );
    let first = ["1", "registered,", "in", "force", "0", "native", "40", "12", "s", "0.25"];
    let date = ["2000-02-29", "12:34", "UTC"];
    assert_eq!(words(lines[2]), [&first[..], &date[..], &["0.3000", "0.0400"][..]].concat());
    assert!(lines[3].contains("refused") && lines[4].contains("registered, not taken up"), "{list}");
    assert_eq!(lines[5], "version 2 was refused: the loss is not finite");
    assert_eq!(succeed(here, ["versions", "here", "list"]), list);
    let json = json_of(here, []);
    assert_eq!((&json["in_force"], &json["not_taken_up"]), (&json!(1), &json!(3)));
    let refused = &json["versions"][2];
    assert_eq!((&refused["state"], &refused["force_mae"]["held_out"]), (&json!("refused"), &json!(0.9)));
    assert_eq!(json["versions"][0]["parent"], Value::Null);

    let shown = succeed(here, ["versions", "here", "show", "3"]);
    let row = shown.lines().find(|line| line.contains("held_out") && line.contains("force MAE")).unwrap();
    let expected = ["held_out", "6", "force", "MAE", "(eV/Å)", "0.4000", "0.1000", "0.25", "version", "3"];
    assert_eq!(words(row), expected, "{shown}");
    let model = hash(b"model of version 3");
    for part in ["version 3: registered, not taken up", model.as_str(), "epochs 5", "none yet"] {
        assert!(shown.contains(part), "{shown}");
    }
    let shown = json_of(here, ["show", "0"]);
    assert_eq!((&shown["model_hash"], &shown["in_force"]), (&json!(hash(&real(MODEL))), &json!(false)));
    assert!(succeed(here, ["versions", "here", "show", "2"]).contains("the loss is not finite"));
    assert!(refuse(here, ["versions", "here", "show", "4"]).contains("no version 4: expected 0 to 3"));
}

#[test]
fn versions_are_compared_on_sets_of_as_many_structures() {
    let directory = three_versions("reproducible");
    let here = directory.path();
    // The parent, on the structures of its child.
    let sets = &json_of(here, ["compare", "1", "3"])["sets"];
    assert_eq!((&sets[0]["structures"], &sets[0]["better"]), (&json!([6, 6]), &json!(3)));
    assert_eq!(sets[0]["errors"][0]["force_mae"], 0.4);
    assert_eq!(json_of(here, ["compare", "3", "0"])["sets"][0]["force_mae_ratio"], 5.0);
    // Siblings, each on its own.
    let text = succeed(here, ["versions", "here", "compare", "2", "3"]);
    assert!(text.contains("version 2 was judged by 5 structures and version 3 by 6"), "{text}");
    let row = text.lines().find(|line| line.contains("held_out") && line.contains("force MAE")).unwrap();
    assert_eq!(words(row), ["held_out", "5", "/", "6", "force", "MAE", "(eV/Å)", "0.9000", "0.1000", "–"]);
    assert!(refuse(here, ["versions", "here", "compare", "1", "9"]).contains("no version 9"));
}

#[test]
fn an_exported_version_has_the_bytes_of_the_store_and_replaces_nothing() {
    let directory = campaign("live");
    let here = directory.path();
    on_store(here, async |store| {
        let files = real_files();
        store.add_version(&record(1, 0, json!([]), Some(&files)), Some(&files)).await.unwrap();
    });
    let export = ["versions", "here", "export", "1", "--output-dir", "out/1", "--embed", "out/lammps.npz"];
    let said = succeed(here, export);
    assert_eq!(said, "wrote out/1/kokkos.npz\nwrote out/1/gmm_artifacts.npz\nwrote out/lammps.npz\n");
    assert_eq!(fs::read(here.join("out/1/kokkos.npz")).unwrap(), real(MODEL));
    assert_eq!(fs::read(here.join("out/1/gmm_artifacts.npz")).unwrap(), real(MIXTURE));
    let embedded = Artifact::load_export(here.join("out/lammps.npz")).unwrap().mixture;
    let original = Artifact::load(config(MIXTURE)).unwrap().mixture;
    assert_eq!(embedded.iter().count(), original.iter().count());

    fs::remove_file(here.join("out/1/kokkos.npz")).unwrap();
    let said = succeed(here, export);
    assert!(said.starts_with("wrote out/1/kokkos.npz\nout/1/gmm_artifacts.npz already exists"), "{said}");
    fs::remove_file(here.join("out/1/kokkos.npz")).unwrap();
    fs::write(here.join("out/1/gmm_artifacts.npz"), "another").unwrap();
    let message = refuse(here, export);
    assert!(message.contains("out/1/gmm_artifacts.npz exists and has another content"), "{message}");
    assert!(!here.join("out/1/kokkos.npz").exists());

    let json = json_of(here, ["export", "0", "--output-dir", "0"]);
    assert_eq!(json["files"][0], json!({ "path": "0/kokkos.npz", "written": true }));
    assert_eq!(fs::read(here.join("0/gmm_artifacts.npz")).unwrap(), real(MIXTURE));
    let message = refuse(here, ["versions", "here", "export", "2", "--output-dir", "2"]);
    assert!(message.contains("no version 2: expected 0 to 1"), "{message}");
}

#[test]
fn an_earlier_version_is_registered_again() {
    let directory = three_versions("reproducible");
    let here = directory.path();
    for (number, reason) in [
        ("3", "version 3 is the newest one"),
        ("2", "version 2 was refused and has no files: the loss is not finite"),
        ("8", "no version 8"),
    ] {
        let message = refuse(here, ["versions", "here", "roll-back", number]);
        assert!(message.contains(reason), "{message}");
    }
    let lock = CampaignLock::acquire(&here.join("here"), "calmwalk run").unwrap();
    assert!(refuse(here, ["versions", "here", "roll-back", "1"]).contains("is being run by"));
    drop(lock);
    let before = fs::read(here.join("here/campaign.sqlite")).unwrap();
    let said = succeed(here, ["versions", "here", "roll-back", "1", "--dry-run"]);
    assert_eq!(said, "would register version 4: version 1 again\nnothing was changed\n");
    assert!(fs::read(here.join("here/campaign.sqlite")).unwrap() == before);
    let said = succeed(here, ["versions", "here", "roll-back", "1"]);
    let expected = "registered version 4: version 1 again\nthe next calmwalk run restarts all walks from their seed structures with it\n";
    assert_eq!(said, expected);
    let (versions, files) = on_store(here, async |store| {
        (store.versions().await.unwrap(), store.version_files(4).await.unwrap().unwrap())
    });
    let VersionRecord { parent, method, structures, labels, last_decision, .. } = &versions[3];
    assert_eq!((*parent, method.as_str(), files), (1, VersionRecord::ROLLBACK, small_files(1)));
    // Refits count from the last attempt; the training set is that of version 1.
    assert_eq!((*structures, *labels, *last_decision), (150, 40, 70));
    let sets = &json_of(here, ["compare", "1", "4"])["sets"];
    assert_eq!((&sets[0]["force_mae_ratio"], &sets[0]["better"]), (&json!(1.0), &Value::Null));
    assert!(refuse(here, ["versions", "here", "roll-back", "1"]).contains("is version 1 again"));
    assert_eq!(json_of(here, ["roll-back", "3"])["version"], 5);
}

#[test]
fn a_running_live_campaign_may_go_back() {
    let directory = three_versions("live");
    let here = directory.path();
    let _lock = CampaignLock::acquire(&here.join("here"), "calmwalk run").unwrap();
    let said = succeed(here, ["versions", "here", "roll-back", "0"]);
    assert!(
        said.starts_with(
            "registered version 4: version 0 again\nall walks restart from their seed structures"
        ),
        "{said}"
    );
    assert_eq!(on_store(here, async |store| store.version_files(4).await.unwrap()), Some(real_files()));
}

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

#[test]
fn walks_do_not_find_again_what_they_found_before_the_campaign_went_back() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small { max_per_walk: 2, ..Small::default() }.write(here);
    succeed(here, RUN);
    let accepted = on_store(here, async |store| {
        let files = real_files();
        store.add_version(&record(1, 0, json!([]), Some(&files)), Some(&files)).await.unwrap();
        store.accepted_structures().await.unwrap()
    });
    assert!(accepted > 0);
    let done = json_of(here, ["roll-back", "0"]);
    let candidates = &done["candidates"];
    let number = |key: &str| candidates[key].as_u64().unwrap();
    assert_eq!((number("applied") + number("covered"), number("left_out")), (accepted, 0));
    assert!(number("applied") > 0, "{done}");
    let files = on_store(here, async |store| store.version_files(2).await.unwrap().unwrap());
    assert_eq!(files.model, real(MODEL));
    assert_ne!(files.mixture, real(MIXTURE));

    let before = json_of(here, ["show", "0"]);
    succeed(here, RUN);
    assert_eq!(json_of(here, [])["in_force"], 2);
    let found = &json_of(here, ["show", "2"])["found"];
    assert!(found["biased_walks"].as_object().is_some_and(|walks| !walks.is_empty()), "{found}");
    assert_eq!(json_of(here, ["show", "0"])["found"], before["found"]);
    assert_eq!(before["found"]["candidates"]["accepted"], accepted);

    let message = refuse(here, ["refit", "here"]);
    assert!(message.contains("has no section [refit]") && message.contains("replay = "), "{message}");
}

/// Writes a configuration with a training program that fails, and starts it. Returns when a walk has begun.
fn begun(small: Small, here: &Path) -> Running {
    let path = small.write(here);
    let replay = config("data/al_eam_1l/seed_frames.extxyz");
    let refit = format!(
        "[refit]\nreplay = [\"{}\"]\nheld_out = 0.0\nmethod = {{ command = {{ program = [\"/bin/false\"] }} }}\n",
        replay.display()
    );
    fs::write(&path, fs::read_to_string(&path).unwrap() + &refit).unwrap();
    let mut command = program(here);
    let command = command.args(RUN).arg("--in-process").stdout(Stdio::null()).stderr(Stdio::null());
    let running = Running(command.spawn().unwrap());
    let accepted = || {
        let status = calmwalk(here, ["status", "here", "--json"]);
        let status = serde_json::from_slice::<Value>(&status.stdout).unwrap_or_default();
        status["candidates"]["accepted"].as_u64().unwrap_or(0)
    };
    wait_until("a structure is accepted", || accepted() > 0);
    running
}

#[test]
fn a_version_is_trained_beside_a_live_campaign_once_for_what_is_new() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { mode: "live", steps: 100_000, max_per_walk: 1_000, ..Small::default() };
    let running = begun(small, here);
    let output = calmwalk(here, ["refit", "here"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("version 1 was refused: "), "{said}");
    drop(running);
    // Another attempt after what the walks have found meanwhile, and none without anything new.
    calmwalk(here, ["refit", "here"]);
    let said = succeed(here, ["refit", "here"]);
    assert_eq!(
        said,
        "nothing is new since the last attempt: no structure was accepted, and the labels are the same\n"
    );
    let list = json_of(here, []);
    assert_eq!((&list["versions"][1]["state"], &list["in_force"]), (&json!("refused"), &json!(0)));
    fs::rename(here.join("campaign.toml"), here.join("moved.toml")).unwrap();
    assert!(refuse(here, ["refit", "here"]).contains("--config CONFIG"));
    succeed(here, ["refit", "here", "--config", "moved.toml"]);
}

#[test]
fn a_reproducible_campaign_trains_when_its_walks_have_ended() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { steps: 100_000, max_per_walk: 1_000, ..Small::default() };
    let running = begun(small, here);
    assert!(refuse(here, ["refit", "here"]).contains("is being run by"));
    drop(running);
    let message = refuse(here, ["refit", "here"]);
    assert!(message.contains("of this reproducible campaign have not ended"), "{message}");
}
