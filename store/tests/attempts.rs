//! Attempts at a label: what they cost, leave behind and count, and leases that are lost.

use store::{
    CalculationArchive, CalculationRecord, FailOutcome, JobState, Label, LabelDetails, Lease, LeaseStatus,
    Store, StoreError,
};
use wire::ContentHash;

use crate::common::*;
use crate::queue::{lease, state};

/// A calculation that was taken over counts once, with the attempt that delivered its result.
#[tokio::test]
async fn the_cost_of_a_calculation_is_counted_once() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    let names = accept(&store, 2).await;
    let made = CalculationRecord {
        cores: Some(4),
        remedies: Some("slower_mixing".into()),
        difference: Some("INCAR: + AMIX = 0.1".into()),
        atoms: Some(2),
        electrons: Some(8.0),
        k_points: Some(27),
    };
    let core_seconds =
        async |now| (store.budget(now).await.unwrap().1.core_hours * 3600.0 * 1000.0).round() / 1000.0;
    let first = lease(&store, "a", 0).await.unwrap();
    store.record_calculation(&first, "here", &made).await.unwrap();
    assert_eq!(core_seconds(3000).await, 12.0, "under way, on four cores");
    assert_eq!(store.release_all("a", 3000).await.unwrap(), 1);
    assert_eq!(core_seconds(3000).await, 12.0, "the cost since then is unknown");
    let second = lease(&store, "b", 3000).await.unwrap();
    assert_eq!((second.earlier_calculations.as_slice(), second.attempt), (&["here".to_owned()][..], 2));
    store.record_calculation(&second, "here", &made).await.unwrap();
    assert_eq!(core_seconds(3000).await, 0.0);
    store.record_cost(&second, 17.25, "the end").await.unwrap();
    let details = LabelDetails {
        energy_without_smearing: Some(-3.25),
        magnetic_moments: Some(vec![1.5, -1.5]),
        magnetisation: Some(0.0),
        electronic_steps: Some(12),
        // They are those of the calculation.
        retry_adjustments: made
            .remedies
            .iter()
            .flat_map(|names| names.split(','))
            .map(str::to_owned)
            .collect(),
        ordered_by_value: false,
    };
    let label = Label { details, ..label(-3.0) };
    store.complete(&second, &label, 5000).await.unwrap();
    assert_eq!(core_seconds(5000).await, 17.25);
    let shown = store.queue_show(&names[0]).await.unwrap();
    assert_eq!(shown.attempts_made[1].made, made);
    assert_eq!(shown.attempts_made[1].log.as_deref(), Some("the end"));
    let hash = ContentHash::from_structure(&second.structure);
    assert_eq!(store.labels_of(hash).await.unwrap()[0].record.label, label);

    // A corrected time of a finished calculation changes the total by the difference.
    store.record_cost(&second, 18.0, "the end").await.unwrap();
    let third = lease(&store, "c", 6000).await.unwrap();
    store.record_calculation(&third, "there", &made).await.unwrap();
    store.record_cost(&third, 1.5, "").await.unwrap();
    assert_eq!(
        store.release_lost(&third, "node_failure", "gone", 9000).await.unwrap(),
        FailOutcome::Requeued
    );
    assert_eq!(core_seconds(9000).await, 19.5);
    let fourth = lease(&store, "c", 9000).await.unwrap();
    assert_eq!((fourth.failures.as_slice(), fourth.overruled), (&["node_failure".to_owned()][..], false));
    let found = store.check(|_, _| ()).await.unwrap();
    assert!(found.iter().all(|finding| !finding.what.contains("sum of")), "{found:?}");
    assert_eq!(store.lease_status(&third).await.unwrap(), LeaseStatus::LeasedAgain { calculation: None });
    assert_eq!(store.lease_status(&fourth).await.unwrap(), LeaseStatus::Held);
    assert_eq!(store.lease_status(&second).await.unwrap(), LeaseStatus::Over);
    store.record_calculation(&fourth, "elsewhere", &made).await.unwrap();
    assert_eq!(core_seconds(9000).await, 19.5, "another calculation costs what it has cost");
}

