//! Trajectories in the store: the frames of a rerun, whatever happened to the campaign, in the formats of their names.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use atoms::extxyz::Frame;

use crate::common::campaign::{Counters, Small, TRAJECTORY_INTERVAL, written};
use crate::common::processes::{signal, wait_until};
use crate::common::{Running, calmwalk, program, refuse, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

/// Numbers of the walks that made a step.
fn walks(here: &Path) -> Vec<u64> {
    let status: serde_json::Value =
        serde_json::from_str(&succeed(here, ["status", "here", "--json"])).unwrap();
    let walks = status["walks"].as_array().unwrap().iter();
    walks.filter(|walk| walk["step"].as_u64() > Some(0)).map(|walk| walk["walk"].as_u64().unwrap()).collect()
}

fn write_trajectory(here: &Path, walk: u64, name: &str) -> String {
    succeed(here, ["walks", "here", "trajectory", &walk.to_string(), "--output", name])
}

/// Every walk has the frames that its rerun has.
fn check_against_reruns(here: &Path) {
    let every = TRAJECTORY_INTERVAL.to_string();
    for walk in walks(here) {
        let said = write_trajectory(here, walk, "stored.extxyz");
        succeed(here, ["rerun", "here", &walk.to_string(), "--every", &every, "--trajectory", "made.extxyz"]);
        let [stored, made] =
            ["stored.extxyz", "made.extxyz"].map(|file| atoms::read_extxyz(&here.join(file)).unwrap());
        assert!(said.contains(&format!("{} frame", made.len())), "{said}");
        assert_eq!(stored.len(), made.len(), "walk {walk}");
        for (stored, made) in stored.iter().zip(&made) {
            for key in ["segment", "step", "time_fs", "temperature"] {
                assert_eq!(stored.info[key], made.info[key], "{key} of walk {walk}");
            }
            check_structure(stored, made);
        }
    }
}

fn check_structure(stored: &Frame, made: &Frame) {
    let (stored, made) = (&stored.structure, &made.structure);
    assert_eq!((&stored.species, stored.cell, stored.periodic), (&made.species, made.cell, made.periodic));
    let pairs = stored.positions.as_flattened().iter().zip(made.positions.as_flattened());
    for (found, expected) in pairs {
        assert!((found - expected).abs() < 0.501e-6, "{found} {expected}");
    }
}

#[test]
fn frames_are_those_of_a_rerun() {
    let directory = written(&Small::default(), &[]);
    let here = directory.path();
    succeed(here, RUN);
    check_against_reruns(here);
    for (name, begin) in [
        ("a.xyz.gz", &[0x1f, 0x8b][..]),
        ("a.lammpstrj", b"ITEM: UNITS\nmetal\n"),
        ("a.dump.zst", &[0x28, 0xb5, 0x2f, 0xfd]),
    ] {
        write_trajectory(here, 0, name);
        assert!(fs::read(here.join(name)).unwrap().starts_with(begin), "{name}");
    }
    let text = fs::read_to_string(here.join("a.lammpstrj")).unwrap();
    assert!(text.contains("ITEM: ATOMS id type element xu yu zu\n"), "{text:.300}");
    for (arguments, said) in [
        (["99", "a.xyz"], "the campaign has no walk 99; they are 0 to"),
        (["0", "seeds.extxyz"], "a file of the campaign"),
        (["0", "a.pdb"], "expected a name that ends in .extxyz"),
    ] {
        let [walk, file] = arguments;
        let refused = refuse(here, ["walks", "here", "trajectory", walk, "--output", file]);
        assert!(refused.contains(said), "{refused}");
    }
}

#[test]
fn frames_of_a_walk_that_rolled_back_are_those_of_a_rerun() {
    let keys = "[guard]\nmax_consecutive_rejections = 2\nmax_rollbacks = 1\n\
        min_distances = { rule = \"per_pair\", pairs = { \"Al-Al\" = 2.8 } }\n";
    let small = Small { seed_structures: &["fcc-100"], ..Small::default() };
    let interval = format!("trajectory_interval = {TRAJECTORY_INTERVAL}\n");
    let directory = written(&small, &[("[guard]\n", keys), (&interval, "trajectory_interval = 5\n")]);
    let here = directory.path();
    // A campaign whose only walk is trapped fails.
    calmwalk(here, RUN);
    write_trajectory(here, 0, "stored.extxyz");
    succeed(here, ["rerun", "here", "0", "--every", "5", "--trajectory", "made.extxyz"]);
    let [stored, made] =
        ["stored.extxyz", "made.extxyz"].map(|file| atoms::read_extxyz(&here.join(file)).unwrap());
    let places = |frames: &[Frame]| -> Vec<_> {
        frames.iter().map(|frame| (frame.info["segment"].clone(), frame.info["step"].clone())).collect()
    };
    assert_eq!(places(&stored), places(&made));
    assert!(stored.iter().any(|frame| frame.info["segment"] == 1_i64.into()), "no roll back");
    stored.iter().zip(&made).for_each(|(stored, made)| check_structure(stored, made));
}

#[test]
fn interrupted_and_killed_campaigns_give_the_same_bytes() {
    let small = Small { steps: 480, max_per_walk: 50, ..Small::default() };
    let whole = written(&small, &[]);
    succeed(whole.path(), RUN);
    let disturbed = written(&small, &[]);
    let here = disturbed.path();
    let mut steps = 0;
    for name in ["INT", "KILL", "INT", "KILL"] {
        let mut run =
            Running(program(here).args(RUN).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
        wait_until("steps", || {
            let counters = calmwalk(here, ["status", "here", "--json"]);
            let status = serde_json::from_slice::<serde_json::Value>(&counters.stdout).unwrap_or_default();
            let walks = status["walks"].as_array().into_iter().flatten();
            let made: u64 = walks.filter_map(|walk| walk["step"].as_u64()).sum();
            let is_further = made > steps;
            steps = steps.max(made);
            is_further
        });
        signal(run.0.id(), name);
        run.0.wait().unwrap();
    }
    succeed(here, RUN);
    assert!(Counters::read("here", here).sent > 0);
    assert_eq!(walks(here), walks(whole.path()));
    for walk in walks(here) {
        let [expected, found] = [whole.path(), here].map(|directory| {
            write_trajectory(directory, walk, "walk.extxyz");
            fs::read(directory.join("walk.extxyz")).unwrap()
        });
        assert!(expected == found, "walk {walk}");
    }
    succeed(here, ["store", "check", "here"]);
}

#[test]
fn a_campaign_without_an_interval_has_no_trajectories() {
    let interval = format!("trajectory_interval = {TRAJECTORY_INTERVAL}\n");
    let directory = written(&Small { steps: 60, ..Small::default() }, &[(&interval, "")]);
    let here = directory.path();
    succeed(here, RUN);
    let refused = refuse(here, ["walks", "here", "trajectory", "0", "--output", "a.extxyz"]);
    assert!(
        refused.contains("walk 0 has no trajectory in the store: set walk.trajectory_interval"),
        "{refused}"
    );
    assert!(!here.join("a.extxyz").exists());
}
