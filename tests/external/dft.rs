//! Campaigns whose labels are made by a real DFT code: `configs/silicon-dft.toml` with ABINIT and with Quantum
//! ESPRESSO (Debian's packages abinit, abinit-data, quantum-espresso and quantum-espresso-data).
//!
//! cargo test --test external dft::

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use atoms::extxyz::Frame;
use atoms::{Cell, Structure, Vec3, read_extxyz};
use serde_json::Value;

use crate::common;
use crate::common::label_campaign::queue;
use crate::common::processes::{calculation_processes, processes_running, signal, wait_until};
use crate::common::{config, demo, deviation, program, random, stderr, succeed};

/// Directories of calculations: `scratch` has one directory per campaign, and that one per calculation.
fn directories(scratch: &Path) -> Vec<PathBuf> {
    let campaigns = fs::read_dir(scratch).unwrap().map(|entry| entry.unwrap().path());
    campaigns.flat_map(|home| fs::read_dir(home).unwrap()).map(|entry| entry.unwrap().path()).collect()
}

fn export(directory: &Path) -> Vec<Frame> {
    succeed(directory, ["export", "campaign", "--control", "--output", "dataset.extxyz"]);
    read_extxyz(&directory.join("dataset.extxyz")).unwrap()
}

/// The text of the demo with one k-point instead of 2 × 2 × 2: for tests that need no accurate labels.
fn quick_demo() -> String {
    let text = demo("silicon-dft.toml");
    let quick = text.replace("k_spacing = 0.6 ", "k_spacing = 4.0 ");
    assert_ne!(quick, text);
    quick
}

/// The same by Quantum ESPRESSO.
fn quick_espresso_demo() -> String {
    const SECTION: &str =
        "[label.method.espresso]\npseudopotential_variants = { Si = \"Si.pbe-rrkj.UPF\" }\n";
    let abinit = quick_demo();
    let text = abinit.replace("[label.method.abinit]\n", SECTION);
    assert_ne!(text, abinit);
    text
}

/// The demo with one k-point and one structure of each walk.
fn shorter_demo(here: &Path) -> PathBuf {
    let text = quick_demo();
    let shorter = text.replace("# max_per_walk = 3 ", "max_per_walk = 1 ");
    assert_ne!(shorter, text);
    let path = here.join("silicon-dft.toml");
    fs::write(&path, shorter).unwrap();
    path
}

/// `label-file` makes the same label as the campaign. Each label of the demo takes twenty seconds of a processor, so it stands as it is only
/// if `CALMWALK_WHOLE_DEMOS` is set. Otherwise it has one k-point, and collects one structure of each walk in place of three.
#[test]
fn the_demo_makes_labels_of_all_its_structures() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let whole = std::env::var_os("CALMWALK_WHOLE_DEMOS").is_some();
    let (demo, per_walk) = if whole { (config("silicon-dft.toml"), 3) } else { (shorter_demo(here), 1) };
    let demo = demo.display().to_string();
    let summary = succeed(here, ["run", &demo, "--directory", "campaign"]);
    let labels = summary.lines().find(|line| line.starts_with("labels ")).unwrap();
    let structures = 2 * per_walk;
    let made = format!("{structures} biased and {structures} control structures labelled");
    assert!(labels.contains(&made), "{summary}");
    assert!(!labels.contains(" failed") && !labels.contains(" dropped"), "{summary}");
    let frames = export(here);
    assert_eq!(frames.len(), 2 * structures);

    let last = frames.last().unwrap();
    let mut bare = Frame::from(last.structure.clone());
    bare.info.insert("name".to_owned(), "last".to_owned().into());
    common::write_frames(&here.join("last.extxyz"), &[bare]);
    succeed(here, ["label-file", "last.extxyz", "--config", &demo, "--output", "again.extxyz"]);
    let again = &read_extxyz(&here.join("again.extxyz")).unwrap()[0];
    let (found, expected) = (again.labels().unwrap(), last.labels().unwrap());
    assert!((found.energy.unwrap() - expected.energy.unwrap()).abs() < 1e-6);
    let (found, expected) = (found.forces.unwrap(), expected.forces.unwrap());
    assert!(deviation(found.as_flattened(), expected.as_flattened()) < 1e-6);
    assert_eq!(again.info["protocol_hash"].text(), last.info["protocol_hash"].text());
    assert_eq!(last.info["protocol"].text(), Some("abinit"));
}

#[test]
fn labels_survive_kills_of_labeller_runner_and_code() {
    labels_survive_kills(&quick_demo(), "abinit ");
}

#[test]
fn labels_survive_kills_with_quantum_espresso() {
    labels_survive_kills(&quick_espresso_demo(), "pw.x ");
}

