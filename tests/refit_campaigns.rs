//! Campaigns with `[refit]` from their begin to their end: live mode, agents, a refit by hand, a small improvement, wrong labels.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use atoms::extxyz::Frame;
use atoms::read_extxyz;
use serde_json::Value as Json;
use store::{ExportFilter, ExportSource, Fate};
use wire::Origin;

use crate::common::campaign::{Outcome, Small, outcome};
use crate::common::hosts::{Hosts, uninterrupted_outcome};
use crate::common::label_campaign::{LabelCampaign, WRITE_FIXED_LABEL, on_store};
use crate::common::processes::{
    assert_no_leftovers, pause_walkers, processes_running, signal, wait_for_process, wait_until,
};
use crate::common::{Running, calmwalk, config, deviation, program, stderr, succeed, write_frames};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "."];

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Json {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

/// Number and state of each version and attempt.
fn states(outcome: &Outcome) -> Vec<(u32, &str)> {
    outcome.versions.iter().map(|version| (version.number, version.state.name())).collect()
}

/// Walks without an end: the campaign ends when the second version is there. At least eight structures are found between two refits.
const WITHOUT_END: &str = r#"
[refit]
replay = ["replay.extxyz"]
after_structures = 8
max_versions = 2
held_out = 0.0
method = { native = { epochs = 2, learning_rate = 1e-3, validation_share = 0.0 } }
"#;

#[test]
fn a_live_campaign_ends_with_its_last_version() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small =
        Small { mode: "live", steps: 100_000, max_per_walk: 1_000, refit: WITHOUT_END, ..Small::default() };
    // A control walk would run to its end.
    let text = small.text().replacen("rng_seed = 7\n", "rng_seed = 7\ncontrol = false\n", 1);
    fs::write(small.write(here), text).unwrap();
    let said = succeed(here, RUN);
    assert!(said.contains("2 versions of the potential trained (refit.max_versions)"), "{said}");

    // Each accepted structure has one label, also those that were found just before the end.
    let outcome = outcome(here);
    assert_eq!(states(&outcome), [(1, "registered"), (2, "registered")]);
    let [first, second] = &outcome.versions[..] else { panic!("two versions") };
    assert!(first.labels > 0 && second.labels > first.labels, "{first:?} {second:?}");
    let found = [0, 1, 2].map(|number| json(here, ["versions", ".", "show", &number.to_string()]));
    let accepted = found.each_ref().map(|one| one["found"]["candidates"]["accepted"].as_u64().unwrap_or(0));
    assert!(accepted[0] >= 8 && accepted[1] > 0 && accepted[2] == 0, "{accepted:?}");
    assert_eq!(accepted.iter().sum::<u64>(), json(here, ["status", "."])["candidates"]["accepted"]);
    let checked = succeed(here, ["store", "check", "."]);
    assert!(checked.contains("no problems found"), "{checked}");
    assert_no_leftovers(here);
}

#[test]
fn an_agent_takes_new_versions_up() {
    let small = Small::with_two_versions();
    let mut hosts = Hosts::new(&small, 1, "");
    // The file tells the agent when the campaign is over.
    let endpoint = hosts.home.path().join("endpoint").display().to_string();
    hosts.options[0] = vec!["--announce".into(), endpoint.clone()];
    hosts.endpoints[1] = format!("@{endpoint}");
    let mut orchestrator = hosts.start_orchestrator();
    // The walks must not end before the agent joins.
    let held = pause_walkers(hosts.home.path(), 1);
    let mut agent = hosts.agent(0);
    let joined = |times: usize| hosts.said(0).matches("joined: 1 walker,").count() == times;
    wait_until("the agent has joined", || joined(1));
    held.resume();
    wait_until("there is another version", || {
        hosts.orchestrator_stderr().contains("version 1 of the potential is in force")
    });
    let held = pause_walkers(hosts.home.path(), 1);
    wait_until("the agent has joined again", || joined(2));
    held.resume();
    assert_eq!(orchestrator.0.wait().unwrap().code(), Some(0), "{}", hosts.orchestrator_stderr());
    assert_eq!(agent.0.wait().unwrap().code(), Some(0), "{}", hosts.said(0));
    assert!(hosts.said(0).contains("no more walks with this version of the potential"), "{}", hosts.said(0));
    assert_eq!(outcome(hosts.home.path()), uninterrupted_outcome(&small));
    hosts.assert_cleaned_up();
}

