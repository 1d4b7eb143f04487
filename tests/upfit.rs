//! `calmwalk upfit`: the loss falls, interruptions and threads change no byte, and wrong input is named.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;

use atoms::extxyz::{Frame, FrameLabels, LabelKeys};
use atoms::{Evaluation, NeighbourList, Potential, Species, read_extxyz};
use potentials::grace::{Grace, GraceModel};
use serde_json::Value as Json;

use crate::common::processes::{signal, wait_until};
use crate::common::{Running, calmwalk, config, program, refuse, stderr, succeed, write_frames};

const MODEL: &str = "data/al_eam_1l/kokkos.npz";

/// Frames of the model's training data, with labels of a potential that is a tenth stronger.
fn frames(count: usize) -> Vec<Frame> {
    let mut frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    frames.truncate(count);
    for frame in &mut frames {
        change_labels(frame, |labels| {
            labels.energy = labels.energy.map(|energy| 1.1 * energy);
            let forces = labels.forces.as_mut().unwrap().as_flattened_mut();
            forces.iter_mut().for_each(|force| *force *= 1.1);
            labels.stress = labels.stress.map(|stress| stress.map(|row| row.map(|x| 1.1 * x)));
        });
    }
    frames
}

fn change_labels(frame: &mut Frame, change: impl FnOnce(&mut FrameLabels)) {
    let mut labels = frame.labels().unwrap();
    change(&mut labels);
    frame.set_labels(&labels, LabelKeys::Ase);
}

/// The arguments of a short training of `data.extxyz`.
fn arguments(output: &str, more: &[&str]) -> Vec<String> {
    let model = config(MODEL).display().to_string();
    let first = ["upfit", "--model", &model, "data.extxyz", "--output", output];
    let short = ["--batch-size", "2", "--learning-rate", "1e-4", "--energy-weight", "1"];
    let mut all: Vec<_> = first.iter().chain(&short).chain(more).map(|text| (*text).to_owned()).collect();
    if !more.contains(&"--epochs") {
        all.extend(["--epochs".to_owned(), "2".to_owned()]);
    }
    all
}

fn train(here: &Path, output: &str, more: &[&str]) -> Vec<u8> {
    succeed(here, arguments(output, more));
    assert!(!here.join(format!("{output}.upfit")).exists());
    fs::read(here.join(output)).unwrap()
}

#[test]
fn the_loss_falls_and_the_number_of_threads_changes_no_byte() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames(5));
    let share = ["--validation-share", "0.2"];
    let printed = succeed(
        here,
        arguments("one.npz", &[&share[..], &["--threads", "1", "--json", "--figure", "a.svg"]].concat()),
    );
    let found: Json = serde_json::from_str(&printed).unwrap();
    for set in ["training", "validation"] {
        let loss = |when: &str| found[when][set]["loss"].as_f64().unwrap();
        assert!(loss("after") < loss("before"), "{printed}");
        for error in ["energy_mae", "force_mae", "stress_mae"] {
            let [before, after] = ["before", "after"].map(|when| found[when][set][error].as_f64().unwrap());
            assert!(before > 0.0 && after > 0.0 && before != after, "{printed}");
        }
    }
    assert_eq!((&found["updates"], &found["history"].as_array().unwrap().len()), (&4.into(), &2));
    // The labels' energies are a tenth larger, −0.34 eV/atom.
    let shift = found["energy_zero"]["shifts"][0]["shift"].as_f64().unwrap();
    assert!((shift + 0.34).abs() < 0.02, "{shift}");
    assert_eq!(found["note"]["files"][0]["file"], "data.extxyz");
    assert_eq!(
        (&found["note"]["files"][0]["structures"], &found["note"]["validation"]["structures"]),
        (&5.into(), &1.into())
    );
    assert!(fs::read_to_string(here.join("a.svg")).unwrap().contains("epoch"));

    let one = fs::read(here.join("one.npz")).unwrap();
    let two = train(here, "two.npz", &[&share[..], &["--threads", "2"]].concat());
    assert!(one == two, "the models differ");
    assert!(one != train(here, "other.npz", &[&share[..], &["--rng-seed", "7"]].concat()));

    let info = succeed(here, ["calm", "info", "one.npz"]);
    assert!(info.contains("upfit, on 4 structures") && info.contains("kokkos.npz (BLAKE3 "), "{info}");

    // The forces of the model are nearer to the labels than before.
    let labelled = frames(5);
    assert!(force_error(&here.join("one.npz"), &labelled) < force_error(&config(MODEL), &labelled));
}

