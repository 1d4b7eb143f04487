//! Labels, models and splits that calmwalk itself cannot train with: each refuses the version, or ends the refit with an error.

use atoms::Species;
use atoms::extxyz::{FrameLabels, LabelKeys};

use super::*;

/// A short training by calmwalk itself.
fn native(changes: Json) -> Json {
    let mut native = json!({ "epochs": 1, "learning_rate": 1e-3, "validation_share": 0.0 });
    native.as_object_mut().unwrap().extend(changes.as_object().unwrap().clone());
    json!({ "native": native })
}

/// Runs a refit that must be refused, and returns the version's record.
fn refused_training(here: &Path, settings: &Json) -> VersionRecord {
    let output = refit(here, settings);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let last = versions(&here.join("campaign")).pop().unwrap();
    assert_eq!((last.state, &*last.method), (VersionState::Refused, "native"));
    last
}

#[test]
fn a_training_without_a_model_refuses_the_version() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let good = read_extxyz(&here.join("replay.extxyz")).unwrap();
    let replay = |name: &str, change: &dyn Fn(&mut Frame)| {
        let mut frames = good[..3].to_vec();
        change(&mut frames[1]);
        write_frames(&here.join(name), &frames);
        let mut wanted = settings(here, "campaign", native(json!({})));
        wanted["settings"]["replay"][0] = hashed(here.join(name));
        refused_training(here, &wanted).reason
    };
    let labels = |frame: &mut Frame, change: &dyn Fn(&mut FrameLabels)| {
        let mut labels = frame.labels().unwrap();
        change(&mut labels);
        frame.set_labels(&labels, LabelKeys::Ase);
    };
    // Frames of 108 atoms have 110 lines.
    let reason = replay("forceless.extxyz", &|frame: &mut Frame| {
        labels(frame, &|labels: &mut FrameLabels| labels.forces = None)
    });
    assert!(reason.contains("forceless.extxyz:111: the structure has no forces"), "{reason}");
    let reason = replay("far.extxyz", &|frame: &mut Frame| {
        labels(frame, &|labels: &mut FrameLabels| labels.energy = Some(-1e7))
    });
    assert!(reason.contains("far.extxyz:111: the energy differs from the model's by "), "{reason}");
    let silicon = Species::from_atomic_number(14).unwrap();
    let reason = replay("silicon.extxyz", &|frame: &mut Frame| frame.structure.species[4] = silicon);
    assert!(reason.contains("silicon.extxyz:111: atom 4 is Si"), "{reason}");

    let by = |changes: Json| settings(here, "campaign", native(changes));
    let last = refused_training(here, &by(json!({ "learning_rate": 1e200 })));
    assert!(last.reason.contains("not finite") && last.labels > 0, "{}", last.reason);
    let mut held_out = by(json!({}));
    held_out["rng_seed"] = all_held_out().into();
    let last = refused_training(here, &held_out);
    assert_eq!((&*last.reason, last.labels), ("there are no labels to train on", 0));
    // The version in force is still that of the configuration, and a training with good data gives another.
    let output = refit(here, &by(json!({})));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let last = versions(&here.join("campaign")).pop().unwrap();
    assert_eq!((last.state, last.parent), (VersionState::Registered, 0), "{}", last.reason);
}

/// A random seed that holds out both seed structures.
fn all_held_out() -> u64 {
    (0..).find(|seed| is_held_out("fcc-100", *seed) && is_held_out("vacancy", *seed)).unwrap()
}

#[test]
fn a_model_that_has_changed_ends_the_refit_and_refuses_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    write_model(&here.join("model.npz"), "output_scale", |scale| scale);
    let mut wanted = settings(here, "campaign", native(json!({})));
    let model = hashed(here.join("model.npz"));
    (wanted["parent_model"], wanted["first_model"]) = (model.clone(), model);
    write_model(&here.join("model.npz"), "output_scale", |scale| 1.01 * scale);
    let output = refit(here, &wanted);
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert!(stderr(&output).contains("model.npz: the file has another content"), "{}", stderr(&output));
    assert_eq!(versions(&here.join("campaign")), []);
}
