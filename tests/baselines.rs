//! `calmwalk calm baseline`, and `calm score` with its files, on the aluminium model.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use atoms::cell::{norm, sub};
use atoms::extxyz::Frame;
use atoms::{Cell, Structure, read_extxyz};
use calm::Artifact;
use calm::baselines::{Baseline, BaselineFile, BaselineKind};
use npyz::NpyFile;

use crate::common::npz::with_changed_arrays;
use crate::common::{calmwalk, config, deviation, refuse, succeed, write_frames};

const MODEL: &str = "data/al_eam_1l/kokkos.npz";
const ARTIFACT: &str = "data/al_eam_1l/gmm_artifacts.npz";

fn path(file: &str) -> String {
    config(file).display().to_string()
}

/// The first frames of the demonstration's training data, 108 atoms each.
fn training(count: usize) -> Vec<Frame> {
    let mut frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    frames.truncate(count);
    frames
}

/// Four atoms near the sites of a cubic cell with this edge, Å.
fn cell(edge: f64, shift: f64) -> Frame {
    let sites = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    let mut positions = sites.map(|site| site.map(|x| edge * x)).to_vec();
    positions[1][0] += shift;
    Frame::from(Structure {
        species: vec!["Al".parse().unwrap(); 4],
        positions,
        cell: Cell::orthorhombic(edge, edge, edge),
        periodic: [true; 3],
    })
}

fn baseline(here: &Path, arguments: &[&str]) -> String {
    let model = path(MODEL);
    let start = ["calm", "baseline", "--model", &model, "train.extxyz", "--output"];
    succeed(here, start.iter().chain(arguments))
}

fn score(here: &Path, input: &str, arguments: &[&str]) -> Vec<Frame> {
    let model = path(MODEL);
    let start = ["calm", "score", "--model", &model, input, "--output", "scored.extxyz"];
    succeed(here, start.iter().chain(arguments));
    read_extxyz(&here.join("scored.extxyz")).unwrap()
}

fn column(frames: &[Frame], name: &str) -> Vec<f64> {
    frames.iter().flat_map(|frame| frame.arrays[name].reals().unwrap()).collect()
}

fn largest(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
}

#[test]
fn atoms_are_scored_by_every_kind() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("train.extxyz"), &training(4));
    let kinds: Vec<BaselineKind> =
        BaselineKind::ALL.into_iter().filter(|kind| !kind.has_force_form()).collect();
    let mut arguments = vec!["b.npz", "--neighbours", "1", "--artifact"];
    let artifact = path(ARTIFACT);
    arguments.push(&artifact);
    kinds.iter().for_each(|kind| arguments.extend(["--kind", kind.name()]));
    let printed = baseline(here, &arguments);
    let lines: Vec<&str> = printed.lines().collect();
    assert!(lines[0].starts_with("score") && lines.last() == Some(&"wrote b.npz"), "{printed}");
    assert!(lines[1].starts_with("d-optimality-element") && !printed.contains("not converged"), "{printed}");

    // Far from the training data, every score is larger than at any training atom.
    write_frames(&here.join("in.extxyz"), &[training(1).remove(0), cell(3.2, 0.1), cell(5.2, 0.3)]);
    let frames = score(here, "in.extxyz", &["--baseline", "b.npz", "--features", "z.npy"]);
    for kind in &kinds {
        let name = kind.name().replace('-', "_");
        let inside = column(&frames[..1], &name);
        for outside in &frames[1..] {
            let outside = column(std::slice::from_ref(outside), &name);
            assert!(largest(&outside) > largest(&inside), "{name}: {outside:?} {}", largest(&inside));
        }
        if name.starts_with("d_opt") {
            assert!(largest(&inside) <= 1.01 + 1e-4, "{name}: {}", largest(&inside));
        }
        // The neighbourhood average is bounded by the largest score.
        let average = column(&frames, &format!("{name}_nbr"));
        assert!(
            average.iter().all(|x| x.is_finite()) && largest(&average) <= largest(&column(&frames, &name))
        );
    }
    let own = column(&frames[..1], "k_nearest");
    assert!(largest(&own) < 1e-9, "a training atom is its own neighbour: {own:?}");
    check_by_features(here, &frames);
}

