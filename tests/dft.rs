//! A campaign whose labels are made by a real DFT code: `configs/silicon-dft.toml` with ABINIT, of Debian's packages abinit and
//! abinit-data.
//!
//! cargo test --test dft

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use atoms::extxyz::Frame;
use atoms::read_extxyz;
use common::processes::{carrying_out, signal, wait_until};
use common::{config, deviation, program, random, succeed};
use serde_json::Value;

/// A variable in the environment of everything that a calculation starts: its directory.
const MARK: &[u8] = b"CALMWALK_CALCULATION=";

/// Whose calculations are in this scratch directory: every process, keepers and programs.
fn of_calculations(scratch: &Path) -> Vec<(u32, String)> {
    let numbers = fs::read_dir("/proc").unwrap().flatten();
    let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    let marked = |pid: &u32| {
        let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
        let mark = [MARK, scratch.as_os_str().as_encoded_bytes()].concat();
        environment.split(|byte| *byte == 0).any(|variable| variable.starts_with(&mark))
    };
    let name = |pid| Some((pid, fs::read_to_string(format!("/proc/{pid}/comm")).ok()?.trim().to_owned()));
    numbers.filter(marked).filter_map(name).collect()
}

/// Directories of calculations: a campaign has a directory in `scratch`, and each calculation one in it.
fn directories(scratch: &Path) -> Vec<PathBuf> {
    let campaigns = fs::read_dir(scratch).unwrap().map(|entry| entry.unwrap().path());
    campaigns.flat_map(|home| fs::read_dir(home).unwrap()).map(|entry| entry.unwrap().path()).collect()
}

fn export(directory: &Path) -> Vec<Frame> {
    succeed(directory, ["export", "campaign", "--control", "--output", "dataset.extxyz"]);
    read_extxyz(&directory.join("dataset.extxyz")).unwrap()
}

/// The numbers of the labels are those that the same calculation gives by itself.
#[test]
fn the_demo_makes_at_least_ten_dft_labels() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let demo = config("silicon-dft.toml").display().to_string();
    let summary = succeed(here, ["run", &demo, "--directory", "campaign"]);
    assert!(summary.contains("6 biased and 6 control structures labelled, 0 failed"), "{summary}");
    let frames = export(here);
    assert!(frames.len() >= 10, "{} labels", frames.len());

    let last = frames.last().unwrap();
    let mut bare = Frame::from(last.structure.clone());
    bare.info.insert("name".to_owned(), "last".to_owned().into());
    common::write_frames(&here.join("last.extxyz"), &[bare]);
    succeed(here, ["label", "--once", "last.extxyz", "--config", &demo, "--output", "again.extxyz"]);
    let again = &read_extxyz(&here.join("again.extxyz")).unwrap()[0];
    let (found, expected) = (again.labels().unwrap(), last.labels().unwrap());
    assert!((found.energy.unwrap() - expected.energy.unwrap()).abs() < 1e-6);
    let (found, expected) = (found.forces.unwrap(), expected.forces.unwrap());
    assert!(deviation(found.as_flattened(), expected.as_flattened()) < 1e-6);
    assert_eq!(again.info["protocol_hash"].text(), last.info["protocol_hash"].text());
    assert_eq!(last.info["protocol"].text(), Some("abinit"));
}

/// Labeller, keeper and code are killed at random moments: each label is made once, none is lost and nothing is left.
#[test]
fn labels_survive_kills_of_labeller_keeper_and_code() {
    let directory = tempfile::tempdir().unwrap();
    let (here, scratch) = (directory.path(), directory.path().join("scratch"));
    fs::create_dir(&scratch).unwrap();
    let text = fs::read_to_string(config("silicon-dft.toml")).unwrap();
    let data = format!("\"{}/data/", config("").display()).replace("//", "/");
    let text = text.replace("\"data/", &data).replace("# per_seed = 3 ", "per_seed = 1 ");
    let label = format!("[label]\nscratch = \"{}\"\nattempts = 20", scratch.display());
    fs::write(here.join("campaign.toml"), text.replace("[label]", &label)).unwrap();
    let mut run = program(here)
        .args(["run", "campaign.toml"])
        .stderr(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();

    for round in 0..6 {
        let begun = Instant::now();
        wait_until("ABINIT is at work", || {
            of_calculations(&scratch).iter().any(|(_, name)| name == "abinit")
                || run.try_wait().unwrap().is_some()
        });
        if run.try_wait().unwrap().is_some() {
            break;
        }
        std::thread::sleep(Duration::from_millis(random(round) % 3000));
        let calculations = of_calculations(&scratch);
        let victim = match round % 3 {
            0 => calculations.iter().find(|(_, name)| name == "abinit").map(|(pid, _)| *pid),
            1 => carrying_out(here, "labeller").first().copied(),
            _ => calculations.iter().find(|(_, name)| name != "abinit").map(|(pid, _)| *pid),
        };
        victim.into_iter().for_each(|pid| signal(pid, "KILL"));
        assert!(begun.elapsed() < Duration::from_secs(300));
    }
    assert!(run.wait().unwrap().success());
    wait_until("every calculation is gone", || of_calculations(&scratch).is_empty());
    // What a killed labeller had only just made is cleared away by those who come a minute later.
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

/// The program itself, not a stand-in.
#[test]
fn abinit_is_there() {
    let version =
        Command::new("abinit").arg("--version").output().expect("abinit, of Debian's package abinit");
    assert!(version.status.success());
}
