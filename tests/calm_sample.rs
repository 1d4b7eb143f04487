//! `calmwalk calm sample`: a sample with weights, which builds read.

use std::fs;
use std::path::Path;

use atoms::extxyz::Frame;
use atoms::read_extxyz;

use crate::common::{config, refuse, succeed, write_frames};

const WEIGHT: &str = "calmwalk_weight";

/// 50 frames of 108 atoms.
fn frames() -> Vec<Frame> {
    read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap()
}

/// Draws a sample of `data.extxyz`. Returns what was printed.
fn sample(here: &Path, atoms: &str, output: &str, more: &[&str]) -> String {
    let words = ["calm", "sample", "data.extxyz", "--atoms-per-element", atoms, "--output", output];
    succeed(here, words.iter().chain(more))
}

fn weight(frame: &Frame) -> f64 {
    frame.info[WEIGHT].number().unwrap()
}

#[test]
fn a_sample_has_frames_of_the_data_with_weights() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames());
    let printed = sample(here, "1000", "a.extxyz", &[]);
    let found = read_extxyz(&here.join("a.extxyz")).unwrap();
    let row: Vec<&str> = printed.lines().nth(1).unwrap().split_whitespace().collect();
    assert_eq!(row[..4], ["Al", "5400", "1080", "10"], "{printed}");
    let common = weight(&found[0]);
    assert!(found.iter().all(|frame| weight(frame) == common) && common > 1.0, "{printed}");
    assert_eq!(row[4], format!("{common:.2}").as_str());
    assert!(printed.ends_with(&format!("10 structures of 50, mean weight {common:.2}\nwrote a.extxyz\n")));

    // In the order of the data, with everything that the frames have.
    let data = read_extxyz(&here.join("data.extxyz")).unwrap();
    let mut left = data.iter();
    for mut frame in found {
        frame.info.remove(WEIGHT);
        let is_same = |other: &Frame| Frame { line: frame.line, ..other.clone() } == frame;
        assert!(left.any(is_same));
    }
    sample(here, "1000", "b.extxyz", &[]);
    sample(here, "1000", "c.extxyz", &["--rng-seed", "7"]);
    let [a, b, c] = ["a", "b", "c"].map(|name| fs::read(here.join(format!("{name}.extxyz"))).unwrap());
    assert!(a == b && a != c);

    // A sample of a sample stands for the same data.
    fs::rename(here.join("a.extxyz"), here.join("data.extxyz")).unwrap();
    let printed = sample(here, "9999", "whole.extxyz", &[]);
    assert_eq!(fs::read(here.join("whole.extxyz")).unwrap(), a, "{printed}");
}

#[test]
fn elements_with_too_few_atoms_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames());
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let printed = sample(here, "100", "few.extxyz", &["--model", &model]);
    let expected =
        "fewer than 131 atoms (D + 1) in the sample, which a component of a mixture needs: Al 108 of 5400\n";
    assert!(printed.contains(expected), "{printed}");
    assert!(!sample(here, "131", "enough.extxyz", &["--model", &model]).contains("fewer than"));
    // Of a model with further elements, also those without data.
    let model = config("data/ni_al_h_eam_1l/kokkos.npz").display().to_string();
    let printed = sample(here, "5400", "all.extxyz", &["--model", &model]);
    assert!(printed.contains("which a component of a mixture needs: H 0 of 0, Ni 0 of 0\n"), "{printed}");

    let words = ["calm", "sample", "data.extxyz", "--atoms-per-element", "9", "--output", "data.extxyz"];
    assert!(refuse(here, words).contains("data.extxyz is a file of the data"));
}

#[test]
fn a_build_weighs_frames_as_files() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut some = frames();
    some.truncate(4);
    write_frames(&here.join("plain.extxyz"), &some);
    some.iter_mut().for_each(|frame| drop(frame.info.insert(WEIGHT.to_owned(), 0.5_f64.into())));
    write_frames(&here.join("weighted.extxyz"), &some);
    some[2].info.insert(WEIGHT.to_owned(), (-1_i64).into());
    write_frames(&here.join("wrong.extxyz"), &some);
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let words = |data: &str, more: &[&str]| -> Vec<String> {
        let all = ["calm", "build", "--model", &model, "--output", "out.npz", "--candidates", "1", data];
        all.iter().chain(more).map(|word| (*word).to_owned()).collect()
    };
    let build = |data: &str, more: &[&str]| {
        succeed(here, words(data, more));
        fs::read(here.join("out.npz")).unwrap()
    };
    let plain = build("plain.extxyz", &[]);
    let half = build("weighted.extxyz", &[]);
    assert!(plain != half && half == build("plain.extxyz", &["--weight", "plain.extxyz=0.5"]));
    assert!(plain == build("weighted.extxyz", &["--weight", "weighted.extxyz=2"]));
    let message = refuse(here, words("wrong.extxyz", &[]));
    assert!(
        message.contains("wrong.extxyz:221: calmwalk_weight is -1; expected a number, 0 or more"),
        "{message}"
    );
}