/// Checks scores against the features that `calm score` wrote.
fn check_by_features(here: &Path, frames: &[Frame]) {
    let file = NpyFile::new(BufReader::new(File::open(here.join("z.npy")).unwrap())).unwrap();
    let features: Vec<f64> = file.into_vec().unwrap();
    let artifact = Artifact::load(config(ARTIFACT)).unwrap();
    let centroid = artifact.mixture.component(0, 0).unwrap().centroid();
    let distance = |z: &[f64]| z.iter().zip(centroid).map(|(z, c)| (z - c) * (z - c)).sum::<f64>().sqrt();
    let expected: Vec<f64> = features.chunks_exact(centroid.len()).map(distance).collect();
    assert!(deviation(&column(frames, "euclidean"), &expected) < 1e-12);
    let stored = BaselineFile::load(here.join("b.npz")).unwrap();
    let Some(Baseline::DOptimality(active)) = stored.baselines.first() else { panic!("active sets") };
    assert!(
        active.is_converged() && active.ranks()[0] <= 130 && active.ranks()[0] > 60,
        "{:?}",
        active.ranks()
    );
    let scores = stored.baselines[0].score(&vec![0; expected.len()], &features).unwrap();
    assert!(deviation(&column(frames, "d_optimality_element"), &scores) < 1e-6);
}

#[test]
fn forces_have_uncertainties_and_ensembles_disagree() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let train = [cell(4.0, 0.1), cell(4.1, 0.2)];
    write_frames(&here.join("train.extxyz"), &train);
    write_frames(&here.join("in.extxyz"), &[cell(4.05, 0.0), cell(4.05, 0.6)]);
    let common = ["--kind", "llpr-forces", "--regularisation", "1e-6", "--feature-variant", "hidden"];
    baseline(here, &[&["f.npz"], &common[..]].concat());
    let readout = |name: &str, numbers: &mut Vec<f64>| {
        if name == "energy_mlp_W0" {
            numbers.iter_mut().for_each(|number| *number *= 1.05);
        }
    };
    std::fs::write(here.join("other.npz"), with_changed_arrays(&config(MODEL), readout)).unwrap();
    let of_other = ["calm", "score", "--model", "other.npz", "in.extxyz", "--output", "other.extxyz"];
    succeed(here, of_other);
    let frames = score(here, "in.extxyz", &["--baseline", "f.npz", "--ensemble", "other.npz"]);
    // Forces of the first frame vanish by symmetry for any weights; those of the second are uncertain.
    let (still, moved) =
        (column(&frames[..1], "hidden_llpr_forces"), column(&frames[1..], "hidden_llpr_forces"));
    assert!(largest(&still) < 1e-6 * largest(&moved) && largest(&moved) > 0.0, "{still:?} {moved:?}");
    // The standard deviation of two numbers is half their distance.
    let others = read_extxyz(&here.join("other.extxyz")).unwrap();
    let forces = |frames: &[Frame]| -> Vec<_> {
        frames.iter().flat_map(|frame| frame.labels().unwrap().forces.unwrap()).collect()
    };
    let pairs = forces(&frames).into_iter().zip(forces(&others));
    let expected: Vec<f64> = pairs.map(|(own, other)| 0.5 * norm(sub(own, other))).collect();
    let found = column(&frames, "force_deviation");
    assert!(largest(&expected) > 1e-3 && deviation(&found, &expected) < 1e-6, "{found:?} {expected:?}");
    let average = largest(&column(&frames, "force_deviation_nbr"));
    assert!(average > 0.0 && average <= largest(&found), "{average}");
    // The model itself disagrees with nothing.
    let model = path(MODEL);
    let same = score(here, "in.extxyz", &["--ensemble", &model]);
    assert!(column(&same, "force_deviation").iter().all(|deviation| *deviation == 0.0));
}

#[test]
fn gamma_is_averaged_with_other_weights() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = training(1);
    write_frames(&here.join("in.extxyz"), &frames);
    let weights = ["cosine", "uniform", "uniform:3.3", "cosine:3.3"];
    let arguments: Vec<_> = weights.iter().flat_map(|weights| ["--gamma-nbr", weights]).collect();
    let scored = score(here, "in.extxyz", &arguments);
    let of = |name: &str| column(&scored, name);
    assert_eq!(of("gamma_nbr_cosine"), of("gamma_nbr"));

    // The mean over the atom and its neighbours, found by distance alone.
    let (gamma, structure) = (of("gamma"), &frames[0].structure);
    let distance = |a: [f64; 3], b: [f64; 3]| {
        let nearest_image = structure.cell.fractional(sub(a, b)).map(|x| x - x.round());
        norm(structure.cell.cartesian(nearest_image))
    };
    let mean = |centre: &[f64; 3]| {
        let near =
            structure.positions.iter().zip(&gamma).filter(|(other, _)| distance(*centre, **other) < 3.3);
        let (number, sum) = near.fold((0.0, 0.0), |(number, sum), (_, gamma)| (number + 1.0, sum + gamma));
        assert!(number > 8.0, "{number}");
        sum / number
    };
    let expected: Vec<f64> = structure.positions.iter().map(mean).collect();
    assert!(deviation(&of("gamma_nbr_uniform_3.3"), &expected) < 1e-9);
    for name in ["gamma_nbr_uniform", "gamma_nbr_cosine_3.3"] {
        assert!(deviation(&of(name), &expected) > 1e-3, "{name}");
    }
    let refused = |weights: &str| {
        let start =
            ["calm", "score", "--model", &path(MODEL), "in.extxyz", "-o", "o.extxyz", "--gamma-nbr", weights];
        refuse(here, start)
    };
    assert!(refused("gauss").contains("expected cosine or uniform"));
    assert!(refused("uniform:0").contains("radius '0': expected a positive number in Å"));
}

