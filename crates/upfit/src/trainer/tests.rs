//! Trainings of the demonstration's model on a few frames of its training data.

use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicUsize};

use super::*;
use crate::learning_rate::CosineDecay;
use crate::loss::LossSettings;
use crate::optimiser::Optimiser;
use crate::progress::ErrorsBySet;
use crate::split::split;
use crate::test_frames::{aluminium, model, settings, stronger};

fn data() -> TrainingData {
    split(stronger(5), 0.2, 1).unwrap()
}

fn train(data: &TrainingData, settings: &UpfitSettings) -> UpfitOutcome {
    run(model(), data, settings, None, &|| false, |_| {}).unwrap().unwrap()
}

fn failure(data: &TrainingData, settings: &UpfitSettings) -> UpfitError {
    match run(model(), data, settings, None, &|| false, |_| {}) {
        Err(error) => error,
        Ok(_) => panic!("the training did not fail"),
    }
}

#[test]
fn the_loss_falls_and_threads_change_no_bit() {
    let data = data();
    let one = train(&data, &settings());
    let two = train(&data, &UpfitSettings { threads: 2, ..settings() });
    assert_eq!(one.model.weights(), two.model.weights());
    assert_eq!((one.updates, one.history.len(), one.ended_early), (4, 2, false));
    assert!(one.after.training.loss < one.before.training.loss, "{:?} {:?}", one.before, one.after);
    let (before, after) = (one.before.validation.unwrap(), one.after.validation.unwrap());
    assert!(after.loss < before.loss && before.structures == 1, "{before:?} {after:?}");
    // The labels' energies are a tenth larger: −0.34 eV/atom.
    let [shift] = &one.zero.shifts[..] else { panic!("{:?}", one.zero) };
    assert!(shift.element == "Al" && (shift.shift + 0.34).abs() < 0.02, "{shift:?}");
    assert!(before.energy_mae < 0.05, "{before:?}");
    assert_ne!(one.model.weights(), train(&data, &UpfitSettings { seed: 7, ..settings() }).model.weights());
}

#[test]
fn a_training_that_is_stopped_anywhere_goes_on_to_the_same_bits() {
    for optimiser in [Optimiser::Adam, Optimiser::Soap] {
        stopped_anywhere(UpfitSettings { average: Some(0.5), optimiser, ..settings() });
    }
}

fn stopped_anywhere(settings: UpfitSettings) {
    let data = data();
    let whole = train(&data, &settings);
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.upfit");
    let mut stops = 0;
    let outcome = loop {
        // Each process makes one update.
        let updated = AtomicBool::new(false);
        let on_event = |event: TrainingEvent<'_>| {
            updated.fetch_or(matches!(event, TrainingEvent::Update(_)), Relaxed);
        };
        match run(model(), &data, &settings, Some(&path), &|| updated.load(Relaxed), on_event).unwrap() {
            None => stops += 1,
            Some(outcome) => break outcome,
        }
    };
    assert_eq!((stops, outcome.updates), (4, 4));
    assert_eq!(outcome.model.weights(), whole.model.weights());
    let errors = |outcome: &UpfitOutcome| -> Vec<ErrorsBySet> {
        outcome.history.iter().map(|record| record.errors.clone()).collect()
    };
    assert_eq!(errors(&outcome), errors(&whole));

    for (data, settings, difference) in [
        (data.clone(), UpfitSettings { seed: 7, ..settings.clone() }, "its random seed is 42, now it is 7"),
        (split(aluminium(5), 0.2, 1).unwrap(), settings.clone(), "its training set"),
        (data.clone(), other_optimiser(&settings), "its optimiser"),
    ] {
        match run(model(), &data, &settings, Some(&path), &|| false, |_| {}) {
            Err(error @ UpfitError::OtherTraining { .. }) => {
                assert!(error.to_string().contains(difference), "{error}");
            }
            _ => panic!("a checkpoint of another training was accepted"),
        }
    }
}

fn other_optimiser(settings: &UpfitSettings) -> UpfitSettings {
    let optimiser = if settings.optimiser == Optimiser::Adam { Optimiser::Soap } else { Optimiser::Adam };
    UpfitSettings { optimiser, ..settings.clone() }
}

#[test]
fn soap_lowers_the_loss_and_keeps_frozen_weights() {
    let frozen = vec!["energy_mlp".to_owned()];
    // The warm-up leaves rates of 0.003 to 0.011 to eight updates.
    let learning_rate = CosineDecay { first: 0.3, last: 3e-3 };
    let trained = train(
        &data(),
        &UpfitSettings { epochs: 4, optimiser: Optimiser::Soap, learning_rate, frozen, ..settings() },
    );
    assert!(trained.after.training.loss < 0.5 * trained.before.training.loss, "{:?}", trained.after);
    let begin = model();
    for group in begin.groups() {
        let is_frozen = group.name.starts_with("energy_mlp");
        let [now, before] = [&trained.model, &begin].map(|model| &model.weights()[group.range.clone()]);
        assert_eq!(now == before, is_frozen, "{}", group.name);
    }
}