/// Labeller, runner and code are killed at random times: each label is made once, and no directory or process remains.
/// `code` is how the code's command line begins.
fn labels_survive_kills(demo: &str, code: &str) {
    let directory = tempfile::tempdir().unwrap();
    let (here, scratch) = (directory.path(), directory.path().join("scratch"));
    fs::create_dir(&scratch).unwrap();
    let text = demo.replace("# max_per_walk = 3 ", "max_per_walk = 1 ");
    let label = format!("[label]\nscratch = \"{}\"\nmax_attempts = 20", scratch.display());
    fs::write(here.join("campaign.toml"), text.replace("[label]", &label)).unwrap();
    let mut run = program(here)
        .args(["run", "campaign.toml"])
        .stderr(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();

    for round in 0..6 {
        let begun = Instant::now();
        let is_code = |command: &str| command.starts_with(code);
        wait_until("the code is running", || {
            calculation_processes(&scratch).iter().any(|(_, command)| is_code(command))
                || run.try_wait().unwrap().is_some()
        });
        if run.try_wait().unwrap().is_some() {
            break;
        }
        std::thread::sleep(Duration::from_millis(random(round) % 3000));
        let victim = match round % 3 {
            0 => calculation_processes(&scratch)
                .into_iter()
                .find(|(_, command)| is_code(command))
                .map(|(pid, _)| pid),
            1 => processes_running(here, "labeller").first().copied(),
            _ => processes_running(here, "calculation-runner").first().copied(),
        };
        victim.into_iter().for_each(|pid| signal(pid, "KILL"));
        assert!(begun.elapsed() < Duration::from_secs(300));
    }
    assert!(run.wait().unwrap().success());
    wait_until("every calculation has exited", || calculation_processes(&scratch).is_empty());
    // A later labeller removes the directories of a killed one after a minute.
    for directory in directories(&scratch) {
        let touched = Command::new("touch").args(["-d", "2 minutes ago"]).arg(directory).status();
        assert!(touched.unwrap().success());
    }
    succeed(here, ["label", "--store", "campaign", "--until-empty"]);
    assert_eq!(directories(&scratch), Vec::<PathBuf>::new());
    let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    let labels = &status["labels"];
    assert_eq!((&labels["queued"], &labels["leased"], &labels["failed"]), (&0.into(), &0.into(), &0.into()));
    assert_eq!(export(here).len(), 4);
    let queue: Value = serde_json::from_str(&succeed(here, ["queue", "campaign", "list", "--json"])).unwrap();
    let attempts = queue.as_array().unwrap().iter().map(|job| job["attempts"].as_u64().unwrap()).sum::<u64>();
    assert!(attempts > queue.as_array().unwrap().len() as u64, "nothing was killed: {queue}");
}

/// Silicon atoms at these positions, Å.
fn silicon(positions: &[Vec3], cell: [Vec3; 3]) -> Structure {
    let (species, positions) = (vec!["Si".parse().unwrap(); positions.len()], positions.to_vec());
    Structure { species, positions, cell: Cell(cell), periodic: [true; 3] }
}

/// The attempts at the label of a candidate.
fn attempts(here: &Path, candidate: &str) -> Vec<Value> {
    let text = succeed(here, ["queue", "campaign", "show", candidate, "--json"]);
    let details: Value = serde_json::from_str(&text).unwrap();
    details["attempts_made"].as_array().unwrap().clone()
}

/// Checks that a guard rejected a candidate for this reason before ABINIT was started.
fn is_refused(here: &Path, candidate: &str, reason: &str) {
    let [attempt] = &attempts(here, candidate)[..] else { panic!("{candidate}: more than one attempt") };
    assert_eq!(
        (&attempt["class"], &attempt["calculation"]),
        (&"rejected_by_label_guard".into(), &Value::Null),
        "{attempt}"
    );
    assert!(attempt["log"].as_str().unwrap().contains(reason), "{attempt}");
}

#[test]
fn guards_stand_before_abinit() {
    const GUARD: &str = "guard = { min_bond_lengths = { \"Si-Si\" = 1.8 }, min_height = 3.0, max_atoms = 8, duplicate_tolerance = 0.01";
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    // The campaign itself makes one label.
    let text = quick_demo().replace("# control = true", "control = false");
    let text = text.replace("# max_structures = 100 ", "max_structures = 1 ");
    let write = |guard: &str| {
        fs::write(here.join("campaign.toml"), text.replace("[label]\n", &format!("[label]\n{guard}\n")))
            .unwrap();
    };
    write(&format!("{GUARD} }}"));
    succeed(here, ["run", "campaign.toml"]);

    let primitive = [[0.0, 2.8, 2.8], [2.8, 0.0, 2.8], [2.8, 2.8, 0.0]];
    let pair = |x: f64| silicon(&[[0.0; 3], [x, 1.4, 1.4]], primitive);
    let row: Vec<Vec3> = (0..9).map(|k| [2.4 * f64::from(k), 0.0, 0.0]).collect();
    // Two features per atom.
    let features = |atoms: usize, scale: f64| (0..2 * atoms).map(|k| scale * (k as f64 - 1.5)).collect();
    let add = |step, structure: Structure, scale| {
        let features = features(structure.len(), scale);
        queue(here.join("campaign").as_path().into(), step, structure, features)
    };
    let good = add(1, pair(1.4), 1.0);
    let again = add(2, pair(1.4), 1.0);
    let near = add(3, pair(1.401), 1.001);
    let other = add(4, pair(1.45), 2.0);
    let short = add(5, silicon(&[[0.0; 3], [1.5, 0.0, 0.0]], primitive), 3.0);
    let flat = add(
        6,
        silicon(&[[0.0; 3], [0.0, 2.5, 2.5]], [[2.5, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 5.0]]),
        3.0,
    );
    let many = add(7, silicon(&row, [[21.6, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 5.0]]), 3.0);
    succeed(here, ["label", "--store", "campaign", "--until-empty"]);
    let is_labelled = |candidate: &str| attempts(here, candidate).last().unwrap()["outcome"] == "labelled";
    // The same structure has one job.
    assert!(is_labelled(&good) && is_labelled(&other) && attempts(here, &again) == attempts(here, &good));
    is_refused(here, &short, "label.guard.min_bond_lengths of Si-Si is 1.8");
    is_refused(here, &flat, "label.guard.min_height is 3");
    is_refused(here, &many, "9 atoms, where label.guard.max_atoms is 8");
    is_refused(here, &near, &format!("from those of {good}, which has a label"));
    succeed(here, ["queue", "campaign", "retry", &near]);
    succeed(here, ["label", "--store", "campaign", "--until-empty"]);
    assert!(is_labelled(&near));

    // Every calculation is too expensive from now on.
    write(&format!("{GUARD}, max_cost = 1e-6 }}"));
    succeed(here, ["run", "campaign.toml"]);
    let dear = add(8, pair(1.5), 4.0);
    succeed(here, ["label", "--store", "campaign", "--until-empty"]);
    is_refused(here, &dear, "core-seconds, judging by 4 labels, where label.guard.max_cost is 0.000001");
}

/// After the first label, the pseudopotential is replaced by another one that ABINIT would accept as well.
#[test]
fn a_pseudopotential_that_is_replaced_between_two_labels_makes_none() {
    const THEIRS: &str = "/usr/share/abinit/psp";
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path().canonicalize().unwrap();
    let (file, script) = (here.join("Si.psp8"), here.join("abinit.sh"));
    let original = Path::new(THEIRS).join("Pseudodojo_nc_sr_04_pbe_standard_psp8/Si.psp8");
    fs::copy(&original, &file).unwrap();
    let replace = format!("cp {THEIRS}/Si_GGA_noNLCC.psp8 new && mv new {}", file.display());
    let text = format!(
        "abinit \"$@\" || exit\n[ ! -e run.abo ] || ! mkdir {}/once 2> /dev/null || {{ {replace}; }}\n",
        here.display()
    );
    fs::write(&script, text).unwrap();
    let method = format!(
        "[label.method.abinit]\ncommand = [\"sh\", {:?}]\npseudopotentials = {:?}\n",
        script.display().to_string(),
        here.display().to_string()
    );
    let plain = quick_demo();
    let text = plain.replace("# control = true", "control = false");
    let text = text
        .replace("# max_structures = 100 ", "max_structures = 3 ")
        .replace("[label.method.abinit]\n", &method);
    fs::write(here.join("campaign.toml"), text).unwrap();
    let output = program(&here).args(["run", "campaign.toml"]).output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("labels made here would not belong to the campaign's protocol 'abinit'"), "{said}");
    let status: Value = serde_json::from_str(&succeed(&here, ["status", "campaign", "--json"])).unwrap();
    assert_eq!(
        (&status["labels"]["labelled"], &status["labels"]["failed"]),
        (&1.into(), &0.into()),
        "{said}"
    );

    fs::copy(&original, &file).unwrap();
    succeed(&here, ["run", "campaign.toml"]);
    let frames = export(&here);
    assert_eq!(frames.len(), 3);
    let bare: Vec<_> = frames.iter().map(|frame| Frame::from(frame.structure.clone())).collect();
    common::write_frames(&here.join("bare.extxyz"), &bare);
    fs::write(here.join("plain.toml"), plain).unwrap();
    succeed(&here, ["label-file", "bare.extxyz", "--config", "plain.toml", "--output", "again.extxyz"]);
    for (frame, again) in frames.iter().zip(read_extxyz(&here.join("again.extxyz")).unwrap()) {
        let energy = |frame: &Frame| frame.labels().unwrap().energy.unwrap();
        assert!((energy(frame) - energy(&again)).abs() < 1e-6);
    }
}

/// Checks that the real program is installed.
#[test]
fn abinit_is_there() {
    let version =
        Command::new("abinit").arg("--version").output().expect("abinit, of Debian's package abinit");
    assert!(version.status.success());
}
