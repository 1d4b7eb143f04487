//! Exports for gracemaker and MACE, and artifacts of `calm build`, read by the loaders of these programs. Needs two Pythons,
//! named by `CALMWALK_GRACEMAKER_PYTHON` (tensorpotential from PyPI) and `CALMWALK_MACE_PYTHON` (mace-torch); `.ci/loaders`
//! installs both.

use std::path::Path;
use std::process::Command;

use atoms::extxyz::Frame;
use atoms::read_extxyz;
use calm::Artifact;

use crate::common::campaign::Small;
use crate::common::{config, deviation, stderr, succeed, write_frames};

/// Energy (eV), forces (eV/Å) and stress (eV/Å³) of a frame, as a loader returns them.
type Loaded = (f64, Vec<f64>, Vec<f64>);

#[test]
fn gracemaker_loads_what_is_written() {
    loads(
        "grace",
        "CALMWALK_GRACEMAKER_PYTHON",
        "from tensorpotential.cli.data import load_extxyz\n\
         frames = load_extxyz('out.extxyz').to_dict('records')",
    );
}

#[test]
fn mace_loads_what_is_written() {
    loads(
        "mace",
        "CALMWALK_MACE_PYTHON",
        "from mace.data import KeySpecification, load_from_xyz, update_keyspec_from_kwargs\n\
         from mace.tools.default_keys import DefaultKeys\n\
         keys = update_keyspec_from_kwargs(KeySpecification(), DefaultKeys.keydict())\n\
         _, found = load_from_xyz('out.extxyz', keys)\n\
         frames = [frame.properties for frame in found]",
    );
}

#[test]
fn gracemaker_grades_by_an_artifact_that_was_built() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = |file: &str| config(&format!("data/al_eam_1l/{file}")).display().to_string();
    let (model, data) = (path("kokkos.npz"), path("seed_frames.extxyz"));
    succeed(here, ["calm", "build", "--model", &model, &data, "--output", "calm.npz", "--shard-size", "9"]);
    let grades = &both_grades(here, &[(&model, "calm.npz", &data)])[0];
    assert!(grades.len() == 5400 && grades.iter().any(|[gamma, _]| *gamma > 1.0));
}

/// Several elements with several components, no hydrogen atoms, and our own projection.
#[test]
fn gracemaker_grades_by_an_artifact_of_several_elements() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = |file: &str| config(&format!("data/ni_al_h_eam_1l/{file}")).display().to_string();
    let (model, data) = (path("kokkos.npz"), path("seed_frames.extxyz"));
    let frames = read_extxyz(Path::new(&data)).unwrap();
    let has_hydrogen = |frame: &Frame| frame.structure.species.iter().any(|element| element.symbol() == "H");
    let metals: Vec<Frame> = frames.iter().filter(|frame| !has_hydrogen(frame)).take(150).cloned().collect();
    write_frames(&here.join("metals.extxyz"), &metals);
    write_frames(&here.join("all.extxyz"), &frames[..frames.len().min(60)]);
    let plain = without_mixture(Path::new(&model));
    std::fs::write(here.join("plain.npz"), plain).unwrap();
    let build = ["calm", "build", "--shard-size", "10", "--candidates", "2,4", "metals.extxyz"];
    succeed(here, build.iter().chain(&["--model", &model, "--output", "calm.npz"]));
    succeed(
        here,
        build.iter().chain(&["--model", "plain.npz", "--output", "own.npz", "--embed", "own_model.npz"]),
    );
    let artifact = Artifact::load(here.join("calm.npz")).unwrap();
    assert!(artifact.mixture.iter().any(|(_, slot, _)| slot > 0));
    let cases = [(model.as_str(), "calm.npz"), ("plain.npz", "own.npz"), ("own_model.npz", "own.npz")]
        .map(|(model, artifact)| (model, artifact, "all.extxyz"));
    for ((model, ..), grades) in cases.iter().zip(both_grades(here, &cases)) {
        assert!(grades.iter().any(|[gamma, _]| *gamma > 1.0), "{model}");
    }
}

#[test]
fn gracemaker_grades_by_the_mixture_of_a_campaign() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml"]);
    let path = |file: &str| config(&format!("data/al_eam_1l/{file}")).display().to_string();
    let (model, data) = (path("kokkos.npz"), path("seed_frames.extxyz"));
    for (output, version) in [("first.npz", ["--version", "1"].as_slice()), ("newest.npz", &[])] {
        succeed(here, ["calm", "export", "campaign", "--output", output].iter().chain(version));
    }
    let original = path("gmm_artifacts.npz");
    let cases =
        [&original, "first.npz", "newest.npz"].map(|artifact| (model.as_str(), artifact, data.as_str()));
    let [original, versions @ ..] = &both_grades(here, &cases)[..] else { unreachable!() };
    for grades in versions {
        let moved = grades.iter().zip(original).any(|([new, _], [old, _])| (new / old - 1.0).abs() > 1e-2);
        assert!(moved);
    }
}

#[test]
fn artifacts_of_gracemaker_give_its_grades() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let cases = ["al_eam_1l", "ni_al_h_eam_1l", "si_sw_1l"].map(|name| {
        let path = |file: &str| config(&format!("data/{name}/{file}")).display().to_string();
        let frames = read_extxyz(Path::new(&path("seed_frames.extxyz"))).unwrap();
        let some = format!("{name}.extxyz");
        write_frames(&here.join(&some), &frames[..frames.len().min(40)]);
        [path("kokkos.npz"), path("gmm_artifacts.npz"), some]
    });
    both_grades(here, &cases.each_ref().map(|[model, artifact, data]| (&**model, &**artifact, &**data)));
}

