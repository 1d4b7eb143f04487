//! The reference check before the first walk: it passes, fails, is accepted, and continues after a kill.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use atoms::extxyz::{Frame, FrameLabels, LabelKeys};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::common::campaign::{Small, outcome};
use crate::common::label_campaign::{WRITE_FIXED_LABEL, on_store};
use crate::common::processes::{assert_no_leftovers, calculation_processes, signal, wait_until};
use crate::common::{Running, calmwalk, program, refuse, stderr, succeed, write_frames};

const CHECK: &str = "reference_check = { structures = \"known.extxyz\" }";

/// Writes a campaign with a reference check and, if given, another label method.
fn campaign(method: Option<&str>) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = Small::default().write(directory.path());
    let text = fs::read_to_string(&path).unwrap();
    let section = match method {
        Some(method) => format!("[label]\n{CHECK}\nmethod = {method} # "),
        None => format!("[label]\n{CHECK}\nmethod = "),
    };
    fs::write(path, text.replacen("[label]\nmethod = ", &section, 1)).unwrap();
    directory
}

/// Writes the seed structures with labels by the campaign's own method, modified by `change` (number of the frame, labels).
fn write_known(here: &Path, change: impl Fn(usize, &mut FrameLabels)) {
    succeed(here, ["label-file", "seeds.extxyz", "--config", "campaign.toml", "--output", "known.extxyz"]);
    let path = here.join("known.extxyz");
    let frames = atoms::read_extxyz(&path).unwrap();
    let changed = frames.into_iter().enumerate().map(|(number, mut frame): (usize, Frame)| {
        let mut labels = frame.labels().unwrap();
        change(number, &mut labels);
        frame.set_labels(&labels, LabelKeys::Ase);
        frame
    });
    write_frames(&path, &changed.collect::<Vec<_>>());
}

fn add_energy(labels: &mut FrameLabels, per_atom: f64) {
    let atoms = labels.forces.as_ref().unwrap().len() as f64;
    labels.energy = labels.energy.map(|energy| energy + per_atom * atoms);
}

fn run(here: &Path, further: &[&str]) -> std::process::Output {
    calmwalk(here, [&["run", "campaign.toml", "--directory", "."], further].concat())
}

fn status(here: &Path) -> Value {
    serde_json::from_str(&succeed(here, ["status", ".", "--json"])).unwrap()
}

/// Details of the operations of this kind.
fn operations(here: &Path, kind: &str) -> Vec<Value> {
    let operations = on_store(here.into(), async |store| store.operations(0, 1000).await.unwrap());
    operations.into_iter().filter(|one| one.kind == kind).map(|one| one.detail).collect()
}

/// Details of the checks in the operations log.
fn logged(here: &Path) -> Vec<Value> {
    operations(here, "reference_check")
}

