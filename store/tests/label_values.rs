//! Labels in the order of their value.

use serde_json::json;
use store::{Fate, JobState, LabelValue, Lease, ListCursor, NO_LABEL_VALUE, Store};
use wire::messages::DeclineReason;
use wire::{ContentHash, Origin};

use crate::common::*;

async fn lease(store: &Store, now: i64) -> Lease {
    store.lease(protocol("dft").hash, "a", now, 600).await.unwrap().unwrap()
}

/// Sets the values of the structures with these names; returns the number of jobs that got one.
async fn set(store: &Store, values: &[(&String, f64)]) -> u64 {
    let mut rows = Vec::new();
    for (name, value) in values {
        let job = store.queue_show(name).await.unwrap().job.job;
        rows.push(LabelValue { job, value: *value, factors: json!({ "expected_error": value }) });
    }
    store.set_label_values(&rows).await.unwrap()
}

#[tokio::test]
async fn jobs_are_leased_by_priority_then_value_then_age() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 7).await;
    store.prioritise_job(&names[6], 20, 0).await.unwrap();
    store.prioritise_job(&names[5], 0, 0).await.unwrap();
    // The priority counts before the value; equal values are in decision order; jobs without a value come last.
    let values =
        [(&names[5], 9.0), (&names[1], 0.5), (&names[3], 2.5), (&names[4], 0.5), (&names[2], f64::NAN)];
    assert_eq!(set(&store, &values).await, 5);
    let expected = [6, 3, 1, 4, 2, 0, 5].map(|k: usize| names[k].clone());
    let listed = store.queue_list(Some(JobState::Queued), 99, 0).await.unwrap();
    assert_eq!(listed.iter().map(|job| job.candidate.clone()).collect::<Vec<_>>(), expected);
    assert_eq!((listed[1].value, listed[4].value, listed[5].value), (Some(2.5), Some(0.0), None));
    assert_eq!(listed[1].value_factors, Some(json!({ "expected_error": 2.5 })));
    for limit in 1..=7 {
        assert_eq!(pages(&store, limit).await, expected, "{limit}");
    }
    for name in &expected {
        assert_eq!(lease(&store, 0).await.candidate, *name);
    }
}

/// Names in the order of the queue, page by page.
async fn pages(store: &Store, limit: u32) -> Vec<String> {
    let (mut names, mut after) = (Vec::new(), None);
    loop {
        let page = store.list_queue(JobState::Queued, after, limit).await.unwrap();
        let Some(last) = page.last() else { return names };
        let value = last.value.unwrap_or(NO_LABEL_VALUE);
        after = Some(ListCursor { priority: last.priority.unwrap(), value, decision: last.decision });
        names.extend(page.into_iter().map(|row| row.id));
    }
}

#[tokio::test]
async fn labels_tell_whether_their_structures_were_chosen_by_value() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 3).await;
    set(&store, &[(&names[2], 1.0)]).await;
    let first = lease(&store, 0).await;
    assert_eq!(first.candidate, names[2]);
    // A leased job keeps its value.
    assert_eq!(set(&store, &[(&names[2], 5.0)]).await, 0);
    assert_eq!(store.clear_label_values().await.unwrap(), 0);
    store.complete(&first, &label(-1.0), 1).await.unwrap();
    let second = lease(&store, 2).await;
    assert_eq!(second.candidate, names[0]);
    store.complete(&second, &label(-2.0), 3).await.unwrap();
    let by_value = async |lease: &Lease| {
        let labels = store.labels_of(ContentHash::from_structure(&lease.structure)).await.unwrap();
        labels[0].record.label.details.ordered_by_value
    };
    assert_eq!((by_value(&first).await, by_value(&second).await), (true, false));
    // A failed job that is queued again has no value any more.
    set(&store, &[(&names[1], 1.0)]).await;
    let failing = lease(&store, 4).await;
    store.fail(&failing, "crashed", "", 1, 5).await.unwrap();
    store.retry_job(&names[1], 6).await.unwrap();
    assert_eq!(store.queue_show(&names[1]).await.unwrap().job.value, None);
    set(&store, &[(&names[1], 1.0)]).await;
    assert_eq!(store.clear_label_values().await.unwrap(), 1);
    assert_eq!(store.queue_show(&names[1]).await.unwrap().job.value, None);
}

