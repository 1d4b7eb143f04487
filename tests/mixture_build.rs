//! `calmwalk calm build`: the bytes do not depend on the division of the work or on interruptions, and the mixture grades its
//! own data.

mod data;
mod elements;
mod features;
mod kills;
mod memory;
mod parts;
mod projection;

use std::fs;
use std::io::{Read, Write};
use std::path::Path;
use std::process::Stdio;

use atoms::extxyz::Frame;
use atoms::read_extxyz;
use calm::Artifact;
use npyz::zip::ZipArchive;

use crate::common::processes::{PausedProcesses, signal, wait_until};
use crate::common::{Running, calmwalk, config, program, refuse, stderr, succeed, write_frames};

const MODEL: &str = "data/al_eam_1l/kokkos.npz";

/// Atoms of the demonstration's training data.
const ATOMS: usize = 5400;

fn frames() -> Vec<Frame> {
    read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap()
}

/// The arguments of a build of `data` with small shards.
fn arguments(output: &str, data: &[&str], more: &[&str]) -> Vec<String> {
    let model = config(MODEL).display().to_string();
    let first = ["calm", "build", "--model", &model, "--output", output, "--shard-size", "3"];
    first.iter().chain(data).chain(more).map(|text| (*text).to_owned()).collect()
}

fn build(here: &Path, output: &str, data: &[&str], more: &[&str]) -> (Vec<u8>, String) {
    let printed = succeed(here, arguments(output, data, more));
    assert!(!here.join(format!("{output}.build")).exists());
    (fs::read(here.join(output)).unwrap(), printed)
}

/// Writes a model as exported after training, without arrays of features and mixture.
fn write_plain_model(here: &Path, model: &str) {
    let mut out = npz::Writer::new(fs::File::create(here.join("plain.npz")).unwrap());
    out.copy(fs::File::open(config(model)).unwrap(), |key| key.starts_with("uq_")).unwrap();
    out.finish().unwrap();
}

/// γ of all atoms of `data.extxyz`.
fn grades(here: &Path, model: &str, artifact: &[&str]) -> Vec<f64> {
    let start = ["calm", "score", "--model", model, "data.extxyz", "--output", "scored.extxyz"];
    succeed(here, start.iter().chain(artifact));
    let scored = read_extxyz(&here.join("scored.extxyz")).unwrap();
    scored.iter().flat_map(|frame| frame.arrays["gamma"].reals().unwrap()).collect()
}

#[test]
fn the_number_of_threads_changes_no_byte_and_the_mixture_grades_its_data() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames());
    let (one, printed) =
        build(here, "one.npz", &["data.extxyz"], &["--threads", "1", "--embed", "model.npz"]);
    let (two, _) = build(here, "two.npz", &["data.extxyz"], &["--threads", "2"]);
    assert!(one == two, "the artifacts differ");
    // Another random seed gives another mixture.
    let (other, _) = build(here, "other.npz", &["data.extxyz"], &["--rng-seed", "7"]);
    assert!(one != other);

    let model = config(MODEL).display().to_string();
    let gamma = grades(here, &model, &["--artifact", "one.npz"]);
    assert_eq!(gamma.len(), ATOMS);
    let above = gamma.iter().filter(|gamma| **gamma > 1.0).count() as f64 / ATOMS as f64;
    let row: Vec<&str> = printed.lines().nth(1).unwrap().split_whitespace().collect();
    assert_eq!(row[..2], ["Al", "5400"]);
    let shown: f64 = row[row.len() - 2].parse().unwrap();
    assert!(shown < 10.0 && (shown / 100.0 - above).abs() < 5e-4, "{shown} % {above}");
    assert!(printed.ends_with("wrote one.npz\n"), "{printed}");

    // The model with the embedded mixture differs only in its mixture, and gives the same grades as the artifact.
    assert_eq!(grades(here, "model.npz", &[]), gamma);
    assert!(grades(here, &model, &[]) != gamma);
    let (old, new) = (arrays(&config(MODEL)), arrays(&here.join("model.npz")));
    assert!(old.iter().map(|array| &array.0).eq(new.iter().map(|array| &array.0)));
    let changed: Vec<_> =
        old.iter().zip(&new).filter(|(a, b)| a.1 != b.1).map(|(a, _)| a.0.as_str()).collect();
    assert!(changed.contains(&"uq_centroids.npy"), "{changed:?}");
    assert!(changed.iter().all(|name| name.starts_with("uq_") && !name.starts_with("uq_rp_")), "{changed:?}");
}

