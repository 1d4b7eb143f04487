//! Budgets: their use, and that no attempt starts once a limit is reached.

use store::{Budget, Store};

use crate::common::*;

/// An hour in ms.
const HOUR: i64 = 3_600_000;

async fn is_given(store: &Store, now: i64) -> bool {
    store.lease(protocol("dft").hash, "a", now, 100_000).await.unwrap().is_some()
}

async fn limit(store: &Store, budget: Budget) {
    store.set_budget(&budget).await.unwrap();
}

#[tokio::test]
async fn no_more_labels_start_than_the_budget_permits() {
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 4).await;
    limit(&store, Budget { labels: Some(2), ..Budget::default() }).await;
    let lease = async || store.lease(protocol("dft").hash, "a", 0, 1000).await.unwrap();
    let (first, second) = (lease().await.unwrap(), lease().await.unwrap());
    assert!(lease().await.is_none(), "two are under way");
    assert!(store.has_pending_labels(0).await.unwrap());
    store.complete(&first, &label(-1.0), 10).await.unwrap();
    store.fail(&second, "unconverged", "", 9, 20).await.unwrap();
    // A failed attempt makes no label.
    let third = lease().await.unwrap();
    store.complete(&third, &label(-2.0), 30).await.unwrap();
    assert!(lease().await.is_none());
    assert!(!store.has_pending_labels(40).await.unwrap(), "what is queued waits for a larger budget");
    let (_, used) = store.budget(40).await.unwrap();
    assert_eq!((used.labels, used.attempts_in_progress), (2, 0));
    limit(&store, Budget { labels: Some(3), ..Budget::default() }).await;
    assert!(store.has_pending_labels(40).await.unwrap() && lease().await.is_some());
    limit(&store, Budget::default()).await;
    assert!(lease().await.is_some());
}

#[tokio::test]
async fn hours_sum_over_all_attempts_and_runs() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    accept(&store, 4).await;
    let lease = async |now| store.lease(protocol("dft").hash, "a", now, 100_000).await.unwrap().unwrap();
    let failed = lease(0).await;
    store.fail(&failed, "unconverged", "", 9, HOUR / 2).await.unwrap();
    let labelled = lease(HOUR).await;
    store.complete(&labelled, &label(-1.0), 2 * HOUR).await.unwrap();
    lease(2 * HOUR).await;
    let used = async |now| store.budget(now).await.unwrap().1.core_hours;
    assert_eq!([used(2 * HOUR).await, used(3 * HOUR).await], [1.5, 2.5], "one is under way");
    limit(&store, Budget { core_hours: Some(3.0), ..Budget::default() }).await;
    assert!(is_given(&store, 3 * HOUR).await);
    assert!(!is_given(&store, 4 * HOUR).await);
    let status = store.status().await.unwrap();
    assert_eq!(status.budget.used_up.as_deref(), Some("budget.core_hours"));

    limit(&store, Budget { wall_hours: Some(1.0), ..Budget::default() }).await;
    assert!(is_given(&store, 4 * HOUR).await);
    store.add_running_time(HOUR as u64 / 2).await.unwrap();
    assert_eq!(store.status().await.unwrap().budget.used_up, None);
    store.add_running_time(HOUR as u64 / 2).await.unwrap();
    assert!(!is_given(&store, 5 * HOUR).await);
    let status = store.status().await.unwrap();
    assert_eq!(
        (status.budget.used_up.as_deref(), status.budget.used.wall_hours),
        (Some("budget.wall_time"), 1.0)
    );
}