/// The value of a job may come, and go, while a labeller that lost its lease still works on it.
#[tokio::test]
async fn a_label_tells_how_its_own_lease_was_chosen() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 2).await;
    set(&store, &[(&names[0], 1.0)]).await;
    let by_value = lease(&store, 0).await;
    assert_eq!((&by_value.candidate, by_value.ordered_by_value), (&names[0], true));
    let in_order = lease(&store, 0).await;
    assert_eq!((&in_order.candidate, in_order.ordered_by_value), (&names[1], false));
    store.release_all("a", 1).await.unwrap();
    assert_eq!(store.clear_label_values().await.unwrap(), 1);
    assert_eq!(set(&store, &[(&names[1], 1.0)]).await, 1);
    for (lease, expected) in [(&by_value, true), (&in_order, false)] {
        store.complete(lease, &label(-1.0), 2).await.unwrap();
        let labels = store.labels_of(ContentHash::from_structure(&lease.structure)).await.unwrap();
        assert_eq!(labels[0].record.label.details.ordered_by_value, expected, "{}", lease.candidate);
    }
}

#[tokio::test]
async fn values_are_computed_from_finished_and_queued_structures() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let dft = protocol("dft").hash;
    let names = accept(&store, 4).await;
    let records = vec![
        candidate(0, 5, Origin::Control, Fate::Accepted),
        candidate(0, 6, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
    ];
    store.commit(&commit_of(records)).await.unwrap();
    store.queue_imports(&[("new.extxyz".into(), 0, structure(50.0))], 0, 0).await.unwrap();
    set(&store, &[(&names[2], 2.0), (&names[3], 1.0)]).await;
    let done = lease(&store, 0).await;
    store.complete(&done, &label(-1.0), 1).await.unwrap();
    let failing = lease(&store, 2).await;
    store.fail(&failing, "crashed", "", 1, 3).await.unwrap();

    let finished = store.finished_structures(dft, Some(0), 9).await.unwrap();
    let found: Vec<_> = finished.iter().map(|row| (row.decision, row.labelled)).collect();
    assert_eq!(found, [(4, false), (3, true)], "newest first");
    assert_eq!((finished[1].walk, finished[1].seed_structure), (0, 0));
    assert_eq!(store.finished_structures(dft, None, 9).await.unwrap(), finished);
    assert_eq!((finished[1].gamma, finished[1].relative_volume), (Some(1.3 + 0.1), Some(1.01)));
    assert_eq!(
        ContentHash::from_structure(&finished[1].structure),
        ContentHash::from_structure(&done.structure)
    );
    assert_eq!(store.finished_structures(dft, Some(0), 1).await.unwrap(), finished[..1]);
    assert_eq!(store.finished_structures(dft, Some(1), 9).await.unwrap(), [], "no walk has this version");

    let queued = store.queued_structures(dft, 9).await.unwrap();
    let found: Vec<_> = queued.iter().map(|row| (row.decision, row.priority, row.overtaken)).collect();
    // Two structures that were found later are finished; none of them has the priority of the control frame.
    assert_eq!(found, [(1, 10, 2), (2, 10, 2), (5, 0, 0)]);
    assert_eq!((queued[0].original.gamma.len(), queued[0].formula.as_str()), (ATOMS, "Si2"));
    assert_eq!(store.queued_structures(dft, 2).await.unwrap(), queued[..2]);
    let held = lease(&store, 4).await;
    let states: Vec<_> =
        store.queued_structures(dft, 9).await.unwrap().iter().map(|row| (row.job, row.leased)).collect();
    assert_eq!(states[0], (held.job, true));
    assert!(states[1..].iter().all(|(_, leased)| !leased));
    let features = store.features_of(1).await.unwrap().unwrap();
    assert_eq!((features.len(), features[1]), (3 * ATOMS, 1.0));
    assert_eq!(store.features_of(77).await.unwrap(), None);
    store.exclude(&[names[2].clone()], "bad", 5).await.unwrap();
    assert_eq!(store.finished_structures(dft, Some(0), 9).await.unwrap().len(), 1);
    // A guard rejected it before any calculation: nothing says whether that would have completed.
    store.fail(&held, "rejected_by_label_guard", "", 1, 6).await.unwrap();
    assert_eq!(store.finished_structures(dft, Some(0), 9).await.unwrap().len(), 1);
}