/// Names and bytes of the files of an archive, by name.
fn arrays(path: &Path) -> Vec<(String, Vec<u8>)> {
    let mut archive = ZipArchive::new(fs::File::open(path).unwrap()).unwrap();
    let read = |index| {
        let (mut file, mut bytes) = (archive.by_index(index).unwrap(), Vec::new());
        file.read_to_end(&mut bytes).unwrap();
        (file.name().to_owned(), bytes)
    };
    let mut all: Vec<_> =
        (0..ZipArchive::new(fs::File::open(path).unwrap()).unwrap().len()).map(read).collect();
    all.sort();
    all
}

#[test]
fn an_interrupted_build_continues_and_another_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let files = ["a.extxyz", "b.extxyz", "c.extxyz"];
    files.iter().for_each(|file| write_frames(&here.join(file), &frames()));
    let started = arguments("out.npz", &files, &["--weight", "b.extxyz=0.5", "--threads", "1"]);
    let mut command = program(here);
    let child = command.args(&started).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let state = here.join("out.npz.build");
    wait_until("a shard is finished", || state.join("pass-1").exists());
    let held = PausedProcesses::new([child.id()]);
    assert!(fail(here, &started).contains("another process is building out.npz"));
    signal(child.id(), "INT");
    held.resume();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
    assert!(stderr(&output).contains("the same command continues"));
    assert!(!here.join("out.npz").exists());

    let refused = |data: &[&str], more: &[&str], difference: &str| {
        let message = refuse(here, arguments("out.npz", data, more));
        assert!(message.contains("another build") && message.contains(difference), "{message}");
        assert!(message.contains("--restart"), "{message}");
    };
    let weights = ["--weight", "b.extxyz=0.5"];
    refused(&files, &[], "--weight of b.extxyz is 0.5, now it is 1");
    refused(
        &files[..2],
        &weights,
        "list of data files is a.extxyz b.extxyz c.extxyz, now it is a.extxyz b.extxyz",
    );
    refused(&files, &["--weight", "b.extxyz=0.5", "--rng-seed", "1"], "--rng-seed is 42, now it is 1");
    refused(&files, &["--weight", "b.extxyz=0.5", "--candidates", "1,2,4"], "--candidates is 1,2,4,8,16");

    let output = calmwalk(here, &started);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(stderr(&output).contains("continuing from out.npz.build"), "{}", stderr(&output));
    let continued = fs::read(here.join("out.npz")).unwrap();
    let (anew, _) = build(here, "anew.npz", &files, &weights);
    assert!(continued == anew);
    // The statistics include the weights.
    let artifact = Artifact::load(here.join("anew.npz")).unwrap();
    let statistics =
        artifact.mixture.components(0).unwrap().iter().map(|component| component.statistics().unwrap());
    let (count, effective) = statistics.fold((0.0, 0.0), |(n, w), of| (n + of.count, w + of.effective_count));
    assert_eq!((count, effective), (3.0 * ATOMS as f64, 2.5 * ATOMS as f64));
}

/// Runs the program, which must fail with exit code 1. Returns its standard error.
fn fail(here: &Path, arguments: &[String]) -> String {
    let output = calmwalk(here, arguments);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    stderr(&output)
}

#[test]
fn compressed_files_and_several_files_give_the_same_mixture() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = frames();
    let (first, rest) = frames.split_at(20);
    let (second, last) = rest.split_at(29);
    write_frames(&here.join("first.extxyz"), first);
    write_frames(&here.join("second.extxyz"), second);
    let mut poscar = Vec::new();
    let [last] = last else { panic!("one frame is left") };
    atoms::poscar::write_poscar(&mut poscar, &last.structure, "aluminium").unwrap();
    fs::write(here.join("POSCAR"), &poscar).unwrap();
    let (plain, _) = build(here, "plain.npz", &["first.extxyz", "second.extxyz", "POSCAR"], &[]);

    let packed = zstd::encode_all(&fs::read(here.join("first.extxyz")).unwrap()[..], 3).unwrap();
    fs::write(here.join("first.xyz.zst"), packed).unwrap();
    for (from, to) in [("second.extxyz", "second.extxyz.gz"), ("POSCAR", "POSCAR.gz")] {
        let file = fs::File::create(here.join(to)).unwrap();
        let mut encoder = flate2::write::GzEncoder::new(file, flate2::Compression::fast());
        encoder.write_all(&fs::read(here.join(from)).unwrap()).unwrap();
        encoder.finish().unwrap();
    }
    let (unpacked, _) = build(here, "packed.npz", &["first.xyz.zst", "second.extxyz.gz", "POSCAR.gz"], &[]);
    assert!(plain == unpacked);
}

