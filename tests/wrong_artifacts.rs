//! Inconsistent artifacts that can be loaded: refused, because a campaign would collect nothing or everything.

use crate::common;
use crate::common::config_tester::{ConfigTester, changed, line, without_refit};
use crate::common::npz::with_changed_arrays as with_arrays;
use crate::common::{calmwalk, config, refuse, stderr, succeed};

const ARTIFACT: &str = "data/al_eam_1l/gmm_artifacts.npz";

/// The path of a data file as the demo writes it.
fn path(file: &str) -> String {
    config(file).display().to_string()
}

/// An array of the aluminium artifact multiplied by a factor.
fn scaled(array: &str, factor: f64) -> Vec<u8> {
    with_arrays(&config(ARTIFACT), |name, numbers| {
        if name == array {
            numbers.iter_mut().for_each(|value| *value *= factor);
        }
    })
}

/// An array of the aluminium artifact taken from that of silicon.
fn of_silicon(array: &str) -> Vec<u8> {
    let taken = std::cell::RefCell::new(Vec::new());
    with_arrays(&config("data/si_sw_1l/gmm_artifacts.npz"), |name, numbers| {
        if name == array {
            taken.replace(numbers.clone());
        }
    });
    with_arrays(&config(ARTIFACT), |name, numbers| {
        if name == array {
            numbers.clone_from(&taken.borrow());
        }
    })
}

#[test]
fn artifacts_that_are_nonsense_are_refused() {
    let tester = ConfigTester::new();
    let at = format!("c.toml:{}: calm.artifact: bad.npz: component 0 of Al: ", line(&path(ARTIFACT)));
    let inverse = "its inverse covariance";
    for (array, factor, words) in [
        ("inv_cov_0", 0.0, "expected a positive definite matrix"),
        ("inv_cov_0", -1.0, "expected a positive definite matrix"),
        ("inv_cov_0", 1e6, "on the diagonal; expected at most 1e6"),
        ("inv_cov_0", 1e-6, "does not match its scatter and count"),
        ("eff_interp_thresholds", 0.0, "its threshold is 0.000e0; expected 1.0e-2 to"),
        ("eff_interp_thresholds", 1e6, "its threshold is 1.412e7; expected"),
        ("centroids_0", 0.0, "its centroid is zero"),
        ("centroids_0", 1e3, "its centroid is"),
        ("scatter_0", 0.0, "does not match its scatter and count"),
        ("scatter_0", -1.0, "its scatter has a negative eigenvalue"),
        ("scatter_0", 1e3, "does not match its scatter and count"),
        ("effective_count_0", 0.0, "5400 environments with a total weight of 0"),
        ("effective_count_0", 1e-3, "does not match its scatter and count"),
    ] {
        tester.write("bad.npz", scaled(array, factor));
        tester.refused_with(&path(ARTIFACT), "bad.npz", &[&at, words]);
    }
    for array in ["scatter_0", "inv_cov_0"] {
        tester.write("bad.npz", of_silicon(array));
        tester.refused_with(&path(ARTIFACT), "bad.npz", &[&at, inverse, "does not match"]);
    }
    tester.write(
        "bad.npz",
        with_arrays(&config(ARTIFACT), |name, numbers| {
            if name == "inv_cov_0" {
                numbers[1] += 1e5;
            }
        }),
    );
    tester.refused_with(&path(ARTIFACT), "bad.npz", &["array 'inv_cov_0'", "expected symmetric matrices"]);
}

/// Consistent components that belong to other data, which only the training frames reveal.
#[test]
fn the_grades_of_the_training_frames_reveal_it() {
    let tester = ConfigTester::new();
    let frames = path("data/al_eam_1l/seed_frames.extxyz");
    let at = format!("c.toml:{}: calm.training_frames: {frames}: ", line(&frames));
    // A wrong centroid with the correct covariance.
    tester.write("bad.npz", scaled("centroids_0", 0.5));
    tester.refused_with(&path(ARTIFACT), "bad.npz", &[&at, "the median of γ is ", "expected 0.001 to 1"]);
}

#[test]
fn many_training_atoms_outside_are_warned_of() {
    let tester = ConfigTester::new();
    tester.write("half.npz", scaled("eff_interp_thresholds", 0.5));
    tester.write("c.toml", changed(&path(ARTIFACT), "half.npz"));
    let output = calmwalk(tester.path(), ["validate", "c.toml"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let at = format!("WARNING: c.toml:{}: calm.training_frames: ", line("training_frames = "));
    let words = "39 % of the atoms have γ > 1 under the initial mixture, where 2 to 9 % are usual";
    let warning = stderr(&output);
    assert!(warning.starts_with(&at) && warning.contains(words), "{warning}");
}

#[test]
fn without_training_frames_the_seed_structures_reveal_it() {
    let tester = ConfigTester::new();
    // γ × 10⁻³. The export has no scatter to compare with.
    let model = with_arrays(&config("data/al_eam_1l/kokkos.npz"), |name, numbers| {
        if name == "uq_inv_cov" {
            numbers.iter_mut().for_each(|value| *value *= 1e-6);
        }
    });
    tester.write("model.npz", model);
    let text = changed("artifact = ", "update = \"never\" # ").replace("training_frames = ", "# ");
    let text = text.replace(&path("data/al_eam_1l/kokkos.npz"), "model.npz");
    tester.write("c.toml", without_refit(&text));
    let output = calmwalk(tester.path(), ["validate", "c.toml"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let at = format!("WARNING: c.toml:{}: potential.model: ", line("model = "));
    let warning = stderr(&output);
    assert!(warning.contains(&at) && warning.contains("nothing is ever collected"), "{warning}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("  warnings         1, see above\n"));
}

#[test]
fn score_refuses_nonsense_and_info_shows_it() {
    let tester = ConfigTester::new();
    tester.write("bad.npz", scaled("inv_cov_0", 1e-6));
    let (model, frames) = (path("data/al_eam_1l/kokkos.npz"), path("data/al_eam_1l/seed_frames.extxyz"));
    let arguments = ["--model", &model, "--artifact", "bad.npz", &frames, "--output", "out.extxyz"];
    let message = refuse(tester.path(), ["calm", "score"].into_iter().chain(arguments));
    assert!(
        message.contains("bad.npz: component 0 of Al: its inverse covariance does not match"),
        "{message}"
    );
    let shown = succeed(tester.path(), ["calm", "info", "bad.npz"]);
    assert!(shown.contains("UNUSABLE        component 0 of Al: its inverse covariance"), "{shown}");
    let shown = succeed(tester.path(), ["calm", "info", "bad.npz", "--json"]);
    let shown: serde_json::Value = serde_json::from_str(&shown).unwrap();
    assert_eq!(shown["faults"].as_array().unwrap().len(), 1, "{shown}");
}

#[test]
fn the_demos_are_sound() {
    let tester = ConfigTester::new();
    for name in ["aluminium.toml", "silicon.toml", "nickel-aluminium-hydrogen.toml"] {
        tester.write("c.toml", common::demo(name));
        let output = calmwalk(tester.path(), ["validate", "c.toml"]);
        assert_eq!((output.status.code(), stderr(&output).as_str()), (Some(0), ""), "{name}");
        let shown = String::from_utf8(output.stdout).unwrap();
        assert!(shown.contains("  warnings         none\n"), "{shown}");
    }
}
