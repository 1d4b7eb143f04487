//! The history of a campaign and the labels under way.

use store::Store;
use wire::WalkId;

use crate::common::*;
use crate::walk_trace::trace_point;

const HOUR: i64 = 3_600_000;

async fn times(store: &Store) -> Vec<i64> {
    store.history().await.unwrap().iter().map(|sample| sample.time).collect()
}

#[tokio::test]
async fn samples_count_what_the_campaign_has() {
    let database = TestDatabase::new();
    let store = database.create().await;
    store.add_history_sample(5, 10).await.unwrap();
    accept(&store, 3).await;
    store.add_history_sample(5, 20).await.unwrap();
    let samples = store.history().await.unwrap();
    assert_eq!(samples.iter().map(|one| (one.time, one.run)).collect::<Vec<_>>(), [(10, 5), (20, 5)]);
    assert_eq!((samples[0].accepted, samples[0].queued, samples[0].labels), (0, 0, 0));
    assert_eq!((samples[1].seen, samples[1].accepted, samples[1].queued, samples[1].leased), (3, 3, 3, 0));
    assert_eq!(samples[1].steps_per_second, None);
    // The same time again replaces the sample.
    store.add_history_sample(6, 20).await.unwrap();
    assert_eq!(store.history().await.unwrap()[1].run, 6);
    store.close().await;
}

#[tokio::test]
async fn samples_are_thinned_out_as_they_age() {
    let database = TestDatabase::new();
    let store = database.create().await;
    // A run of an hour, and a second one from its 59th minute on.
    for second in (0..3600).step_by(30) {
        store.add_history_sample(i64::from(second >= 3540), 1000 * second).await.unwrap();
    }
    store.thin_history(HOUR).await.unwrap();
    assert_eq!(times(&store).await.len(), 120, "15 s apart at the closest");
    store.thin_history(4 * HOUR).await.unwrap();
    let kept = times(&store).await;
    assert_eq!(kept.len(), 31, "one every two minutes, and the beginning of the second run: {kept:?}");
    assert!(kept.contains(&0) && kept.contains(&3_540_000));
    store.thin_history(100 * 24 * HOUR).await.unwrap();
    assert_eq!(times(&store).await, [0, 3_540_000], "one in six hours of each run");
    store.close().await;
}

#[tokio::test]
async fn labels_under_way_are_listed() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 2).await;
    assert_eq!(store.running_labels(9).await.unwrap(), []);
    let lease = store.lease(protocol("dft").hash, "a", 1000, 10).await.unwrap().unwrap().job;
    let running = store.running_labels(9).await.unwrap();
    assert_eq!(running.len(), 1);
    assert_eq!((running[0].job, running[0].attempt, running[0].started), (lease, 1, 1000));
    assert!(names.contains(&running[0].candidate), "{running:?}");
    store.close().await;
}

#[tokio::test]
async fn the_status_has_the_last_original_grade_of_each_trace() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let walks = vec![walk(0, 1), walk(1, 1), walk(2, 1)];
    let traces = vec![
        (WalkId(0), (0..12).map(trace_point).collect()),
        // The last point has none.
        (WalkId(1), (0..14).map(trace_point).collect()),
    ];
    store.commit(&store::Commit { walks, traces, ..store::Commit::default() }).await.unwrap();
    let status = store.status().await.unwrap();
    let found: Vec<_> = status.walks.iter().map(|walk| walk.gamma_max_original).collect();
    assert_eq!(found, [Some(5.5), None, None]);
    store.close().await;
}
