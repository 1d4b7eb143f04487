//! Traces of walks: bounded, the same however their points were grouped, and in one transaction with their commit.

use store::{Commit, Store};
use wire::{MAX_KEPT_POINTS, TracePoint, WalkId};

use crate::common::*;

pub fn trace_point(number: u64) -> TracePoint {
    TracePoint {
        number,
        segment: (number / 300) as u32,
        step: 50 * number,
        time: 100.0 * number as f64,
        temperature: 600.0 + number as f64,
        pressure: (!number.is_multiple_of(3)).then_some(-0.25 * number as f64),
        relative_volume: 1.0 + 1e-4 * number as f64,
        cell: (!number.is_multiple_of(5)).then_some([4.0, 5.0, 6.0, 90.0, 80.0, 70.0]),
        conserved_energy: (!number.is_multiple_of(7)).then_some(-300.25),
        gamma_max: (!number.is_multiple_of(11)).then_some(1.0 / (1.0 + number as f64)),
        bias_scale: 0.1 * number as f64,
        cell_gain: 0.0,
        bias_share: 0.15,
        bias_work: 0.01 * number as f64,
        gamma_max_original: (!number.is_multiple_of(13)).then_some(0.5 * number as f64),
    }
}

async fn add(store: &Store, walk_number: u32, points: impl Iterator<Item = u64>) {
    let traces = vec![(WalkId(walk_number), points.map(trace_point).collect())];
    store.commit(&Commit { traces, ..Commit::default() }).await.unwrap();
}

/// The column of a walk, byte for byte.
async fn written(groups: &[u64]) -> Vec<TracePoint> {
    let database = TestDatabase::new();
    let store = database.create().await;
    let mut next = 0;
    for count in groups {
        add(&store, 3, next..next + count).await;
        next += count;
    }
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    let trace = store.walk_trace(WalkId(3)).await.unwrap();
    store.close().await;
    trace
}

#[tokio::test]
async fn a_trace_is_bounded_and_does_not_depend_on_its_reports() {
    let few: Vec<_> = (0..20).map(trace_point).collect();
    assert_eq!(written(&[20]).await, few);
    assert_eq!(written(&[1, 0, 12, 7]).await, few);
    let whole = written(&[1500]).await;
    assert_eq!(written(&[1, 511, 1, 0, 600, 387]).await, whole);
    assert!(whole.len() <= MAX_KEPT_POINTS + 1);
    assert_eq!(whole.iter().map(|point| point.number).collect::<Vec<_>>(), {
        let mut kept: Vec<_> = (0..1500).step_by(4).collect();
        kept.push(1499);
        kept
    });
    assert!(whole.iter().all(|found| *found == trace_point(found.number)));
}

#[tokio::test]
async fn points_are_written_once_with_the_rest_of_their_commit() {
    let database = TestDatabase::new();
    let store = database.create().await;
    assert_eq!(store.walk_trace(WalkId(0)).await.unwrap(), []);
    add(&store, 0, 0..4).await;
    add(&store, 1, 0..2).await;
    // A walk with several reports in one commit.
    let traces = vec![
        (WalkId(0), vec![trace_point(4)]),
        (WalkId(1), vec![]),
        (WalkId(0), vec![trace_point(5), trace_point(6)]),
    ];
    store.commit(&Commit { traces, ..Commit::default() }).await.unwrap();
    // Points that are there already.
    add(&store, 0, 5..8).await;
    assert_eq!(store.walk_trace(WalkId(0)).await.unwrap(), (0..8).map(trace_point).collect::<Vec<_>>());
    // A commit that fails writes none.
    let record = candidate(0, 1, wire::Origin::Biased, store::Fate::Accepted);
    store.commit(&commit_of(vec![record.clone()])).await.unwrap();
    let traces = vec![(WalkId(1), vec![trace_point(2)])];
    let twice = Commit { traces, ..commit_of(vec![record]) };
    assert!(store.commit(&twice).await.is_err());
    assert_eq!(store.walk_trace(WalkId(1)).await.unwrap().len(), 2);
    assert_eq!(store.check(|_, _| {}).await.unwrap().len(), 1, "the walk of the candidate is missing");
}

#[tokio::test]
async fn traces_are_in_backups_and_damage_is_found() {
    let database = TestDatabase::new();
    let store = database.create().await;
    add(&store, 2, 0..600).await;
    let copies = tempfile::tempdir().unwrap();
    let copy = copies.path().join("copy");
    store.backup(&copy, 3, |_, _| {}).await.unwrap();
    let copied = Store::open_read_only(copy.as_path()).await.unwrap();
    let trace = store.walk_trace(WalkId(2)).await.unwrap();
    assert_eq!(copied.walk_trace(WalkId(2)).await.unwrap(), trace);
    copied.close().await;
    for damage in [
        "UPDATE walk_trace SET points = points - 1",
        "UPDATE walk_trace SET data = substr(data, 1, 40)",
        "UPDATE walk_trace SET walk = 7",
    ] {
        database.execute(damage).await;
        let found = store.check(|_, _| {}).await.unwrap();
        assert!(found.len() == 1 && found[0].what.starts_with("damaged database: walk trace"), "{found:?}");
    }
    assert!(store.walk_trace(WalkId(7)).await.is_err());
}