#[test]
fn a_bad_structure_is_named_and_what_was_finished_is_kept() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let cell = "Lattice=\"4 0 0 0 4 0 0 0 4\" Properties=species:S:1:pos:R:3";
    write_frames(&here.join("data.extxyz"), &frames());
    let good = fs::read_to_string(here.join("data.extxyz")).unwrap();
    let (expected, _) = build(here, "expected.npz", &["data.extxyz"], &[]);
    let line = good.lines().count() + 1;
    let mut logs = Vec::new();
    for (bad, place, reason) in [
        (format!("1\n{cell}\nSi 0 0 0\n"), line, "atom 0 is Si"),
        (format!("2\n{cell}\nAl 0 0 0\nAl 0 0 0.1\n"), line, "atoms 0 and 1 are 0.100 Å apart"),
        (format!("2\n{cell}\nAl 0 0 0\n"), line + 3, "ends after 1 of the 2 atoms"),
    ] {
        fs::write(here.join("data.extxyz"), format!("{good}{bad}")).unwrap();
        let message = refuse(here, arguments("out.npz", &["data.extxyz"], &["--threads", "2"]));
        assert!(message.contains(&format!("data.extxyz:{place}: ")) && message.contains(reason), "{message}");
        logs.push(fs::read(here.join("out.npz.build/pass-1")).unwrap());
    }
    // Finished shards are neither computed nor saved again.
    assert!(!logs[0].is_empty() && logs.iter().all(|log| *log == logs[0]));
    fs::write(here.join("data.extxyz"), &good).unwrap();
    let (mended, _) = build(here, "out.npz", &["data.extxyz"], &[]);
    assert!(mended == expected);
}

#[test]
fn changed_data_and_damaged_states_are_noticed() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    // Enough data to kill the build before its end.
    let mut frames = [frames(), frames(), frames()].concat();
    write_frames(&here.join("data.extxyz"), &frames);
    let arguments = arguments("out.npz", &["data.extxyz"], &["--threads", "1"]);
    let state = here.join("out.npz.build");
    let mut running =
        Running(program(here).args(&arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    wait_until("pass 2 has begun", || state.join("pass-2").exists());
    signal(running.0.id(), "KILL");
    running.0.wait().unwrap();
    assert!(!here.join("out.npz").exists());

    frames[10].structure.positions[0][0] += 1e-9;
    write_frames(&here.join("data.extxyz"), &frames);
    let message = refuse(here, &arguments);
    assert!(message.contains("shard 3 (from data.extxyz:991)"), "{message}");
    assert!(message.contains("changed since pass 1"), "{message}");
    frames.truncate(48);
    frames[10].structure.positions[0][0] -= 1e-9;

    let path = state.join("pass-2");
    let mut bytes = fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&path, bytes).unwrap();
    assert!(fail(here, &arguments).contains("damaged; start over with --restart"));
    write_frames(&here.join("data.extxyz"), &frames);
    let (anew, _) = build(here, "out.npz", &["data.extxyz"], &["--threads", "1", "--restart"]);
    let (other, _) = build(here, "other.npz", &["data.extxyz"], &[]);
    assert!(anew == other);
}

#[test]
fn wrong_arguments_are_refused_before_any_work() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames()[..1]);
    fs::write(here.join("empty.extxyz"), "").unwrap();
    fs::write(here.join("data.cif"), "").unwrap();
    fs::write(here.join("broken.xyz.gz"), "no archive").unwrap();
    let wrong = |data: &[&str], more: &[&str], reason: &str| {
        let message = refuse(here, arguments("out.npz", data, more));
        assert!(message.contains(reason), "{message}");
        assert!(!here.join("out.npz").exists());
    };
    let data = &["data.extxyz"];
    wrong(&["missing.extxyz"], &[], "missing.extxyz: cannot be opened");
    wrong(&["empty.extxyz"], &[], "empty.extxyz: the file has no structures");
    wrong(&["data.cif"], &[], "data.cif: unknown format");
    wrong(&["broken.xyz.gz"], &["--restart"], "broken.xyz.gz:1: ");
    wrong(&["data.extxyz", "data.extxyz"], &[], "given twice");
    wrong(data, &["--weight", "other.extxyz=2"], "--weight other.extxyz: expected one of the files");
    wrong(data, &["--weight", "data.extxyz=-1"], "expected FILE=W with a number W, 0 or more");
    wrong(data, &["--weight", "data.extxyz"], "expected FILE=W");
    wrong(data, &["--candidates", "4,2"], "found [4, 2], expected at least one, ascending");
    wrong(data, &["--shard-size", "0"], "--shard-size");
    wrong(data, &["--embed", "data.extxyz"], "data.extxyz is a file of training data");
    wrong(data, &["--embed", "missing/model.npz"], "cannot write missing/model.npz");
}

