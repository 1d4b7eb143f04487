//! Servers that fail.

use std::num::NonZeroU32;
use std::sync::{Arc, mpsc};
use std::time::Duration;

use atoms::{Evaluation, NeighbourList, PotentialError};
use bridge::Device;
use potentials::ModelWithFeatures;
use potentials::grace::Threads;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::common::{Fixture, crystal};
use crate::results::{biased_step, combined_step};

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
    let combined = combined_step(&mut *potential, 2, 0);
    for first in ["exit", "nan", "print\nexit", "print\nnan"] {
        std::fs::write(&control, first).unwrap();
        assert!(combined_step(&mut *potential, 2, 0) == combined, "{first}");
    }
    assert_eq!(device.statistics().restarts, 8);
}

/// A batch that is sent ahead has its whole time from the answer of the one before it.
#[test]
fn the_time_of_a_call_does_not_include_the_one_before_it() {
    let mut fixture = Fixture::new(json!({}));
    let control = fixture.control();
    fixture.settings.options.insert("control".to_owned(), json!(control));
    (fixture.settings.timeout, fixture.settings.max_batch) = (Duration::from_secs(2), NonZeroU32::MIN);
    let device = fixture.device().unwrap();
    let model = Fixture::model(&device);
    let step = |k| drop(biased_step(&mut *model.clone().evaluator(Threads::default()), 1, k));
    (0..2).for_each(step);
    // Two such calls take longer than the time of one.
    std::fs::write(&control, "base_seconds 1.2").unwrap();
    std::thread::scope(|scope| {
        (0..2).for_each(|k| drop(scope.spawn(move || step(k))));
    });
    let statistics = device.statistics();
    assert!(statistics.restarts == 0 && statistics.computed > 4.8, "{statistics:?}");
}