#[test]
fn a_version_trained_by_hand_is_that_which_the_run_would_have_trained() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small::with_two_versions();
    small.write(here);
    let mut command = program(here);
    let child = command.args(RUN).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let mut running = Running(child);
    wait_for_process(here, "refitter");
    signal(running.0.id(), "INT");
    assert_eq!(running.0.wait().unwrap().code(), Some(130));
    let said = succeed(here, ["refit", "."]);
    assert!(said.starts_with("version 1 is registered, trained on "), "{said}");

    // A file of the version with another content is written again.
    fs::create_dir_all(here.join("versions/1")).unwrap();
    fs::write(here.join("versions/1/kokkos.npz"), "no model").unwrap();
    succeed(here, RUN);
    assert_eq!(outcome(here), uninterrupted_outcome(&small));
    let replayed = json(here, ["replay", "."]);
    assert_eq!(
        (&replayed["difference"], &replayed["same_mixture"]),
        (&Json::Null, &true.into()),
        "{replayed}"
    );
    check_export(here);
}

/// The exported model and mixture give a structure the grades that the walker gave it.
fn check_export(here: &Path) {
    let (candidates, versions) = on_store(here.into(), async |store| {
        (store.candidates(0, false, u32::MAX).await.unwrap(), store.walk_versions().await.unwrap())
    });
    let last = candidates.iter().rfind(|candidate| candidate.fate == Fate::Accepted).unwrap();
    let candidate = last.block.view().to_candidate();
    assert_eq!(versions.of_candidate(&candidate.id.to_string()), 1);
    let frame = Frame::from(candidate.structure.clone());
    write_frames(&here.join("found.extxyz"), &[frame]);

    let version = candidate.mixture_version.to_string();
    let files = ["--output", "mixture.npz", "--embed", "model.npz"];
    succeed(here, ["calm", "export", ".", "--version", &version].into_iter().chain(files));
    let info = succeed(here, ["calm", "info", "mixture.npz"]);
    assert!(info.contains("Al"), "{info}");
    let info = succeed(here, ["calm", "info", "model.npz"]);
    assert!(info.contains("upfit, on "), "{info}");
    let graded = |model: &str| {
        succeed(here, ["calm", "score", "--model", model, "found.extxyz", "--output", "graded.extxyz"]);
        let frames = read_extxyz(&here.join("graded.extxyz")).unwrap();
        deviation(&frames[0].arrays["gamma"].reals().unwrap(), &candidate.gamma)
    };
    // Numbers of an artifact have single precision.
    let found = graded("model.npz");
    assert!(found < 1e-3, "{found}");
    let by_first = graded(config("data/al_eam_1l/kokkos.npz").to_str().unwrap());
    assert!(by_first > 1e-2, "{by_first}");
}

/// No version falls by 100 times its error.
const CONVERGED: &str = r#"
[refit]
replay = ["replay.extxyz"]
after_structures = 3
max_versions = 9
held_out = 0.5
max_held_out_error_ratio = 10.0
method = { native = { epochs = 1, learning_rate = 1e-3, validation_share = 0.0 } }
[stop]
min_improvement = 100.0
"#;

#[test]
fn a_campaign_ends_when_a_version_improves_too_little() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small { refit: CONVERGED, ..Small::default() }.write(here);
    let summary = succeed(here, RUN);
    let reason = ["the held-out force error of version 1 ", " per 100 labels (stop.min_improvement)"];
    let names_reason = |text: &str| reason.iter().all(|part| text.contains(part));
    assert!(names_reason(&summary), "{summary}");
    let status = succeed(here, ["status", "."]);
    assert!(names_reason(&status), "{status}");
    let end = &json(here, ["status", "."])["end_reason"];
    assert_eq!((&end["kind"], &end["version"]), (&"small_improvement".into(), &1.into()), "{end}");
    // No walk runs with it, also not after another run.
    let decisions = || on_store(here.into(), async |store| store.decision_log_text().await.unwrap());
    let before = decisions();
    assert!(names_reason(&succeed(here, RUN)));
    assert_eq!(decisions(), before);
    let versions = json(here, ["versions", "."]);
    assert_eq!((&versions["in_force"], &versions["not_taken_up"]), (&0.into(), &1.into()), "{versions}");
    assert_eq!(states(&outcome(here)), [(1, "registered")]);
}

