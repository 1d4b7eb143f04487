//! Calculations by an external program, here a shell script: run, resumed, ended, archived.

mod failures;
mod files;
mod fixture;
mod resumption;

use std::fs;

use dft::FailureClass;
use fixture::*;
use store::{LabelStatus, unix_milliseconds};
use workers::labeller::{LabelBounds, label_structure, run_calculation};

use crate::common::{ATOMS, structure};

/// Not a test: the runner that the tests start for their calculations.
#[test]
#[ignore = "runs the calculations of the other tests"]
fn runner() {
    run_calculation().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_label_is_stored_with_its_details() {
    let script = "echo said; echo warned >&2; echo $SCRIPT $CALMWALK_CORES; sleep 0.2; echo -7.5 > energy";
    let fixture = Fixture::new(1, script).await;
    fixture.work().await;
    let labels = fixture.labels().await;
    assert_eq!((labels.len(), labels[0].status, labels[0].label.energy), (1, LabelStatus::Label, -7.5));
    let details = &labels[0].label.details;
    assert_eq!(
        (details.magnetic_moments.as_deref(), details.electronic_steps),
        (Some(&[0.5; ATOMS][..]), Some(7))
    );
    let attempts = fixture.attempts().await;
    let [attempt] = &attempts[..] else { panic!("{attempts:?}") };
    let made = &attempt.made;
    assert_eq!(
        (made.cores, made.atoms, made.electrons, made.k_points),
        (Some(3), Some(2), Some(8.0), Some(27))
    );
    assert_eq!((&made.remedies, &made.difference), (&None, &None));
    assert_eq!(said(attempt.log.as_deref()), "stdout:\nsaid\nfake 3\nstderr:\nwarned\n");
    // Its time on each of three cores.
    let seconds = attempt.core_seconds.unwrap();
    let whole = 3.0 * (attempt.ended.unwrap() - attempt.started) as f64 / 1000.0;
    assert!((0.6..=whole + 0.01).contains(&seconds), "{seconds} of {whole}");
    let (_, used) = fixture.store.budget(unix_milliseconds()).await.unwrap();
    assert!((used.core_hours * 3600.0 - seconds).abs() < 1e-3, "{used:?}");
    fixture.is_consistent().await;
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_structure_is_labelled_without_a_campaign() {
    let fixture = Fixture::new(1, "echo said; sleep 0.1; echo -7.5 > energy").await;
    let once = label_structure(&fixture.method(), &structure(0.0), &LabelBounds::default()).await.unwrap();
    assert_eq!(once.result.unwrap().energy, -7.5);
    assert!(
        once.core_seconds >= 0.3 && said(Some(&once.log)) == "stdout:\nsaid\n",
        "{} {}",
        once.core_seconds,
        once.log
    );
    let failing = Fixture::new(1, "echo said; exit 3").await;
    let once = label_structure(&failing.method(), &structure(0.0), &LabelBounds::default()).await.unwrap();
    assert_eq!(
        (once.result.unwrap_err().class, said(Some(&once.log)).as_str()),
        (FailureClass::NotConverged, "stdout:\nsaid\n")
    );
    for fixture in [fixture, failing] {
        assert_eq!(fixture.processes(), [0_u32; 0]);
        assert_eq!(fs::read_dir(fixture.running.scratch()).unwrap().count(), 0);
    }
}