#[test]
fn labels_that_agree_start_the_campaign() {
    let directory = campaign(None);
    let here = directory.path();
    // The zeros of energy may differ.
    write_known(here, |_, labels| add_energy(labels, -100.0));
    let output = run(here, &[]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(
        said.contains("checking the reference: labelling 2 structures") && said.contains("known.extxyz:1"),
        "{said}"
    );
    assert!(
        said.contains(
            "reference check: passed, 2 structures; largest differences: energy 0.0000 eV/atom, force 0.0000"
        ),
        "{said}"
    );
    // The check adds neither candidates nor labels: all accepted structures have exactly one label.
    outcome(here);
    let check = &status(here)["reference_check"];
    assert_eq!(
        (&check["state"], &check["structures"], &check["faults"]),
        (&json!("passed"), &json!(2), &json!([]))
    );
    assert_eq!(check["overall"]["energy"]["frames"], 2);
    assert!(succeed(here, ["status", "."]).contains("; reference check passed\n"));
    assert_eq!(logged(here).len(), 1);
    // The check is repeated only if its inputs change.
    assert!(!stderr(&run(here, &[])).contains("reference"));
    write_known(here, |_, labels| add_energy(labels, -200.0));
    let said = stderr(&run(here, &[]));
    assert!(
        said.contains("label.reference_check.structures is now") && said.contains("reference check: passed"),
        "{said}"
    );
    assert!(!said.contains("labelled "), "the labels were there: {said}");
}

#[test]
fn labels_that_differ_stop_the_campaign_until_they_are_accepted() {
    let directory = campaign(None);
    let here = directory.path();
    write_known(here, |number, labels| {
        add_energy(labels, 0.1 * number as f64);
        labels.forces.iter_mut().flatten().flatten().for_each(|x| *x *= 3.0);
    });
    for again in [false, true] {
        let output = run(here, &[]);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        let expected = "the energy differs by 0.0500 eV/atom, more than label.reference_check.max_energy_difference = 0.005 eV/atom";
        assert!(said.contains("known.extxyz:1 ") && said.contains(expected), "{said}");
        assert!(said.contains("No walk was started") && said.contains("--accept-reference-check"), "{said}");
        assert_eq!(said.contains("labelled "), !again, "{said}");
    }
    let state = status(here);
    assert_eq!(state["reference_check"]["state"], "failed");
    assert!(state["walks"].as_array().unwrap().iter().all(|walk| walk["step"] == 0), "{state}");
    assert!(succeed(here, ["status", "."]).contains("; reference check failed\n"));
    // The check refused these runs, so they are not recorded as killed.
    assert_eq!(state["processes"], json!([]));
    let ended = operations(here, "ended");
    assert_eq!(ended.len(), 2);
    let is_refusal =
        |end: &Value| end["error"].as_str().unwrap().starts_with("the labels contradict the reference");
    assert!(ended.iter().all(|end| end["how"] == "failed" && is_refusal(end)), "{ended:?}");
    let told = succeed(here, ["status", ".", "--all"]);
    assert!(told.contains("root mean square") && told.contains("a force differs by"), "{told}");
    let output = run(here, &["--accept-reference-check"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(
        said.contains("WARNING: reference check: accepted, 2 structures; largest differences: energy 0.0500"),
        "{said}"
    );
    assert_eq!(status(here)["reference_check"]["state"], "accepted");
    let states: Vec<_> = logged(here).into_iter().map(|detail| detail["state"].clone()).collect();
    assert_eq!(states, ["failed", "failed", "accepted"]);
    // The acceptance remains valid.
    assert_eq!(run(here, &[]).status.code(), Some(0));
    outcome(here);
}

/// Before each label: appends a line to `started`, and waits for the file `go`.
const WAITING_SCRIPT: &str = r#"
echo >> HERE/started
while [ ! -e HERE/go ]; do sleep 0.02; done
"#;

/// A campaign whose labels are made by [`WAITING_SCRIPT`], with the directory `scratch`.
fn waiting_campaign() -> TempDir {
    let command =
        "{ command = { command = [\"sh\", \"label.sh\"], files = [\"label.sh\"], version = \"1\" } }";
    let directory = campaign(Some(command));
    let here = directory.path();
    let script = WAITING_SCRIPT.replace("HERE", &here.display().to_string()) + WRITE_FIXED_LABEL;
    fs::write(here.join("label.sh"), script).unwrap();
    let scratch = here.join("scratch");
    fs::create_dir(&scratch).unwrap();
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let section = format!("[label]\nscratch = \"{}\"\n", scratch.display());
    fs::write(here.join("campaign.toml"), text.replacen("[label]\n", &section, 1)).unwrap();
    let mut frames = atoms::read_extxyz(&here.join("seeds.extxyz")).unwrap();
    for frame in &mut frames {
        let forces = Some(vec![[1.0, 0.0, 0.0]; frame.structure.len()]);
        frame.set_labels(&FrameLabels { energy: Some(-3.0), forces, stress: None }, LabelKeys::Ase);
    }
    write_frames(&here.join("known.extxyz"), &frames);
    directory
}

/// Number of calculations that have started.
fn started(here: &Path) -> usize {
    fs::read_to_string(here.join("started")).unwrap_or_default().len()
}

/// The killed check had started to label a structure that was then removed from the file.
#[test]
fn a_calculation_that_is_no_longer_needed_is_ended() {
    let directory = waiting_campaign();
    let here = directory.path();
    let mut running =
        Running(program(here).args(["run", "campaign.toml", "--directory", "."]).spawn().unwrap());
    wait_until("a calculation has started", || started(here) == 1);
    running.0.kill().unwrap();
    running.0.wait().unwrap();
    let frames = atoms::read_extxyz(&here.join("known.extxyz")).unwrap();
    write_frames(&here.join("known.extxyz"), &frames[1..]);
    let mut running =
        Running(program(here).args(["run", "campaign.toml", "--directory", "."]).spawn().unwrap());
    wait_until("the other structure is calculated", || started(here) == 2);
    let scratch = here.join("scratch");
    let directories: BTreeSet<_> = calculation_processes(&scratch)
        .into_iter()
        .filter_map(|(pid, _)| fs::read_link(format!("/proc/{pid}/cwd")).ok())
        .collect();
    assert_eq!(directories.len(), 1, "{directories:?}");
    fs::write(here.join("go"), "").unwrap();
    assert_eq!(running.0.wait().unwrap().code(), Some(1));
    assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0);
    assert_no_leftovers(here);
}

#[test]
fn a_killed_check_continues_with_the_calculation_that_is_running() {
    let directory = waiting_campaign();
    let (here, scratch) = (directory.path(), directory.path().join("scratch"));
    let started = || started(here);
    for stop in ["KILL", "TERM"] {
        let said = fs::File::create(here.join("said")).unwrap();
        let mut command = program(here);
        command.args(["run", "campaign.toml", "--directory", "."]).stderr(said);
        let mut running = Running(command.spawn().unwrap());
        let said = || fs::read_to_string(here.join("said")).unwrap();
        wait_until("the check waits for the first calculation", || {
            started() == 1 && said().contains("checking the reference: labelling 2 structures")
        });
        signal(running.0.id(), stop);
        let ended = running.0.wait().unwrap();
        assert_eq!(ended.code(), if stop == "TERM" { Some(130) } else { None });
        // Only a killed run is recorded as dead.
        let left = if stop == "TERM" { json!([]) } else { json!(["dead"]) };
        let processes = status(here)["processes"].clone();
        let states = processes.as_array().unwrap().iter().map(|process| process["state"].clone());
        assert_eq!(Value::Array(states.collect()), left, "after {stop}");
    }
    assert_eq!(status(here)["reference_check"]["state"], "running");
    fs::write(here.join("go"), "").unwrap();
    let output = run(here, &[]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("a force differs by 0.7500 eV/Å"), "{said}");
    assert_eq!(started(), 2, "each structure is calculated once");
    assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0);
    assert_no_leftovers(here);
}

#[test]
fn a_file_that_cannot_be_compared_is_refused_with_its_line() {
    let directory = campaign(None);
    let here = directory.path();
    let frame = |content: &str| format!("1\nLattice=\"9 0 0 0 9 0 0 0 9\" {content}\n");
    let refused = |text: &str| {
        fs::write(here.join("known.extxyz"), text).unwrap();
        refuse(here, ["validate", "campaign.toml"])
    };
    let with_forces = "Properties=species:S:1:pos:R:3:forces:R:3";
    for (content, message) in [
        (
            format!("{with_forces}\nAl 0 0 0 0 0 0"),
            "known.extxyz:1: the frame has no energy: expected energy or REF_energy",
        ),
        (
            "energy=-3 Properties=species:S:1:pos:R:3\nAl 0 0 0".to_owned(),
            "known.extxyz:1: the frame has no forces",
        ),
        (
            format!("energy=-3 {with_forces}\nSi 0 0 0 0 0 0"),
            "known.extxyz: the label potential does not know Si",
        ),
        (
            format!("energy=-3 {with_forces}\nAl 0 0 0 0 5000 0"),
            "known.extxyz:1: a force of 5000 eV/Å, beyond label.max_force",
        ),
    ] {
        let told = refused(&frame(&content));
        assert!(
            told.contains("campaign.toml:")
                && told.contains("label.reference_check.structures: ")
                && told.contains(message),
            "{told}"
        );
    }
    let twice = frame(&format!("energy=-3 {with_forces}\nAl 0 0 0 0 0 0")).repeat(2);
    assert!(refused(&twice).contains("known.extxyz:4: the same structure as "), "{twice}");
    assert!(refused("").contains("known.extxyz"));
    fs::remove_file(here.join("known.extxyz")).unwrap();
    assert!(refuse(here, ["validate", "campaign.toml"]).contains("known.extxyz"));
}

#[test]
fn validate_warns_of_files_that_show_little() {
    let directory = campaign(None);
    let here = directory.path();
    let warnings = || stderr(&calmwalk(here, ["validate", "campaign.toml"]));
    write_known(here, |_, labels| labels.forces.iter_mut().flatten().flatten().for_each(|x| *x /= 51.422));
    let told = warnings();
    assert!(told.contains("times those of the potential: are they in eV/Å"), "{told}");
    assert!(!told.contains("energies cannot be compared"), "{told}");
    write_known(here, |_, _| ());
    let told = warnings();
    assert!(!told.contains("label.reference_check"), "{told}");
    let mut frames = atoms::read_extxyz(&here.join("known.extxyz")).unwrap();
    frames.truncate(1);
    write_frames(&here.join("known.extxyz"), &frames);
    let told = warnings();
    assert!(
        told.contains("1 structure with 1 element: energies cannot be compared")
            && told.contains("give at least 2"),
        "{told}"
    );
    assert!(told.contains("forces that are wrong would not be noticed"), "{told}");
}

const LAUNCH: [&str; 8] =
    ["launch", "campaign.toml", "--on", "slurm", "--agents=0", "--directory", ".", "--dry-run"];

/// Output of `calmwalk launch` with these further options.
fn launched(here: &Path, further: &[&str]) -> std::process::Output {
    let mut command = program(here);
    // Hide Slurm's commands, which may be installed without a working Slurm.
    command.args(LAUNCH).args(further).env("PATH", "");
    command.output().unwrap()
}

/// A requeued job repeats its command, even if the configuration has changed.
#[test]
fn a_launched_campaign_accepts_only_the_check_that_the_user_has_seen() {
    let directory = campaign(None);
    let here = directory.path();
    write_known(here, |number, labels| add_energy(labels, 0.1 * number as f64));
    let printed = |further: &[&str]| String::from_utf8(launched(here, further).stdout).unwrap();
    assert!(!printed(&[]).contains("--accept-reference-check"));
    let scripts = printed(&["--accept-reference-check"]);
    let accept =
        scripts.split_whitespace().find(|word| word.starts_with("--accept-reference-check")).unwrap();
    let identity = accept.strip_prefix("--accept-reference-check=").unwrap();
    assert!(identity.len() == 64 && identity.chars().all(|c| c.is_ascii_hexdigit()), "{accept}");
    let configuration = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let with_check = |check: &str| {
        let text = configuration.replacen(CHECK, check, 1);
        fs::write(here.join("campaign.toml"), text).unwrap();
    };
    with_check("reference_check = { structures = \"known.extxyz\", max_energy_difference = 0.004 }");
    let output = run(here, &[accept]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("--accept-reference-check accepts an earlier check")
            && said.contains("energy_difference = 0.004"),
        "{said}"
    );
    assert_eq!(status(here)["reference_check"]["state"], "failed");
    with_check(CHECK);
    let output = run(here, &[accept]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains("WARNING: reference check: accepted, 2 structures"), "{said}");
    // The job is requeued after the check was removed.
    with_check("");
    assert_eq!(run(here, &[accept]).status.code(), Some(0));
}

#[test]
fn a_check_that_is_not_there_cannot_be_accepted() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    let expected = "--accept-reference-check: campaign.toml has no label.reference_check.structures";
    let told = refuse(here, ["run", "campaign.toml", "--accept-reference-check"]);
    assert!(told.contains(expected), "{told}");
    let output = launched(here, &["--accept-reference-check"]);
    assert!(output.status.code() == Some(2) && stderr(&output).contains(expected), "{}", stderr(&output));
}