const OFTEN: &str = r#"
[refit]
replay = ["replay.extxyz"]
after_structures = 2
max_versions = 1
held_out = 0.0
method = { native = { epochs = 1, learning_rate = 1e-3, validation_share = 0.0 } }
"#;

/// Gives structures with a vacancy an energy that nothing explains.
const LABEL: &str = r#"
awk '
    NR == 1 { energy = $1 == 47 ? -1e9 : -1.5; print; next }
    NR == 2 { sub(/Properties=[^ ]*/, "Properties=species:S:1:pos:R:3:forces:R:3"); print $0 " energy=" energy; next }
    { print $0, 0.25, 0, 0 }
' structure.extxyz > unfinished
mv unfinished label.extxyz
"#;

#[test]
fn a_campaign_goes_on_with_its_version_when_labels_give_no_other() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { max_per_walk: 3, refit: OFTEN, ..Small::default() };
    let keys = "[label]\nmax_energy_per_atom = 1e8\nmax_energy_difference_per_atom = 1e8\n";
    let method =
        r#"method = { command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } } # "#;
    let text = small.text().replacen("[label]\nmethod = ", &format!("{keys}{method}"), 1);
    fs::write(small.write(here), text).unwrap();
    fs::write(here.join("label.sh"), LABEL).unwrap();
    let summary = succeed(here, RUN);
    let outcome = outcome(here);
    assert_eq!(states(&outcome), [(1, "refused"), (2, "refused"), (3, "refused")], "{summary}");
    for version in &outcome.versions {
        let reason = &version.reason;
        assert!(reason.starts_with("train.extxyz:1 (candidate "), "{reason}");
        assert!(reason.contains("): the energy differs from the model's by -2.1277e7 eV/atom"), "{reason}");
        assert!(summary.contains(reason.as_str()), "{summary}");
    }
    train_without_excluded(here, outcome.versions.len());
    // The walks go on after each of them.
    let [first, .., last] = &outcome.versions[..] else { panic!("three attempts") };
    assert!(last.structures > first.structures && last.last_decision > first.last_decision);
    let taken_up = on_store(here.into(), async |store| store.decisions_of_kind("version").await.unwrap());
    assert_eq!(taken_up, []);
    assert_eq!(json(here, ["versions", "."])["in_force"], 0);
}

