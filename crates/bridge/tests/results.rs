//! Results of devices.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList};
use bridge::{DeviceService, PythonModel};
use calm::build::random_projection;
use potentials::grace::{PullBack, Threads};
use potentials::{ModelWithFeatures, PotentialWithFeatures};
use serde_json::json;
use tokio_util::sync::CancellationToken;
use wire::shm_dir::ShmDir;

use crate::common::{Fixture, crystal};

/// Everything that a biased step gives.
pub fn biased_step(
    potential: &mut dyn PotentialWithFeatures,
    repeats: usize,
    seed: usize,
) -> (Evaluation, PullBack, Vec<f64>) {
    let structure = crystal(repeats, seed);
    let mut list = NeighbourList::new(potential.cutoff(), 0.5);
    list.update(&structure).unwrap();
    let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
    let grade = |_: &[u32], features: &[f64], out: &mut [f64]| {
        out.iter_mut().zip(features).for_each(|(out, z)| *out = (3.0 * z).cos());
    };
    potential.evaluate_graded(&structure, &list, &grade, &mut energy, Some(&mut pull_back)).unwrap();
    (energy, pull_back, potential.features().to_vec())
}

/// Everything that a step with one gradient for forces and bias gives.
pub fn combined_step(
    potential: &mut dyn PotentialWithFeatures,
    repeats: usize,
    seed: usize,
) -> (Evaluation, Vec<f64>) {
    let structure = crystal(repeats, seed);
    let mut list = NeighbourList::new(potential.cutoff(), 0.5);
    list.update(&structure).unwrap();
    let mut out = Evaluation::default();
    let grade = |_: &[u32], features: &[f64], out: &mut [f64]| {
        out.iter_mut().zip(features).for_each(|(out, z)| *out = (3.0 * z).cos());
    };
    potential.evaluate_combined(&structure, &list, &grade, &mut out).unwrap();
    (out, potential.features().to_vec())
}

/// One gradient is the sum of the two, by calls without forces; also through shared memory, and of raw invariants behind a projection.
#[test]
fn one_gradient_is_the_sum_of_both() {
    let mut fixture = Fixture::new(json!({}));
    let count = fixture.directory.path().join("count");
    fixture.settings.options.insert("count".to_owned(), json!(count));
    fixture.settings.combined_gradients = true;
    let device = fixture.device().unwrap();
    let figures = &device.info().self_test.figures;
    assert!(figures.iter().any(|(what, ..)| what.contains("together")), "{figures:?}");
    assert!(device.info().self_test.is_deterministic && device.info().self_test.is_batch_independent);
    let mut potential = Fixture::model(&device).evaluator(Threads::default());
    let (energy, pull_back, features) = biased_step(&mut *potential, 2, 3);
    std::fs::remove_file(&count).unwrap();
    let (out, same_features) = combined_step(&mut *potential, 2, 3);
    let calls = std::fs::read_to_string(&count).unwrap();
    let names: Vec<_> = calls.lines().filter_map(|line| line.split(' ').next()).collect();
    assert_eq!(names, ["evaluate_without_forces", "pull_back"]);
    assert_eq!((&out.atomic_energies, &same_features), (&energy.atomic_energies, &features));
    let sum = energy.forces.as_flattened().iter().zip(pull_back.gradient.as_flattened()).map(|(f, g)| f - g);
    let error = out.forces.as_flattened().iter().zip(sum).map(|(found, sum)| (found - sum).abs());
    assert!(error.fold(0.0, f64::max) < 1e-12);
    let sum = energy.virial.as_flattened().iter().zip(pull_back.virial.as_flattened()).map(|(f, g)| f - g);
    let error = out.virial.as_flattened().iter().zip(sum).map(|(found, sum)| (found - sum).abs());
    assert!(error.fold(0.0, f64::max) < 1e-10);
}

/// Steps with one gradient and with two have the same bits beside each other as alone, and no batch has both.
#[test]
fn both_kinds_of_steps_share_a_device() {
    let fixture = Fixture::new(json!({ "base_seconds": 0.005 }));
    let device = fixture.device().unwrap();
    let model = Fixture::model(&device);
    let evaluator = || Arc::clone(&model).evaluator(Threads::default());
    let alone: Vec<_> = (0..12)
        .map(|k| {
            (biased_step(&mut *evaluator(), 1 + k % 2, k), combined_step(&mut *evaluator(), 1 + k % 2, k))
        })
        .collect();
    std::thread::scope(|scope| {
        for (k, (two, one)) in alone.iter().enumerate() {
            let mut potential = evaluator();
            scope.spawn(move || {
                for round in 0..6 {
                    match (k + round) % 3 {
                        0 => assert!(biased_step(&mut *potential, 1 + k % 2, k) == *two),
                        _ => assert!(combined_step(&mut *potential, 1 + k % 2, k) == *one),
                    }
                }
            });
        }
    });
    assert!(device.statistics().largest_batch > 1);
}