#[tokio::test]
async fn archives_are_stored_with_their_attempts() {
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 1).await;
    let lease = lease(&store, "a", 0).await.unwrap();
    store.record_calculation(&lease, "here", &CalculationRecord::default()).await.unwrap();
    let past = async || store.past_calculation(lease.job, 1).await.unwrap().unwrap();
    assert_eq!((past().await.wanted, past().await.calculation.as_deref()), (true, Some("here")));
    for bytes in [&b"first"[..], b"second"] {
        store.keep_archive(lease.job, lease.attempt, bytes, "work/large (5 bytes)\n").await.unwrap();
    }
    store.fail(&lease, "crashed", "", 1, 5).await.unwrap();
    assert_eq!((past().await.wanted, past().await.failed), (false, true));
    let archive = CalculationArchive {
        attempt: 1,
        bytes: b"second".to_vec(),
        left_out: "work/large (5 bytes)\n".into(),
    };
    assert_eq!(store.archives(lease.job).await.unwrap(), std::slice::from_ref(&archive));
    assert_eq!(store.past_calculation(lease.job, 2).await.unwrap(), None);
    // A copy keeps the limits and their use.
    let elsewhere = tempfile::tempdir().unwrap();
    let target = elsewhere.path().join("copy");
    store.backup(&target, 7, |_, _| ()).await.unwrap();
    let copy = Store::open(&target).await.unwrap();
    assert_eq!(copy.archives(lease.job).await.unwrap(), [archive]);
    assert_eq!(copy.budget(9).await.unwrap(), store.budget(9).await.unwrap());
}

/// The reply to the commit of a lease was lost: its holder is alive and does not know of it.
#[tokio::test]
async fn leases_that_a_holder_does_not_state_are_released() {
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 4).await;
    let lease = async |holder: &str| {
        store.lease(protocol("dft").hash, holder, 0, 600).await.unwrap().expect("a job that waits")
    };
    let (known, unknown, part, other) =
        (lease("a").await, lease("a").await, lease("a/0").await, lease("b").await);
    assert_eq!(store.state_leases("a", &[&known], 1).await.unwrap(), 1);
    assert_eq!(store.state_leases("a", &[&known], 1).await.unwrap(), 0);
    for held in [&known, &part, &other] {
        assert!(store.renew(held, 2, 600).await.unwrap(), "{}", held.holder);
    }
    assert!(!store.renew(&unknown, 2, 600).await.unwrap());
    // It waits again, and no attempt has failed.
    let again = lease("a").await;
    assert_eq!((again.job, again.attempt, again.failures.len()), (unknown.job, 2, 0));
    let details = store.queue_show(&again.candidate).await.unwrap();
    assert_eq!(details.attempts_made[0].outcome.as_deref(), Some("lost"));
    // The lease of an earlier attempt is a different one.
    assert_eq!(store.state_leases("a", &[&known, &unknown], 3).await.unwrap(), 1);
    assert_eq!(store.state_leases("a", &[], 3).await.unwrap(), 1);
    assert_eq!((store.state_leases("a/0", &[&part], 3).await.unwrap(), details.job.failures), (0, 0));
}