/// Root mean square error of the force components, eV/Å.
fn force_error(model: &Path, frames: &[Frame]) -> f64 {
    let model = Arc::new(GraceModel::load(model).unwrap());
    let (mut grace, mut evaluation) = (Grace::new(Arc::clone(&model)), Evaluation::default());
    let mut squares = Vec::new();
    for frame in frames {
        let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
        neighbours.update(&frame.structure).unwrap();
        grace.evaluate(&frame.structure, &neighbours, &mut evaluation).unwrap();
        let labels = frame.labels().unwrap().forces.unwrap();
        let pairs = evaluation.forces.as_flattened().iter().zip(labels.as_flattened());
        squares.extend(pairs.map(|(model, label)| (model - label).powi(2)));
    }
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

#[test]
fn tables_say_what_was_trained() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = frames(4);
    write_frames(&here.join("data.extxyz"), &frames[..2]);
    let packed = {
        write_frames(&here.join("held.extxyz"), &frames[2..]);
        zstd::encode_all(&fs::read(here.join("held.extxyz")).unwrap()[..], 3).unwrap()
    };
    fs::write(here.join("held.extxyz.zst"), packed).unwrap();
    let more =
        ["--validation", "held.extxyz.zst", "--epochs", "1", "--average", "0.5", "--weight", "data.extxyz=2"];
    let output = calmwalk(here, arguments("out.npz", &more));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let (printed, progress) = (String::from_utf8_lossy(&output.stdout), stderr(&output));
    for expected in [
        "training",
        "validation",
        "before",
        "after",
        "stress MAE",
        "1 update in 1 epoch",
        "wrote out.npz",
        "calm build",
    ] {
        assert!(printed.contains(expected), "{printed}");
    }
    for expected in
        ["2 structures to train with, 2 structures for validation", "another zero", "epoch 1: loss", "eV/Å³"]
    {
        assert!(progress.contains(expected), "{progress}");
    }
}

#[test]
fn a_killed_or_stopped_training_goes_on_to_the_same_bytes() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames(5));
    let more = ["--epochs", "12", "--validation-share", "0.2"];
    let whole = train(here, "whole.npz", &more);
    let started = arguments("out.npz", &more);
    let state = here.join("out.npz.upfit");
    let start = || {
        let mut command = program(here);
        command.args(&started).stdout(Stdio::null()).stderr(Stdio::piped());
        command.spawn().unwrap()
    };
    let mut killed = Running(start());
    wait_until("there is a checkpoint", || state.exists());
    signal(killed.0.id(), "KILL");
    killed.0.wait().unwrap();
    assert!(state.exists() && !here.join("out.npz").exists());
    // A process that is killed while it writes leaves such files.
    let parts = [".out.npz.aB3x9Z.part", ".out.npz.upfit.aB3x9Z.part"].map(|name| here.join(name));
    parts.iter().for_each(|part| fs::write(part, "unfinished").unwrap());

    // Another training refuses the checkpoint.
    let message = refuse(here, arguments("out.npz", &[&more[..], &["--rng-seed", "7"]].concat()));
    assert!(message.contains("out.npz.upfit: checkpoint of another training"), "{message}");
    let mut changed = frames(5);
    changed[2].structure.positions[0][0] += 1e-6;
    write_frames(&here.join("data.extxyz"), &changed);
    let message = refuse(here, &started);
    assert!(message.contains("checkpoint of another training: its "), "{message}");
    write_frames(&here.join("data.extxyz"), &frames(5));

    let mut stopped = Running(start());
    let mut lines = BufReader::new(stopped.0.stderr.take().unwrap());
    let mut text = String::new();
    while !text.contains("continuing from out.npz.upfit") {
        assert_ne!(lines.read_line(&mut text).unwrap(), 0, "{text}");
    }
    signal(stopped.0.id(), "INT");
    lines.read_to_string(&mut text).unwrap();
    assert_eq!(stopped.0.wait().unwrap().code(), Some(130), "{text}");
    assert!(text.contains("the same command continues from out.npz.upfit"), "{text}");

    let output = calmwalk(here, &started);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(stderr(&output).contains("continuing from out.npz.upfit"), "{}", stderr(&output));
    assert!(fs::read(here.join("out.npz")).unwrap() == whole, "the models differ");
    assert!(!state.exists() && !parts.iter().any(|part| part.exists()));
}

#[test]
fn wrong_labels_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let good = frames(3);
    let wrong = |change: &dyn Fn(&mut Frame), reason: &str| {
        let mut frames = good.clone();
        change(&mut frames[1]);
        write_frames(&here.join("data.extxyz"), &frames);
        // Frames of 108 atoms have 110 lines.
        let message = refuse(here, arguments("out.npz", &["--validation-share", "0"]));
        assert!(message.contains("data.extxyz:111: ") && message.contains(reason), "{message}");
        assert!(!here.join("out.npz").exists() && !here.join("out.npz.upfit").exists());
    };
    wrong(
        &|frame: &mut Frame| change_labels(frame, |labels| labels.forces = None),
        "the structure has no forces",
    );
    wrong(
        &|frame: &mut Frame| change_labels(frame, |labels| labels.energy = None),
        "the structure has no energy",
    );
    wrong(
        &|frame: &mut Frame| change_labels(frame, |labels| labels.energy = Some(-1e7)),
        "the energy differs from the model's by",
    );
    wrong(
        &|frame: &mut Frame| {
            change_labels(frame, |labels| labels.forces.as_mut().unwrap()[7] = [0.0, 0.0, 2e3])
        },
        "the force on atom 7 is 2.0000e3 eV/Å, expected at most 1000 eV/Å",
    );
    wrong(
        &|frame: &mut Frame| frame.structure.species[4] = Species::from_atomic_number(14).unwrap(),
        "atom 4 is Si",
    );
}