#[test]
fn a_training_can_stop_before_each_structure_that_it_evaluates() {
    let (data, settings) = (data(), UpfitSettings { average: Some(0.5), ..settings() });
    let whole = train(&data, &settings);
    // Answers that say no: 5 for neighbour lists, twice 5 for structures before and after the zero is moved, one for the first epoch
    // and two for its updates. Then come the validation, and in the end both sets.
    for (asked, has_begun) in [(2, false), (7, false), (14, false), (16, true), (18, true), (27, true)] {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run.upfit");
        let (answers, mut begun) = (AtomicUsize::new(0), false);
        let stop = || answers.fetch_add(1, Relaxed) >= asked;
        let stopped = run(model(), &data, &settings, Some(&path), &stop, |_| begun = true);
        assert!(matches!(stopped, Ok(None)), "{asked}");
        assert_eq!((begun, path.exists()), (has_begun, has_begun), "{asked}");
        let resumed = run(model(), &data, &settings, Some(&path), &|| false, |_| {}).unwrap().unwrap();
        assert_eq!(resumed.model.weights(), whole.model.weights(), "{asked}");
        assert_eq!((resumed.epoch, &resumed.after), (whole.epoch, &whole.after), "{asked}");
    }
}

#[test]
fn progress_has_the_errors_of_the_epoch_and_the_expected_end() {
    let data = data();
    let (mut updates, mut epochs) = (Vec::new(), Vec::new());
    let outcome = run(model(), &data, &settings(), None, &|| false, |event| match event {
        TrainingEvent::Update(progress) => updates.push(progress),
        TrainingEvent::Epoch { record, seconds_left } => epochs.push((record.errors.training, seconds_left)),
        TrainingEvent::Begun { .. } => {}
    });
    assert!(matches!(outcome, Ok(Some(_))));
    let structures: Vec<_> = updates.iter().map(|progress| progress.errors.structures).collect();
    assert_eq!(structures, [2, 4, 2, 4]);
    // After the last batch, they are those of the epoch.
    assert_eq!((updates[1].errors, updates[3].errors), (epochs[0].0, epochs[1].0));
    assert!(updates[0].seconds_left.unwrap() > 0.0 && updates[0].errors.stress_mae.unwrap() > 0.0);
    assert_eq!((updates[3].seconds_left, epochs[1].1), (Some(0.0), Some(0.0)));
}

#[test]
fn frozen_weights_stay_and_the_others_move() {
    let start = model();
    let name = start.groups()[0].name.clone();
    let frozen = UpfitSettings { frozen: vec![name.clone()], epochs: 1, ..settings() };
    let data = TrainingData { training: aluminium(2), validation: Vec::new() };
    let trained = train(&data, &frozen).model;
    for group in start.groups() {
        let same = start.weights()[group.range.clone()] == trained.weights()[group.range.clone()];
        assert!(same || !group.name.starts_with(&name), "{}", group.name);
    }
    assert_ne!(start.weights(), trained.weights());
}

#[test]
fn patience_ends_a_training_that_gets_no_better() {
    // Steps so large that no epoch is as good as the start.
    let rough = UpfitSettings {
        epochs: 9,
        learning_rate: CosineDecay { first: 0.05, last: 0.05 },
        patience: Some(1),
        ..settings()
    };
    let outcome = train(&split(aluminium(4), 0.25, 1).unwrap(), &rough);
    assert!(outcome.ended_early && outcome.history.len() < 9, "{:?}", outcome.history);
    assert_eq!((outcome.epoch, outcome.model.weights()), (0, model().weights()));
}

/// SOAP's default rate is for hundreds of updates; its warm-up keeps the first ones small.
#[test]
fn soap_improves_a_model_in_four_updates() {
    let soap = Optimiser::Soap;
    let decay = CosineDecay { first: soap.default_learning_rate(), last: 0.0 };
    let soap =
        UpfitSettings { optimiser: soap, learning_rate: decay, loss: LossSettings::demo(), ..settings() };
    let outcome = train(&split(stronger(8), 0.5, 1).unwrap(), &soap);
    assert_eq!((outcome.history.len(), outcome.epoch), (2, 2), "{:?}", outcome.history);
}

