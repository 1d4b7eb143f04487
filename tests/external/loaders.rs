//! What `calmwalk export` writes for gracemaker and MACE, and the artifacts of `calm build` and `calm export`, read back by their own
//! loaders. Needs two Pythons, named by `CALMWALK_GRACEMAKER_PYTHON` (of PyPI: tensorpotential) and `CALMWALK_MACE_PYTHON` (mace-torch); `.ci/loaders` makes both.

use std::path::Path;
use std::process::Command;

use atoms::read_extxyz;

use crate::common::campaign::Small;
use crate::common::{config, deviation, stderr, succeed};

/// Energy (eV), forces (eV/Å) and stress (eV/Å³) of a frame, as a loader has them.
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
    let variable = "CALMWALK_GRACEMAKER_PYTHON";
    let python = std::env::var_os(variable).unwrap_or_else(|| panic!("{variable} names no Python"));
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = |file: &str| config(&format!("data/al_eam_1l/{file}")).display().to_string();
    let (model, data) = (path("kokkos.npz"), path("seed_frames.extxyz"));
    succeed(here, ["calm", "build", "--model", &model, &data, "--output", "calm.npz", "--shard-size", "9"]);
    let gamma = grades(here, &model, "calm.npz", &data);
    assert!(gamma.len() == 5400 && gamma.iter().any(|gamma| *gamma > 1.0));
    assert!(deviation(&gracemaker_grades(here, Path::new(&python), "calm.npz"), &gamma) < 1e-6);
}

#[test]
fn gracemaker_grades_by_the_mixture_of_a_campaign() {
    let variable = "CALMWALK_GRACEMAKER_PYTHON";
    let python = std::env::var_os(variable).unwrap_or_else(|| panic!("{variable} names no Python"));
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml"]);
    let path = |file: &str| config(&format!("data/al_eam_1l/{file}")).display().to_string();
    let (model, data) = (path("kokkos.npz"), path("seed_frames.extxyz"));
    let original = grades(here, &model, &path("gmm_artifacts.npz"), &data);
    for version in [["--version", "1"].as_slice(), &[]] {
        succeed(here, ["calm", "export", "campaign", "--output", "calm.npz"].iter().chain(version));
        let gamma = grades(here, &model, "calm.npz", &data);
        assert!(deviation(&gamma, &original) > 1e-2);
        assert!(deviation(&gracemaker_grades(here, Path::new(&python), "calm.npz"), &gamma) < 1e-6);
    }
}

/// γ of all atoms; their features go to `z.npy`.
fn grades(here: &Path, model: &str, artifact: &str, data: &str) -> Vec<f64> {
    let score = ["calm", "score", "--model", model, "--artifact", artifact, data, "--output", "out.extxyz"];
    succeed(here, score.into_iter().chain(["--features", "z.npy"]));
    let frames = read_extxyz(&here.join("out.extxyz")).unwrap();
    frames.iter().flat_map(|frame| frame.arrays["gamma"].reals().unwrap()).collect()
}

/// γ of the features in `z.npy`.
fn gracemaker_grades(here: &Path, python: &Path, artifact: &str) -> Vec<f64> {
    let script = format!(
        "import json, numpy as np, tensorflow as tf\n\
         from tensorpotential.uq.gmmuq import GMMUQModel\n\
         z = np.load('z.npy')\n\
         model = GMMUQModel('{artifact}', param_dtype=tf.float64)\n\
         gamma, _ = model.gamma_from_features(tf.constant(z), tf.zeros(len(z), tf.int32))\n\
         print(json.dumps(gamma.tolist()))"
    );
    last_line(here, python, &script)
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

/// Has `load` make `frames` of the file, and prints them as JSON on the last line.
fn loaded(here: &Path, python: &Path, load: &str) -> Vec<Loaded> {
    let script = format!(
        "import json, numpy as np\n{load}\n\
         print(json.dumps([[float(f['energy']), np.ravel(f['forces']).tolist(), np.ravel(f['stress']).tolist()] for f in frames]))"
    );
    last_line(here, python, &script)
}

/// Runs a script, and reads the JSON on the last line that it prints.
fn last_line<T: serde::de::DeserializeOwned>(here: &Path, python: &Path, script: &str) -> T {
    let output = Command::new(python).args(["-c", script]).current_dir(here).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let printed = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(printed.lines().last().unwrap()).unwrap()
}
