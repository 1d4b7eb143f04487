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

/// The arguments that draw a sample of these files.
fn arguments<'a>(data: &[&'a str], atoms: &'a str, output: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let options = ["--atoms-per-element", atoms, "--output", output];
    [&["calm", "sample"][..], data, &options[..], more].concat()
}

/// Draws a sample of `data.extxyz`. Returns what was printed.
fn sample(here: &Path, atoms: &str, output: &str, more: &[&str]) -> String {
    succeed(here, arguments(&["data.extxyz"], atoms, output, more))
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

    let message = refuse(here, arguments(&["data.extxyz"], "9", "data.extxyz", &[]));
    assert!(message.contains("data.extxyz is a file of the data"), "{message}");
}

#[test]
fn weights_of_the_data_are_multiplied() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut data = frames();
    for (frame, number) in data.iter_mut().zip(0..) {
        frame.info.insert("number".to_owned(), i64::from(number).into());
    }
    write_frames(&here.join("data.extxyz"), &data);
    sample(here, "1000", "plain.extxyz", &[]);
    for (frame, number) in data.iter_mut().zip(0..) {
        frame.info.insert(WEIGHT.to_owned(), (0.25 * f64::from(number)).into());
    }
    write_frames(&here.join("data.extxyz"), &data);
    sample(here, "1000", "weighted.extxyz", &[]);
    let [plain, weighted] =
        ["plain.extxyz", "weighted.extxyz"].map(|name| read_extxyz(&here.join(name)).unwrap());
    assert_eq!(plain.len(), weighted.len());
    for (plain, weighted) in plain.iter().zip(&weighted) {
        let number = weighted.info["number"].number().unwrap();
        assert_eq!(plain.info["number"].number(), Some(number));
        assert_eq!(weight(weighted), 0.25 * number * weight(plain));
    }

    data[2].info.insert(WEIGHT.to_owned(), (-1_i64).into());
    write_frames(&here.join("data.extxyz"), &data);
    let message = refuse(here, arguments(&["data.extxyz"], "1000", "x.extxyz", &[]));
    assert!(
        message.contains("data.extxyz:221: calmwalk_weight is -1; expected a number, 0 or more"),
        "{message}"
    );
    assert!(!here.join("x.extxyz").exists());
}

#[test]
fn all_structures_with_a_rare_element_are_drawn_with_weight_1() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut data = frames();
    let copper: atoms::Species = "Cu".parse().unwrap();
    [7, 40].iter().for_each(|&k| data[k].structure.species[3] = copper);
    write_frames(&here.join("data.extxyz"), &data);
    let printed = sample(here, "500", "drawn.extxyz", &[]);
    let row: Vec<&str> = printed.lines().nth(2).unwrap().split_whitespace().collect();
    assert_eq!(row, ["Cu", "2", "2", "2", "1.00"], "{printed}");
    let drawn = read_extxyz(&here.join("drawn.extxyz")).unwrap();
    let (with, without): (Vec<_>, Vec<_>) =
        drawn.iter().partition(|frame| frame.structure.species.contains(&copper));
    assert!(with.len() == 2 && with.iter().all(|frame| weight(frame) == 1.0));
    // Aluminium has more than enough atoms.
    assert!(!without.is_empty() && without.iter().all(|frame| weight(frame) > 1.0), "{printed}");
}

#[test]
fn a_sample_does_not_depend_on_the_division_into_files() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let data = frames();
    write_frames(&here.join("data.extxyz"), &data);
    sample(here, "1000", "whole.extxyz", &[]);
    write_frames(&here.join("a.extxyz"), &data[..13]);
    write_frames(&here.join("b.extxyz"), &data[13..]);
    succeed(here, arguments(&["a.extxyz", "b.extxyz"], "1000", "parts.extxyz", &[]));
    succeed(here, arguments(&["b.extxyz", "a.extxyz"], "1000", "turned.extxyz", &[]));
    let [whole, parts, turned] =
        ["whole", "parts", "turned"].map(|name| fs::read(here.join(format!("{name}.extxyz"))).unwrap());
    assert!(whole == parts && whole != turned);
}

#[test]
fn data_without_structures_and_broken_lines_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames()[..2]);
    // A frame has 110 lines.
    let text = fs::read_to_string(here.join("data.extxyz")).unwrap();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    fs::write(here.join("cut.extxyz"), lines[..150].join("\n") + "\n").unwrap();
    lines[149] = lines[149].replacen('.', "x", 1);
    fs::write(here.join("broken.extxyz"), lines.join("\n") + "\n").unwrap();
    fs::write(here.join("empty.extxyz"), "").unwrap();
    fs::write(here.join("out.extxyz"), "an earlier sample").unwrap();
    let no_copper = ["--where", "element = Cu"];
    for (file, more, expected) in [
        ("empty.extxyz", &[][..], "empty.extxyz: the file has no structures, expected at least one"),
        ("a.extxyz", &[][..], "a.extxyz: cannot be opened"),
        (
            "cut.extxyz",
            &[][..],
            "cut.extxyz:151: the file ends after 38 of the 108 atoms of the frame at line 111",
        ),
        ("broken.extxyz", &[][..], "broken.extxyz:150: field 2 (pos): found '"),
        ("cut.extxyz", &no_copper[..], "cut.extxyz:151: "),
    ] {
        let message = refuse(here, arguments(&["data.extxyz", file], "9", "out.extxyz", more));
        assert!(message.contains(expected), "{message}");
    }
    let message = refuse(here, arguments(&["data.extxyz"], "9", "out.extxyz", &no_copper));
    assert!(message.contains("no structure of the files matches --where"), "{message}");
    assert_eq!(fs::read_to_string(here.join("out.extxyz")).unwrap(), "an earlier sample");
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