#[test]
fn mixtures_and_baselines_have_other_features() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = training(4);
    write_frames(&here.join("train.extxyz"), &frames);
    write_frames(&here.join("in.extxyz"), &frames[..1]);
    let model = path(MODEL);
    let build = ["calm", "build", "--model", &model, "train.extxyz", "--output", "linear.npz"];
    succeed(here, build.iter().chain(&["--feature-variant", "linear", "--candidates", "1"]));
    let info = succeed(here, ["calm", "info", "linear.npz", "--json"]);
    let info: serde_json::Value = serde_json::from_str(&info).unwrap();
    assert_eq!((&info["schema"], &info["feature_dimension"]), (&3.into(), &128.into()), "{info}");

    // The artifact determines the features.
    baseline(here, &["l.npz", "--artifact", "linear.npz", "--kind", "d-optimality-centred,likelihood"]);
    let scored = score(here, "in.extxyz", &["--artifact", "linear.npz", "--baseline", "l.npz"]);
    assert!(largest(&column(&scored, "d_optimality_centred")) <= 1.01 + 1e-4);
    assert!(column(&scored, "likelihood").iter().all(|x| x.is_finite()));
    // Scores of the linear features are named after them, because γ uses the normalised features.
    baseline(
        here,
        &["h.npz", "--feature-variant", "hidden", "--kind", "llpr", "--kind", "d-optimality-element"],
    );
    let scored = score(here, "in.extxyz", &["--baseline", "l.npz", "--baseline", "h.npz"]);
    assert!(largest(&column(&scored, "linear_d_optimality_centred")) <= 1.01 + 1e-4);
    assert!(largest(&column(&scored, "hidden_d_optimality_element")) <= 1.01 + 1e-4);
    assert!(column(&scored, "hidden_llpr").iter().all(|u| *u > 0.0));
}

#[test]
fn what_does_not_belong_together_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("train.extxyz"), &[cell(4.0, 0.1)]);
    let (model, artifact) = (path(MODEL), path(ARTIFACT));
    let start = ["calm", "baseline", "--model", &model, "train.extxyz", "--output"];
    let refused = |more: &[&str]| refuse(here, start.iter().chain(more));
    for (more, reason) in [
        (&["b.npz", "--kind", "likelihood"][..], "--kind likelihood: the mixture has no counts"),
        (&["b.npz", "--kind", "llpr", "--kind", "llpr"], "--kind llpr: given twice"),
        (&["b.npz", "--kind", "euclidean", "--feature-variant", "hidden"], "euclidean needs a mixture"),
        (
            &["b.npz", "--kind", "euclidean", "--feature-variant", "linear", "--artifact", &artifact],
            "its feature dimension is 130, the model's is 128",
        ),
        (
            &["b.npz", "--kind", "llpr", "--feature-variant", "hidden", "--artifact", &artifact],
            "its feature dimension is 130",
        ),
        (
            &["b.npz", "--kind", "llpr", "--regularisation", "0"],
            "regularisation: found 0, expected a number above 0",
        ),
        (&["train.extxyz", "--kind", "llpr"], "a file of training data"),
        (&["b.npz", "--kind", "maxvol"], "expected one of d-optimality-element"),
    ] {
        let message = refused(more);
        assert!(message.contains(reason), "{message}");
    }
    assert!(!here.join("b.npz").exists());

    baseline(here, &["b.npz", "--kind", "llpr,k-nearest"]);
    let silicon = path("data/si_sw_1l/kokkos.npz");
    let score = |model: &str, more: &[&str]| {
        let start = ["calm", "score", "--model", model, "train.extxyz", "--output", "o.extxyz", "--baseline"];
        refuse(here, start.iter().chain(more))
    };
    let message = score(&silicon, &["b.npz"]);
    assert!(
        message.contains("b.npz: the baselines belong to another model: their list of elements is Al"),
        "{message}"
    );
    let message = score(&model, &["b.npz", "--baseline", "b.npz"]);
    assert!(message.contains("another file of baselines has a score 'llpr', too"), "{message}");
    assert!(score(&model, &[&artifact]).contains("expected a file that `calmwalk calm baseline` wrote"));
    assert!(score(&model, &["train.extxyz"]).contains("expected a NumPy .npz archive"));
    assert_eq!(calmwalk(here, ["calm", "baseline"]).status.code(), Some(2));
}