/// γ of all atoms of the structures of each case (model, artifact, structures) from this program and from gracemaker, which must agree to
/// 10⁻⁶. gracemaker starts once for all cases: its import takes longer than the grades.
fn both_grades(here: &Path, cases: &[(&str, &str, &str)]) -> Vec<Vec<[f64; 2]>> {
    let variable = "CALMWALK_GRACEMAKER_PYTHON";
    let python = std::env::var_os(variable).unwrap_or_else(|| panic!("{variable} names no Python"));
    let own: Vec<Vec<f64>> = cases.iter().enumerate().map(|(k, case)| own_grades(here, k, *case)).collect();
    let artifacts: Vec<&str> = cases.iter().map(|(_, artifact, _)| *artifact).collect();
    let script = format!(
        "import json, numpy as np, tensorflow as tf\n\
         from tensorpotential.uq.gmmuq import GMMUQModel\n\
         grades = []\n\
         for k, artifact in enumerate({artifacts:?}):\n    \
             model = GMMUQModel(artifact, param_dtype=tf.float64)\n    \
             elements = tf.constant(json.load(open(f'{{k}}.json')), tf.int32)\n    \
             gamma, _ = model.gamma_from_features(tf.constant(np.load(f'{{k}}.npy')), elements)\n    \
             grades.append(gamma.tolist())\n\
         print(json.dumps(grades))"
    );
    let found: Vec<Vec<f64>> = last_line(here, Path::new(&python), &script);
    assert_eq!(found.len(), own.len());
    let both = |(own, found): (Vec<f64>, Vec<f64>)| {
        assert_eq!(found.len(), own.len());
        for (found, own) in found.iter().zip(&own) {
            assert!((found / own - 1.0).abs() < 1e-6, "{found} {own}");
        }
        own.into_iter().zip(found).map(|(own, found)| [own, found]).collect()
    };
    own.into_iter().zip(found).map(both).collect()
}

/// γ of all atoms from this program, which writes their features to `K.npy` and their elements, as numbers of the artifact, to `K.json`.
fn own_grades(here: &Path, k: usize, (model, artifact, data): (&str, &str, &str)) -> Vec<f64> {
    let features = format!("{k}.npy");
    let score = ["calm", "score", "--model", model, "--artifact", artifact, data, "--output", "out.extxyz"];
    succeed(here, score.into_iter().chain(["--features", &features]));
    let frames = read_extxyz(&here.join("out.extxyz")).unwrap();
    let symbols = Artifact::load(here.join(artifact)).unwrap().symbols;
    let species = frames.iter().flat_map(|frame| &frame.structure.species);
    let elements: Vec<usize> = species
        .map(|element| symbols.iter().position(|symbol| symbol == element.symbol()).unwrap())
        .collect();
    std::fs::write(here.join(format!("{k}.json")), serde_json::to_vec(&elements).unwrap()).unwrap();
    frames.iter().flat_map(|frame| frame.arrays["gamma"].reals().unwrap()).collect()
}

/// A model's export without the arrays of features and mixture.
fn without_mixture(model: &Path) -> Vec<u8> {
    let mut out = npz::Writer::new(std::io::Cursor::new(Vec::new()));
    out.copy(std::fs::File::open(model).unwrap(), |key| key.starts_with("uq_")).unwrap();
    out.finish().unwrap().into_inner()
}

fn loads(keys: &str, variable: &str, load: &str) {
    let python = std::env::var_os(variable).unwrap_or_else(|| panic!("{variable} names no Python"));
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml"]);
    succeed(here, ["export", "campaign", "--output", "out.extxyz", "--keys", keys]);
    let frames = read_extxyz(&here.join("out.extxyz")).unwrap();
    let found = loaded(here, Path::new(&python), load);
    assert!(frames.len() > 2 && found.len() == frames.len());
    for ((energy, forces, stress), frame) in found.iter().zip(&frames) {
        let labels = frame.labels().unwrap();
        assert_eq!(Some(*energy), labels.energy);
        assert_eq!(*forces, labels.forces.unwrap().as_flattened());
        let s = labels.stress.unwrap();
        let voigt = [s[0][0], s[1][1], s[2][2], s[1][2], s[0][2], s[0][1]];
        let expected = if stress.len() == 6 { &voigt } else { s.as_flattened() };
        assert!(deviation(stress, expected) < 1e-12, "{stress:?}");
    }
}

/// Runs the Python code `load`, which sets `frames`, and prints them as JSON on the last line.
fn loaded(here: &Path, python: &Path, load: &str) -> Vec<Loaded> {
    let script = format!(
        "import json, numpy as np\n{load}\n\
         print(json.dumps([[float(f['energy']), np.ravel(f['forces']).tolist(), np.ravel(f['stress']).tolist()] for f in frames]))"
    );
    last_line(here, python, &script)
}

/// Runs a script, and parses the last line of its output as JSON.
fn last_line<T: serde::de::DeserializeOwned>(here: &Path, python: &Path, script: &str) -> T {
    let output = Command::new(python).args(["-c", script]).current_dir(here).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let printed = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(printed.lines().last().unwrap()).unwrap()
}