/// A framework that does not compile for shapes has no more time for a new number of bonds.
#[test]
fn another_number_of_bonds_is_no_new_program() {
    let mut fixture = Fixture::new(json!({}));
    let control = fixture.control();
    fixture.settings.options.insert("control".to_owned(), json!(control));
    fixture.settings.timeout = Duration::from_secs(1);
    let device = fixture.device().unwrap();
    let mut potential = Fixture::model(&device).evaluator(Threads::default());
    let structure = crystal(2, 0);
    let mut bonds = |skin| {
        let mut list = NeighbourList::new(5.5, skin);
        list.update(&structure).unwrap();
        let before = device.statistics().bonds;
        potential.forward(&structure, &list).unwrap();
        device.statistics().bonds - before
    };
    let first = bonds(1.5);
    std::fs::write(&control, "hang").unwrap();
    assert_ne!(bonds(0.0), first);
    let failure = device.statistics().last_failure.unwrap();
    assert!(failure.contains("no answer for 1 s"), "{failure}");
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
        let device =
            Device::start(fixture.settings.clone(), true, &CancellationToken::new(), progress).unwrap();
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

/// A structure at which the server dies ends its own walk, not those that are evaluated beside it.
#[test]
fn a_structure_that_kills_the_server_is_refused() {
    let fixture = Fixture::new(json!({ "exit_at_atoms": 32, "base_seconds": 0.02 }));
    let device = fixture.device().unwrap();
    let model = Fixture::model(&device);
    let refused = |repeats| {
        let mut potential = model.clone().evaluator(Threads::default());
        let structure = crystal(repeats, 0);
        let mut list = NeighbourList::new(potential.cutoff(), 0.5);
        list.update(&structure).unwrap();
        potential.evaluate(&structure, &list, &mut Evaluation::default()).unwrap_err()
    };
    std::thread::scope(|scope| {
        let walks: Vec<_> = (0..3)
            .map(|k| {
                let mut potential = model.clone().evaluator(Threads::default());
                scope.spawn(move || (0..20).for_each(|_| drop(biased_step(&mut *potential, 1, k))))
            })
            .collect();
        let error = refused(2);
        let PotentialError::Failed(reason) = error else { panic!("{error:?}") };
        assert!(
            reason.contains("3 times at this structure") && reason.contains("exit status: 3"),
            "{reason}"
        );
        walks.into_iter().for_each(|walk| walk.join().unwrap());
    });
    assert!(!device.broken().is_cancelled());
    assert_eq!(device.statistics().restarts, 3);
    // If it dies at every structure, it is broken.
    assert!(matches!(refused(2), PotentialError::Failed(_)));
    assert!(matches!(refused(2), PotentialError::Failed(_)));
    assert!(matches!(refused(2), PotentialError::Failed(_)));
    assert!(matches!(refused(1), PotentialError::Unavailable(_)));
    assert!(device.broken().is_cancelled());
}

/// An adapter whose program exits when it is told to, and whose energies depend on a file.
const DRIFT: &str = "
import os
from pathlib import Path

from calmwalk.adapters.radial import Radial

HERE = Path(__file__).parent


class Drift(Radial):
    def __init__(self, **settings):
        super().__init__(**settings)
        self.drift = float((HERE / 'drift').read_text())

    def evaluate(self, batch, features):
        if (HERE / 'exit').exists():
            (HERE / 'exit').unlink()
            os._exit(3)
        result = super().evaluate(batch, features)
        result.energies = result.energies + self.drift
        return result
";

/// A server that is started again must have the same results; where it matters, the same bits.
#[test]
fn a_server_that_has_changed_meanwhile_is_refused() {
    for (drift, same_bits, expected) in [
        ("1e-13", true, Some("other bits")),
        ("1e-13", false, None),
        ("0.01", false, Some("energy of the test structure")),
    ] {
        let mut fixture = Fixture::new(json!({}));
        let file = |name: &str| fixture.directory.path().join(name);
        std::fs::write(file("drift.py"), DRIFT).unwrap();
        std::fs::write(file("drift"), "0.0").unwrap();
        fixture.settings.adapter = format!("{}:Drift", file("drift.py").display());
        let device = Device::start(fixture.settings.clone(), same_bits, &CancellationToken::new(), |_| {})
            .map(Arc::new);
        let device = device.unwrap();
        let mut potential = Fixture::model(&device).evaluator(Threads::default());
        let structure = crystal(1, 0);
        let mut list = NeighbourList::new(potential.cutoff(), 0.5);
        list.update(&structure).unwrap();
        std::fs::write(file("drift"), drift).unwrap();
        std::fs::write(file("exit"), "").unwrap();
        let result = potential.evaluate(&structure, &list, &mut Evaluation::default());
        let reason = result.err().map(|error| error.to_string()).unwrap_or_default();
        assert!(reason.contains(expected.unwrap_or_default()), "{drift}: {reason}");
        assert_eq!(
            (reason.is_empty(), device.broken().is_cancelled()),
            (expected.is_none(), expected.is_some())
        );
    }
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
    let mut fixture = Fixture::new(json!({ "bend": { "features": 1.0000001 } }));
    fixture.device().unwrap();
    fixture.settings.combined_gradients = true;
    let error = fixture.device().unwrap_err().to_string();
    assert!(error.contains("the features without forces"), "{error}");
    fixture.settings.adapter = "calmwalk.adapters.radial:Radial".to_owned();
    fixture.settings.options.clear();
    fixture.device().unwrap();
    let own = fixture.directory.path().join("always.py");
    let text = "from calmwalk.adapters.radial import Radial\nclass Always(Radial):\n    evaluate_without_forces = None\n";
    std::fs::write(&own, text).unwrap();
    fixture.settings.adapter = format!("{}:Always", own.display());
    let error = fixture.device().unwrap_err().to_string();
    assert!(error.contains("cannot evaluate without forces") && error.contains("always.py"), "{error}");
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
    let pulled = Fixture::new(json!({ "crowd_gradients": 1e-13 })).device().unwrap();
    assert!(!pulled.info().self_test.is_batch_independent);
    // Some depend on it in large batches only.
    for (crowd, most, are_same) in
        [("crowd", 4, true), ("crowd", 6, false), ("crowd", 8, false), ("crowd_gradients", 8, false)]
    {
        let large = Fixture::new(json!({ crowd: 1e-13, "crowd_above": 4 })).device().unwrap();
        assert!(large.info().self_test.is_batch_independent);
        assert_eq!(large.warm_up(&crystal(1, 0), 0.5, most), Ok(are_same), "{crowd} {most}");
    }
}