#[test]
fn thresholds_are_computed_again_from_the_histograms() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames());
    build(here, "built.npz", &["data.extxyz"], &["--embed", "model.npz"]);
    let above = |artifact: &str, model: &str| {
        let grades = grades(here, model, &["--artifact", artifact]);
        grades.iter().filter(|gamma| **gamma > 1.0).count() as f64 / grades.len() as f64
    };
    // Half of the atoms of each component are above the median, up to the width of a bin.
    let options = ["--percentile", "50", "--model", "model.npz", "--embed", "half_model.npz"];
    let first = ["calm", "recalibrate", "built.npz", "--output", "half.npz"];
    let printed = succeed(here, first.iter().chain(&options));
    assert!(printed.contains("wrote half.npz"), "{printed}");
    let half = above("half.npz", "model.npz");
    assert!((half - 0.5).abs() < 0.02, "{half}");
    let own = grades(here, "half_model.npz", &[]);
    assert_eq!(own, grades(here, "model.npz", &["--artifact", "half.npz"]));
    // Without the option, the result equals the built artifact.
    succeed(here, ["calm", "recalibrate", "half.npz", "--output", "again.npz"]);
    assert_eq!(
        Artifact::load(here.join("again.npz")).unwrap(),
        Artifact::load(here.join("built.npz")).unwrap()
    );

    let message = refuse(here, ["calm", "recalibrate", "built.npz", "--output", "built.npz"]);
    assert!(message.contains("built.npz is the artifact itself: name another file"), "{message}");
    let message =
        refuse(here, ["calm", "recalibrate", "built.npz", "--output", "x.npz", "--percentile", "0"]);
    assert!(message.contains("expected a percentage, above 0 and at most 100"), "{message}");
    let other = config(MODEL).display().to_string();
    let message = refuse(
        here,
        ["calm", "recalibrate", "built.npz", "--output", "x.npz", "--model", &other, "--embed", "y.npz"],
    );
    assert!(message.contains("the model has another mixture than the artifact"), "{message}");
    assert!(!here.join("x.npz").exists() && !here.join("y.npz").exists());
}

#[test]
fn two_artifacts_are_compared_on_the_same_structures() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames());
    build(here, "a.npz", &["data.extxyz"], &["--candidates", "1"]);
    build(here, "b.npz", &["data.extxyz"], &["--candidates", "4"]);
    let model = config(MODEL).display().to_string();
    let compared = |first: &str, second: &str| -> serde_json::Value {
        let arguments = ["calm", "compare", "--model", &model, first, second, "data.extxyz", "--json"];
        serde_json::from_str(&succeed(here, arguments)).unwrap()
    };
    let same = compared("a.npz", "a.npz");
    assert_eq!((&same[0]["element"], &same[0]["atoms"]), (&"Al".into(), &ATOMS.into()));
    assert_eq!(
        (&same[0]["rank_correlation"], &same[0]["only"]),
        (&1.0.into(), &serde_json::json!([0.0, 0.0]))
    );
    let found = compared("a.npz", "b.npz");
    for (index, artifact) in ["a.npz", "b.npz"].into_iter().enumerate() {
        let mut grades = grades(here, &model, &["--artifact", artifact]);
        grades.sort_by(f64::total_cmp);
        let above = grades.iter().filter(|gamma| **gamma > 1.0).count() as f64 / ATOMS as f64;
        assert_eq!(found[0]["above_1"][index].as_f64(), Some(above));
        // The sample has all atoms; the output of `calm score` has fewer digits.
        let median = 0.5 * (grades[ATOMS / 2 - 1] + grades[ATOMS / 2]);
        assert!((found[0]["median"][index].as_f64().unwrap() - median).abs() < 1e-6);
    }
    let only: Vec<f64> = serde_json::from_value(found[0]["only"].clone()).unwrap();
    let above: Vec<f64> = serde_json::from_value(found[0]["above_1"].clone()).unwrap();
    assert!((above[0] - above[1] - (only[0] - only[1])).abs() < 1e-12);
    assert!((0.5..1.0).contains(&found[0]["rank_correlation"].as_f64().unwrap()));
    let printed = succeed(here, ["calm", "compare", "--model", &model, "a.npz", "b.npz", "data.extxyz"]);
    assert!(printed.contains("only A") && printed.contains("A a.npz"), "{printed}");
    let silicon = config("data/si_sw_1l/gmm_artifacts.npz").display().to_string();
    let message = refuse(here, ["calm", "compare", "--model", &model, "a.npz", &silicon, "data.extxyz"]);
    assert!(
        message.contains("si_sw_1l/gmm_artifacts.npz") && message.contains("list of elements"),
        "{message}"
    );
}