#[test]
fn gradients_of_graded_features_are_derivatives() {
    let fixture = Fixture::new(json!({}));
    let device = fixture.device().unwrap();
    assert!(device.info().self_test.is_deterministic && device.info().self_test.is_batch_independent);
    let mut potential = Fixture::model(&device).evaluator(Threads::default());
    let (_, pull_back, _) = biased_step(&mut *potential, 2, 0);
    let structure = crystal(2, 0);
    let mut sum = |step: f64| {
        let mut moved = structure.clone();
        moved.positions[3][1] += step;
        let mut list = NeighbourList::new(potential.cutoff(), 0.5);
        list.update(&moved).unwrap();
        potential.forward(&moved, &list).unwrap();
        potential.features().iter().map(|z| (3.0 * z).sin() / 3.0).sum::<f64>()
    };
    let expected = (sum(1e-4) - sum(-1e-4)) / 2e-4;
    assert!((pull_back.gradient[3][1] - expected).abs() < 1e-7, "{} {expected}", pull_back.gradient[3][1]);
}

/// Walkers of any number get what each gets alone.
#[test]
fn batches_change_nothing() {
    let fixture = Fixture::new(json!({ "base_seconds": 0.005 }));
    let device = fixture.device().unwrap();
    let model = Fixture::model(&device);
    let alone: Vec<_> = (0..12)
        .map(|k| biased_step(&mut *Arc::clone(&model).evaluator(Threads::default()), 1 + k % 2, k))
        .collect();
    std::thread::scope(|scope| {
        for (k, alone) in alone.iter().enumerate() {
            let mut potential = Arc::clone(&model).evaluator(Threads::default());
            scope.spawn(move || {
                for _ in 0..5 {
                    assert!(biased_step(&mut *potential, 1 + k % 2, k) == *alone);
                }
            });
        }
    });
    assert!(device.statistics().largest_batch > 1);
}

/// A launcher's words, such as a container's image, are relative to the working directory; the program behind it is left as it is.
#[test]
fn a_launcher_starts_the_program() {
    let mut fixture = Fixture::new(json!({}));
    let environment = fixture.settings.environment.clone();
    let directory = environment.parent().unwrap().display();
    let path = format!("PATH={directory}:{}", std::env::var("PATH").unwrap());
    fixture.settings.launcher = ["sh", "tests/launcher.sh", "env", &path].map(str::to_owned).to_vec();
    fixture.settings.environment = environment.file_name().unwrap().into();
    fixture.device().unwrap();
}

/// Padding and compiled programs.
#[test]
fn padding_changes_nothing() {
    let plain = Fixture::new(json!({})).device().unwrap();
    let padded = Fixture::new(json!({ "padding": true })).device().unwrap();
    let step = |device| biased_step(&mut *Fixture::model(device).evaluator(Threads::default()), 2, 1);
    assert!(step(&plain) == step(&padded));
}

/// Through shared memory the bits are those of the same process.
#[test]
fn shared_memory_changes_nothing() {
    let fixture = Fixture::new(json!({}));
    let device = fixture.device().unwrap();
    let place = ShmDir::for_campaign(fixture.directory.path()).unwrap();
    let prepared = place.prepare(1 << 24).unwrap();
    // Messages grow beyond what was expected.
    let service = DeviceService::open(&device, &place, 7, 4, 64).unwrap();
    let address = service.address().clone();
    let model =
        PythonModel::shared(device.info().description().clone(), address, CancellationToken::new()).unwrap();
    let model = Arc::new(model.projected(random_projection(1, 8, 5, 2)).unwrap());
    std::thread::scope(|scope| {
        for k in 0..4 {
            let (local, shared) = (Fixture::model(&device), Arc::clone(&model));
            scope.spawn(move || {
                let mut local = local.evaluator(Threads::default());
                let mut shared = shared.evaluator(Threads::default());
                for round in 0..4 {
                    let seed = k + round / 2;
                    assert!(biased_step(&mut *local, 2, seed) == biased_step(&mut *shared, 2, seed));
                    assert!(combined_step(&mut *local, 2, seed) == combined_step(&mut *shared, 2, seed));
                }
            });
        }
    });
    drop((service, prepared));
    place.remove().unwrap();
}