/// Excludes the bad labels of a campaign whose walks have all ended, after this number of attempts. Each change of the labels makes
/// another attempt, and nothing else does.
fn train_without_excluded(here: &Path, attempts: usize) {
    let bad: Vec<String> = on_store(here.into(), async |store| {
        let protocol = store.protocols().await.unwrap()[0].hash;
        let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
        let rows = store.labelled(&filter, None, u32::MAX).await.unwrap().into_iter();
        let bad = rows.filter(|row| row.label.energy < -1e6).map(|row| match row.source {
            ExportSource::Candidate { id, .. } => id,
            ExportSource::Import { .. } => panic!("an import"),
        });
        bad.collect()
    });
    assert!(bad.len() > 1, "{bad:?}");
    let made = || on_store(here.into(), async |store| store.versions().await.unwrap());
    let nothing_new = || {
        assert!(succeed(here, ["refit", "."]).starts_with("nothing is new since the last attempt: "));
        succeed(here, RUN);
    };
    nothing_new();
    assert_eq!(made().len(), attempts);
    succeed(here, ["exclude", ".", &bad[0], "--reason", "a test"]);
    let output = calmwalk(here, ["refit", "."]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert_eq!(made().len(), attempts + 1);
    for id in &bad[1..] {
        succeed(here, ["exclude", ".", id, "--reason", "a test"]);
    }
    succeed(here, RUN);
    let versions = made();
    let [.., before, last] = &versions[..] else { panic!("attempts") };
    assert_eq!(versions.len(), attempts + 2);
    assert!(before.reason.contains("the energy differs"), "{}", before.reason);
    assert!(!last.reason.contains("the energy differs") && last.labels < before.labels, "{last:?}");
    succeed(here, RUN);
    assert_eq!(made().len(), attempts + 2);
}

/// Starts a live campaign whose first label is made at once, and all others when the file `go` is there. `keys` of `[collect]`.
fn live_with_late_labels(small: &Small, collect: &str) -> LabelCampaign {
    let script = "mkdir \"$PLACE/first\" 2>/dev/null || while [ ! -e \"$PLACE/go\" ]; do sleep 0.05; done\n";
    let method =
        r#"method = { command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } } # "#;
    let collect = format!("[collect]\n{collect}");
    let place = LabelCampaign::new(
        small,
        &[("[label]\nmethod = ", &format!("[label]\n{method}")), ("[collect]\n", &collect)],
    );
    let script = script.replace("$PLACE", place.path().to_str().unwrap());
    fs::write(place.path().join("label.sh"), format!("{script}{WRITE_FIXED_LABEL}")).unwrap();
    place
}

/// Waits until the campaign has a label and this is so.
fn wait_for_label(place: &LabelCampaign, what: &str, is_so: impl Fn(&Json) -> bool) {
    wait_until(what, || {
        let status = place.status();
        status["labels"]["labelled"].as_u64() >= Some(1) && is_so(&status)
    });
}

/// Whether all walks have ended, the control walks among them.
fn have_all_walks_ended(status: &Json) -> bool {
    let walks = status["walks"].as_array().map_or(&[][..], Vec::as_slice);
    let has_ended =
        |walk: &Json| !["running", "waiting"].contains(&walk["state"].as_str().unwrap_or_default());
    walks.iter().any(|walk| walk["origin"] == "control") && walks.iter().all(has_ended)
}

/// Each attempt fails.
const REFUSED: &str = r#"
[refit]
replay = ["replay.extxyz"]
held_out = 0.0
method = { command = { program = ["false"] } }
"#;

/// An attempt with few labels, as with slow calculations, is followed by one with all of them, though nothing is found meanwhile.
#[test]
fn labels_that_come_after_an_attempt_are_trained_on() {
    let small = Small { mode: "live", max_per_walk: 2, refit: REFUSED, ..Small::default() };
    let place = live_with_late_labels(&small, "");
    let mut run = place.run();
    wait_for_label(&place, "all walks have ended", have_all_walks_ended);
    let output = calmwalk(place.path(), ["refit", place.argument()]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    fs::write(place.path().join("go"), "").unwrap();
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
    let versions = on_store(place.location(), async |store| store.versions().await.unwrap());
    let [first, last] = &versions[..] else { panic!("two attempts: {versions:?}") };
    assert_eq!(first.structures, last.structures, "nothing was found meanwhile");
    assert!(first.labels < last.labels && last.labels == found(&place), "{versions:?}");
}

/// Number of structures and control frames of a campaign.
fn found(place: &LabelCampaign) -> u64 {
    let candidates = place.status()["candidates"].take();
    ["accepted", "control"].map(|kind| candidates[kind].as_u64().unwrap()).iter().sum()
}

/// One attempt beside the walks, as soon as a structure is accepted.
const BESIDE_WALKS: &str = r#"
[refit]
replay = ["replay.extxyz"]
after_structures = 1
held_out = 0.0
max_attempts = 1
method = { command = { program = ["false"] } }
"#;

/// A refit that crashes before it knows its labels does not hide those that come later, though nothing is found meanwhile.
#[test]
fn labels_that_come_after_a_crash_are_trained_on() {
    let small = Small { mode: "live", max_per_walk: 2, refit: BESIDE_WALKS, ..Small::default() };
    let place = live_with_late_labels(&small, "");
    // The refit waits for someone to write into this pipe.
    let directory = place.path().join("refit/1");
    fs::create_dir_all(&directory).unwrap();
    assert!(Command::new("mkfifo").arg(directory.join("set.json")).status().unwrap().success());
    let mut run = place.run();
    wait_for_label(&place, "all walks have ended", have_all_walks_ended);
    signal(wait_for_process(place.path(), "refitter"), "ABRT");
    let versions = || on_store(place.location(), async |store| store.versions().await.unwrap());
    wait_until("the crash is recorded", || versions().len() == 1);
    fs::write(place.path().join("go"), "").unwrap();
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
    let versions = versions();
    let [crashed, last] = &versions[..] else { panic!("two attempts: {versions:?}") };
    assert!(crashed.reason.contains("SIGABRT"), "{crashed:?}");
    assert_eq!((crashed.structures, last.labels), (last.structures, found(&place)), "{versions:?}");
}

/// Each version is its parent.
const COPIES: &str = r#"
[refit]
replay = ["replay.extxyz"]
held_out = 0.0
max_versions = 2
method = { command = { program = ["sh", "-c", "cp $CALMWALK_PARENT_MODEL model.npz"] } }
"#;

/// A version ends the walks that were left, and no walk may start with it: the campaign still waits for its labels.
#[test]
fn a_campaign_without_walks_left_waits_for_its_labels() {
    let small =
        Small { mode: "live", steps: 100_000, max_per_walk: 1_000, refit: COPIES, ..Small::default() };
    let place = live_with_late_labels(&small, "max_structures = 3\n");
    // Control walks take as long as the walks that they match.
    let path = place.path().join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("equilibration_steps = 20", "equilibration_steps = 1000")).unwrap();
    let mut run = place.run();
    wait_for_process(place.path(), "walker");
    let walks = || on_store(place.location(), async |store| store.load_walks().await.unwrap());
    wait_until("the biased walks have ended", || {
        let walks = walks();
        let mut biased = walks.iter().filter(|walk| walk.origin == Origin::Biased);
        !walks.is_empty() && biased.all(|walk| walk.state == "budget")
    });
    let held = pause_walkers(place.path(), 2);
    wait_for_label(&place, "a structure has a label", |_| true);
    let walks = walks();
    assert!(walks.iter().any(|walk| walk.is_active()), "{walks:?}");
    assert!(place.status()["candidates"]["accepted"] == 3 && place.jobs("queued") > 0);
    succeed(place.path(), ["refit", place.argument()]);
    wait_until("the run knows the version", || place.said().contains("a newer version of the potential"));
    held.resume();
    wait_until("the version is in force", || place.said().contains("version 1 of the potential is in force"));
    // No walk starts with it: the labellers alone do.
    wait_until("a labeller is at work", || {
        let is_over = run.0.try_wait().unwrap().is_some();
        is_over || !processes_running(place.path(), "labeller").is_empty()
    });
    fs::write(place.path().join("go"), "").unwrap();
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert_eq!((place.jobs("queued"), place.jobs("leased")), (0, 0));
    let versions = on_store(place.location(), async |store| store.versions().await.unwrap());
    let [first, last] = &versions[..] else { panic!("two versions: {versions:?}") };
    assert!(last.labels > first.labels && last.labels >= 3, "{versions:?}");
}

/// A training that crashes, as it does without memory. `PPID` is the refit.
const CRASHES: &str = r#"
[refit]
replay = ["replay.extxyz"]
held_out = 0.0
max_attempts = 1
method = { command = { program = ["sh", "-c", "kill -ABRT $PPID; sleep 60"] } }
"#;

#[test]
fn a_training_that_crashes_is_refused_by_a_live_campaign_alone() {
    for mode in ["live", "reproducible"] {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        Small { mode, max_per_walk: 2, refit: CRASHES, ..Small::default() }.write(here);
        let output = calmwalk(here, RUN);
        let said = stderr(&output);
        let versions = on_store(here.into(), async |store| store.versions().await.unwrap());
        if mode == "live" {
            assert_eq!(output.status.code(), Some(0), "{said}");
            let [version] = &versions[..] else { panic!("one attempt: {versions:?}") };
            assert!(version.state.name() == "refused" && version.reason.contains("SIGABRT"), "{version:?}");
            assert!(version.figures["label_set"].is_string(), "{version:?}");
        } else {
            assert_eq!((output.status.code(), versions.len()), (Some(1), 0), "{said}");
            assert!(said.contains("the refit failed: ") && said.contains("SIGABRT"), "{said}");
        }
        assert_no_leftovers(here);
    }
}

const ONE_VERSION: &str = r#"
[refit]
replay = ["replay.extxyz"]
after_structures = 6
max_versions = 1
held_out = 0.0
max_attempts = 1
method = { native = { epochs = 1, learning_rate = 1e-3, validation_share = 0.0 } }
"#;

/// A model file that changed, and a disk that cannot be written, refuse nothing.
#[test]
fn a_live_campaign_goes_on_beside_a_refit_that_cannot() {
    let small =
        Small { mode: "live", steps: 100_000, max_per_walk: 1_000, refit: ONE_VERSION, ..Small::default() };
    let model = config("data/al_eam_1l/kokkos.npz");
    let place = LabelCampaign::new(&small, &[(model.to_str().unwrap(), "model.npz")]);
    let here = place.path();
    fs::copy(&model, here.join("model.npz")).unwrap();
    let accepted = || place.status()["candidates"]["accepted"].as_u64().unwrap_or(0);
    let versions = || on_store(place.location(), async |store| store.versions().await.unwrap());

    let mut run = place.run();
    wait_until("a structure is accepted", || accepted() > 0);
    fs::write(here.join("model.npz"), "another model").unwrap();
    wait_until("a refit could not go on", || {
        place.said().contains("model.npz: ") && place.said().contains("the walks go on")
    });
    let before = accepted();
    wait_until("the walks go on", || accepted() > before);
    assert_eq!((versions(), run.0.try_wait().unwrap()), (Vec::new(), None));
    signal(run.0.id(), "INT");
    assert_eq!(run.0.wait().unwrap().code(), Some(130), "{}", place.said());
    fs::copy(&model, here.join("model.npz")).unwrap();

    // No walk is left, and a file is where the refit needs its directory.
    let path = here.join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("max_per_walk = 1000", "max_per_walk = 1")).unwrap();
    let _ = fs::remove_dir_all(here.join("refit"));
    fs::write(here.join("refit"), "").unwrap();
    assert_eq!(place.run().0.wait().unwrap().code(), Some(1), "{}", place.said());
    assert!(place.said().contains("the refit failed: ") && versions().is_empty(), "{}", place.said());
    fs::remove_file(here.join("refit")).unwrap();
    assert_eq!(place.run().0.wait().unwrap().code(), Some(0), "{}", place.said());
    let states: Vec<_> = versions().iter().map(|version| version.state.name()).collect();
    assert_eq!(states, ["registered"], "{:?}", versions());
}

/// A loss of labels far from the replay data that is no number.
const NOT_FINITE: &str = r#"
[refit]
replay = ["replay.extxyz"]
after_structures = 3
max_versions = 1
held_out = 0.0
method = { native = { epochs = 1, validation_share = 0.0, energy_weight = 1.7e308, huber_delta = 1000.0 } }
"#;

#[test]
fn a_campaign_goes_on_with_its_version_when_the_loss_is_no_number() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { max_per_walk: 3, refit: NOT_FINITE, ..Small::default() };
    let method =
        r#"method = { command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } } # "#;
    let text = small.text().replacen("[label]\nmethod = ", &format!("[label]\n{method}"), 1);
    fs::write(small.write(here), text).unwrap();
    fs::write(here.join("label.sh"), WRITE_FIXED_LABEL).unwrap();
    succeed(here, RUN);
    let outcome = outcome(here);
    assert!(!outcome.versions.is_empty());
    for version in &outcome.versions {
        assert!(version.state.name() == "refused" && version.reason.contains("not finite"), "{version:?}");
    }
    assert_eq!(json(here, ["versions", "."])["in_force"], 0);
}