#[test]
fn weights_of_frames_count_as_those_of_files() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut frames = frames(2);
    let whole = ["--validation-share", "0", "--epochs", "1", "--json"];
    let losses = |more: &[&str]| {
        let printed = succeed(here, arguments("out.npz", &[&whole[..], more].concat()));
        let found: Json = serde_json::from_str(&printed).unwrap();
        ["before", "after"].map(|when| found[when]["training"]["loss"].as_f64().unwrap())
    };
    write_frames(&here.join("data.extxyz"), &frames);
    let of_file = losses(&["--weight", "data.extxyz=0.5"]);
    for frame in &mut frames {
        frame.info.insert("calmwalk_weight".to_owned(), 0.5_f64.into());
    }
    write_frames(&here.join("data.extxyz"), &frames);
    assert_eq!(losses(&[]), of_file);

    frames[0].info.insert("calmwalk_weight".to_owned(), "heavy".into());
    write_frames(&here.join("data.extxyz"), &frames);
    let message = refuse(here, arguments("out.npz", &whole));
    assert!(
        message.contains("data.extxyz:1: calmwalk_weight is heavy; expected a number, 0 or more"),
        "{message}"
    );
}

#[test]
fn wrong_arguments_are_refused_before_any_work() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut frames = frames(2);
    for frame in &mut frames {
        frame.info.insert("seed_structure".to_owned(), "fcc".into());
    }
    write_frames(&here.join("data.extxyz"), &frames);
    let wrong = |more: &[&str], reason: &str| {
        let message = refuse(here, arguments("out.npz", more));
        assert!(message.contains(reason), "{message}");
        assert!(!here.join("out.npz").exists() && !here.join("out.npz.upfit").exists());
    };
    let whole = ["--validation-share", "0"];
    let and = |more: &'static [&'static str]| [&whole[..], more].concat();
    // Both frames belong to one seed structure.
    wrong(
        &["--validation-share", "0.5"],
        "2 structures belong to one seed structure, fcc; expected at least 2",
    );
    wrong(&and(&["--freeze", "no_such_weights"]), "begins with 'no_such_weights'; it has ");
    wrong(&and(&["--patience", "3"]), "--patience: expected a validation set");
    wrong(&and(&["--min-learning-rate", "1"]), "the smallest learning rate is 1");
    wrong(&and(&["--epochs", "0"]), "--epochs");
    wrong(&and(&["--epochs", "1", "--loss", "paper"]), "stage 2 of the loss begins after a share of 0.417");
    wrong(&["--validation-share", "1"], "up to, not including, 1");
    wrong(&["--validation", "missing.extxyz"], "missing.extxyz: cannot be opened");
    wrong(&and(&["--weight", "other.extxyz=2"]), "--weight other.extxyz: expected one of the files");
    wrong(&and(&["--figure", "data.extxyz"]), "data.extxyz is a file of training data");
    wrong(&and(&["--figure", "out.npz"]), "out.npz and out.npz: one file is named for two outputs");
    wrong(&and(&["--figure", "./out.npz"]), "./out.npz and out.npz: one file is named for two outputs");
    wrong(
        &["--validation", "./data.extxyz"],
        "./data.extxyz, a file of validation data, is the same file as data.extxyz, a file of training data",
    );
    symlink("data.extxyz", here.join("link.extxyz")).unwrap();
    wrong(&["--validation", "link.extxyz"], "link.extxyz, a file of validation data, is the same file");
    fs::copy(here.join("data.extxyz"), here.join("copy.extxyz")).unwrap();
    wrong(
        &["--validation", "copy.extxyz"],
        "copy.extxyz, a file of validation data, has the same content as data.extxyz, a file of training data",
    );
    let linked = here.join("link.npz");
    symlink(config(MODEL), &linked).unwrap();
    let message = refuse(here, arguments("link.npz", &whole));
    assert!(message.contains("link.npz is the model"), "{message}");
    fs::remove_file(linked).unwrap();
    for name in ["POSCAR", "CONTCAR.gz", "a.vasp", "walk.lammpstrj.zst", "dump.a"] {
        fs::write(here.join(name), "").unwrap();
        let reason =
            format!("{name}: POSCAR files and dumps of LAMMPS have no labels; expected extended XYZ");
        wrong(&["--validation", name], &reason);
    }
    fs::write(here.join("notes.txt"), "no checkpoint").unwrap();
    let output = calmwalk(here, arguments("out.npz", &and(&["--checkpoint", "notes.txt"])));
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("notes.txt: no checkpoint of calmwalk upfit"), "{}", stderr(&output));
    assert_eq!(fs::read_to_string(here.join("notes.txt")).unwrap(), "no checkpoint");
}
