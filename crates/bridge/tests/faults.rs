//! Servers that fail.

use std::sync::mpsc;
use std::time::Duration;

use atoms::{Evaluation, NeighbourList, PotentialError};
use bridge::Device;
use potentials::ModelWithFeatures;
use potentials::grace::Threads;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::common::{Fixture, crystal};
use crate::results::biased_step;

/// Each fault at an evaluation and at a pull-back, in between calls that go well.
#[test]
fn faults_change_no_result() {
    let mut fixture = Fixture::new(json!({}));
    let control = fixture.control();
    fixture.settings.options.insert("control".to_owned(), json!(control));
    fixture.settings.timeout = Duration::from_secs(2);
    let device = fixture.device().unwrap();
    let mut potential = Fixture::model(&device).evaluator(Threads::default());
    let undisturbed = biased_step(&mut *potential, 2, 0);
    let faults = ["exit", "nan", "shape", "type", "exception", "memory", "print", "hang"];
    for fault in faults {
        for first in [fault.to_owned(), format!("print\n{fault}")] {
            std::fs::write(&control, first).unwrap();
            assert!(biased_step(&mut *potential, 2, 0) == undisturbed, "{fault}");
            assert!(biased_step(&mut *potential, 2, 0) == undisturbed, "after {fault}");
        }
    }
    let statistics = device.statistics();
    // Twice each: exit, hang, memory for one structure.
    assert_eq!(statistics.restarts, 6, "{statistics:?}");
}

/// A batch that is too large is halved, and results are the same.
#[test]
fn batches_fit_into_the_memory() {
    let fixture = Fixture::new(json!({ "memory_above": 5, "base_seconds": 0.01 }));
    let device = fixture.device().unwrap();
    let model = Fixture::model(&device);
    std::thread::scope(|scope| {
        for k in 0..12 {
            let mut potential = model.clone().evaluator(Threads::default());
            scope.spawn(move || {
                let first = biased_step(&mut *potential, 1, k);
                (0..5).for_each(|_| assert!(biased_step(&mut *potential, 1, k) == first));
            });
        }
    });
    let statistics = device.statistics();
    assert!(statistics.max_bonds.is_some() && statistics.restarts == 0, "{statistics:?}");
}

/// The size that the memory takes is found once: the next start keeps to it, until more is wanted or the file is gone.
#[test]
fn the_size_of_batches_is_kept_for_the_next_start() {
    let mut fixture = Fixture::new(json!({ "memory_above": 5, "padding": true }));
    let (cache, count) = (fixture.directory.path().join("cache"), fixture.directory.path().join("count"));
    fixture.settings.options.insert("count".to_owned(), json!(count));
    fixture.settings.cache = Some(cache.clone());
    // The largest batch of a start, the size that holds afterwards, and what is said of that.
    let start = |fixture: &Fixture| {
        let (sender, said) = mpsc::channel();
        let progress = move |text: &str| drop(sender.send(text.to_owned()));
        let device = Device::start(fixture.settings.clone(), &CancellationToken::new(), progress).unwrap();
        let _ = std::fs::remove_file(&count);
        device.warm_up(&crystal(1, 0), 0.5, 32).unwrap();
        let calls = std::fs::read_to_string(&count).unwrap();
        let structures = |line: &str| line.split(' ').next_back().unwrap().parse::<u32>().unwrap();
        let kept: Vec<_> = said.try_iter().filter(|text| text.contains("took before")).collect();
        (calls.lines().map(structures).max().unwrap(), device.statistics().max_bonds, kept)
    };
    let (largest, found, said) = start(&fixture);
    assert!(largest == 8 && found.is_some() && said.is_empty(), "{largest} {found:?} {said:?}");
    let (largest, kept, said) = start(&fixture);
    assert_eq!((largest, kept, said.len()), (4, found, 1), "{said:?}");
    assert!(said[0].contains(&format!("at most {} bonds", found.unwrap())), "{said:?}");
    fixture.settings.max_batch = 64.try_into().unwrap();
    assert_eq!(start(&fixture).0, 8, "larger batches are wanted");
    assert_eq!(start(&fixture).0, 4);
    std::fs::remove_dir_all(&cache).unwrap();
    assert_eq!(start(&fixture).0, 8, "the file is gone");
    fixture.settings.max_batch = 2.try_into().unwrap();
    assert_eq!(start(&fixture).0, 2, "the configuration remains the limit");
}

/// A server that always fails is given up with the reason.
#[test]
fn three_failures_in_a_row_end_a_device() {
    let mut fixture = Fixture::new(json!({}));
    let control = fixture.control();
    fixture.settings.options.insert("control".to_owned(), json!(control));
    let device = fixture.device().unwrap();
    let structure = crystal(1, 0);
    let mut potential = Fixture::model(&device).evaluator(Threads::default());
    let mut list = NeighbourList::new(potential.cutoff(), 0.5);
    list.update(&structure).unwrap();
    std::thread::scope(|scope| {
        // Each server that starts finds the file anew.
        let broken = device.broken().clone();
        let ordered = control.clone();
        scope.spawn(move || {
            while !broken.is_cancelled() {
                if !ordered.exists() {
                    let draft = ordered.with_extension("draft");
                    std::fs::write(&draft, "exit").unwrap();
                    std::fs::rename(draft, &ordered).unwrap();
                }
                std::thread::sleep(Duration::from_millis(10));
            }
        });
        while !control.exists() {
            std::thread::yield_now();
        }
        let error = potential.evaluate(&structure, &list, &mut Evaluation::default()).unwrap_err();
        let PotentialError::Unavailable(reason) = error else { panic!("{error:?}") };
        assert!(reason.contains("3 times in a row") && reason.contains("adapter simulated"), "{reason}");
    });
    assert!(device.broken().is_cancelled());
}

/// Models that are wrong are refused with the figures, and servers that do not start with what is missing.
#[test]
fn wrong_models_and_environments_are_refused() {
    let wrong = [
        (json!({ "bend": { "forces": 1.02 } }), "the force of a cluster"),
        (json!({ "bend": { "virials": 0.98 } }), "the virial differs"),
        (json!({ "bend": { "gradients": 1.02 } }), "the gradient of the features"),
        (json!({ "bend": { "gradient_virials": 1.02 } }), "the virial of the features"),
        (json!({ "order": 0.001 }), "permuted atoms"),
        (json!({ "fault": "import", "fault_call": "hello" }), "simulated"),
        (json!({ "fault": "nan" }), "among the forces"),
        (json!({ "fault": "shape" }), "expected"),
        (json!({ "fault": "exit", "fault_call": "hello" }), "exit status: 3"),
        (json!({ "unknown": 1 }), "unknown"),
    ];
    for (options, expected) in wrong {
        let error = Fixture::new(options.clone()).device().unwrap_err().to_string();
        assert!(error.contains(expected) && error.contains("simulated"), "{options}: {error}");
    }
    let mut fixture = Fixture::new(json!({}));
    fixture.settings.environment = "/nowhere/bin/python".into();
    let error = fixture.device().unwrap_err().to_string();
    assert!(error.contains("/nowhere") && error.contains("No such file"), "{error}");
}

/// A model whose results depend on its batch, or on chance, is known.
#[test]
fn models_that_are_not_reproducible_are_known() {
    let noisy = Fixture::new(json!({ "noise": 1e-13 })).device().unwrap();
    assert!(!noisy.info().self_test.is_deterministic);
    let crowded = Fixture::new(json!({ "crowd": 1e-13 })).device().unwrap();
    let report = &crowded.info().self_test;
    assert!(report.is_deterministic && !report.is_batch_independent);
}