/// A process that is killed before the model is in its file loses nothing.
#[test]
fn a_training_that_has_ended_makes_no_update_again() {
    let (data, settings) = (data(), settings());
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.upfit");
    let mut weights = Vec::new();
    for expected in [4, 0] {
        let mut updates = 0;
        let outcome = run(model(), &data, &settings, Some(&path), &|| false, |event| {
            updates += u32::from(matches!(event, TrainingEvent::Update(_)));
        });
        let outcome = outcome.unwrap().unwrap();
        assert_eq!((updates, outcome.history.len()), (expected, 2));
        weights.push(outcome.model.weights().to_vec());
    }
    assert_eq!(weights[0], weights[1]);
}

#[test]
fn the_best_weights_are_those_of_the_last_stage() {
    let paper = UpfitSettings { epochs: 2, loss: LossSettings::paper(), ..settings() };
    let outcome = train(&data(), &paper);
    let stages: Vec<_> = outcome.history.iter().map(|record| record.stage).collect();
    assert_eq!((stages, outcome.epoch), (vec![0, 1], 2));
}

#[test]
fn broken_labels_are_named() {
    let mut data = TrainingData { training: aluminium(6), validation: Vec::new() };
    data.training[3].energy = -1e6;
    let message = failure(&data, &settings()).to_string();
    assert!(message.contains(&data.training[3].place) && message.contains("eV/atom"), "{message}");

    let empty = TrainingData::default();
    assert!(matches!(failure(&empty, &settings()), UpfitError::NoFrames));
}

#[test]
fn a_structure_whose_energy_has_another_zero_is_named() {
    let mut data = TrainingData { training: aluminium(5), validation: Vec::new() };
    data.training[3].energy += 5.0 * 108.0;
    let mut named = Vec::new();
    let one = UpfitSettings { epochs: 1, ..settings() };
    let outcome = run(model(), &data, &one, None, &|| false, |event| {
        if let TrainingEvent::Begun { spread, zero, .. } = event {
            assert!(zero.shifts.is_empty(), "{zero:?}");
            named = spread.far.iter().map(|far| (far.place.clone(), far.difference.round())).collect();
        }
    });
    assert!(matches!(outcome, Ok(Some(_))));
    assert_eq!(named, [(data.training[3].place.clone(), 5.0)]);
}

#[test]
fn a_loss_that_is_not_finite_keeps_the_last_checkpoint() {
    let data = TrainingData { training: aluminium(2), validation: Vec::new() };
    let wild = UpfitSettings { learning_rate: CosineDecay { first: 1e200, last: 0.0 }, ..settings() };
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.upfit");
    let error = match run(model(), &data, &wild, Some(&path), &|| false, |_| {}) {
        Err(error) => error,
        Ok(_) => panic!("the training did not fail"),
    };
    let message = error.to_string();
    assert!(message.contains("is not finite") && message.contains("epoch 2, batch 1 of 1"), "{message}");
    assert!(message.contains("seed_frames.extxyz:") && !error.is_wrong_input(), "{message}");
    let settings = UpfitSettings { threads: 2, ..wild };
    let mut resumed = None;
    let begun = AtomicBool::new(false);
    let stopped = run(model(), &data, &settings, Some(&path), &|| begun.load(Relaxed), |event| {
        if let TrainingEvent::Begun { resumed: epochs, .. } = event {
            resumed = epochs;
        }
        begun.store(true, Relaxed);
    });
    assert!(matches!(stopped, Ok(None)) && resumed.is_some_and(|epochs| epochs <= 1), "{resumed:?}");
}

#[test]
fn a_model_that_is_not_finite_after_the_last_update_is_refused() {
    // The only update is the last one, and nothing is validated.
    let data = TrainingData { training: aluminium(2), validation: Vec::new() };
    let decay = CosineDecay { first: 1e200, last: 0.0 };
    let wild = UpfitSettings { epochs: 1, learning_rate: decay, ..settings() };
    let message = failure(&data, &wild).to_string();
    assert!(message.contains("epoch 1, the last update: the loss is not finite"), "{message}");
}

#[test]
fn any_number_of_epochs_can_be_asked_for() {
    let data = TrainingData { training: aluminium(3), validation: Vec::new() };
    let endless = UpfitSettings { epochs: u64::MAX, ..settings() };
    let mut all = None;
    let updated = AtomicBool::new(false);
    let stopped = run(model(), &data, &endless, None, &|| updated.load(Relaxed), |event| {
        if let TrainingEvent::Update(progress) = event {
            all = Some(progress.all_updates);
            updated.store(true, Relaxed);
        }
    });
    assert!(matches!(stopped, Ok(None)));
    assert_eq!(all, Some(u64::MAX));
}