/// A labeller that has lost its lease finds out what became of the job, and decides nothing about it any more.
#[tokio::test]
async fn who_has_lost_a_lease_decides_nothing() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    let lost = lease(&store, "a", 0).await.unwrap();
    assert_eq!(store.release_all("a", 1).await.unwrap(), 1);
    assert_eq!(store.lease_status(&lost).await.unwrap(), LeaseStatus::Queued);
    // Neither while the job waits nor while another one has it.
    for (number, holder) in [(0, None), (1, Some("b"))] {
        if let Some(holder) = holder {
            lease(&store, holder, 2).await.unwrap();
        }
        let released = store.release_lost(&lost, "node_failure", "gone", 3).await.unwrap();
        assert_eq!(released, FailOutcome::LeaseLost);
        let job = store.queue_show(&names[0]).await.unwrap().job;
        let expected = if number == 0 { JobState::Queued } else { JobState::Leased };
        assert_eq!((job.state, job.holder.as_deref()), (expected, holder));
    }
    let unknown = Lease { job: 99, ..lost };
    assert!(matches!(store.lease_status(&unknown).await, Err(StoreError::UnknownJob { .. })));
}

/// The crash of a labeller counts only for what it did itself: a calculation goes on without it.
#[tokio::test]
async fn a_calculation_does_not_fail_with_its_labeller() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    let first = lease(&store, "h", 0).await.unwrap();
    store.record_calculation(&first, "here", &CalculationRecord::default()).await.unwrap();
    assert_eq!(store.fail_leases_of("h", "crashed", "SIGSEGV", 1, 1).await.unwrap(), 1);
    let details = store.queue_show(&names[0]).await.unwrap();
    assert_eq!((details.job.state, details.job.failures), (JobState::Queued, 0));
    let attempt = &details.attempts_made[0];
    assert_eq!((attempt.outcome.as_deref(), attempt.class.as_deref()), (Some("lost"), None));
    assert_eq!(lease(&store, "h", 2).await.unwrap().earlier_calculations, ["here"]);
    // The calculation of an earlier attempt says nothing about this one.
    assert_eq!(store.fail_leases_of("h", "crashed", "SIGSEGV", 1, 3).await.unwrap(), 1);
    assert_eq!(state(&store, &names[0]).await, JobState::Failed);
}

/// An attempt knows the failures since the job was last requeued by hand, and every calculation that failed.
#[tokio::test]
async fn an_attempt_knows_what_has_failed() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    let fail = async |number: u32, class: &str| {
        let lease = lease(&store, "h", 0).await.unwrap();
        let calculation = format!("calculation {number}");
        store.record_calculation(&lease, &calculation, &CalculationRecord::default()).await.unwrap();
        match class {
            "node_failure" => store.release_lost(&lease, class, "gone", 1).await.unwrap(),
            _ => store.fail(&lease, class, "log", 3, 1).await.unwrap(),
        }
    };
    for (number, class) in [(1, "not_converged"), (2, "node_failure"), (3, "out_of_memory")] {
        assert_eq!(fail(number, class).await, FailOutcome::Requeued);
    }
    // A loss without a reason is none.
    let lost = lease(&store, "h", 0).await.unwrap();
    store.record_calculation(&lost, "calculation 4", &CalculationRecord::default()).await.unwrap();
    store.release_all("h", 1).await.unwrap();
    let fourth = lease(&store, "h", 0).await.unwrap();
    assert_eq!(fourth.failures, ["not_converged", "node_failure", "out_of_memory"]);
    let all = |last: u32| (1..=last).map(|number| format!("calculation {number}")).collect::<Vec<_>>();
    assert_eq!(fourth.failed_calculations, all(3));
    assert_eq!(store.fail(&fourth, "crashed", "log", 3, 1).await.unwrap(), FailOutcome::Failed);
    store.retry_job(&names[0], 2).await.unwrap();
    let fifth = lease(&store, "h", 0).await.unwrap();
    assert_eq!((fifth.failures.len(), fifth.overruled), (0, true));
    store.release_all("h", 3).await.unwrap();
    assert_eq!(fail(7, "time_limit").await, FailOutcome::Requeued);
    let last = lease(&store, "h", 0).await.unwrap();
    assert_eq!(last.failures, ["time_limit"]);
    assert_eq!(last.failed_calculations, [all(3), vec!["calculation 7".to_owned()]].concat());
}
