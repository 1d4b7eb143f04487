//! Pages of the candidates of one walk.

use store::{Fate, ListedCandidate, Store};
use wire::Origin;
use wire::messages::DeclineReason;

use crate::common::*;

/// Decisions on candidates of a walk, read in pages of `limit`.
async fn decisions(store: &Store, walk: u32, descending: bool, limit: u32) -> Vec<i64> {
    let mut found: Vec<ListedCandidate> = Vec::new();
    loop {
        let after = found.last().map(|last| last.decision);
        let page = store.list_decided_of_walk(walk, descending, after, limit).await.unwrap();
        assert!(page.len() <= limit as usize && page.iter().all(|row| row.walk == walk));
        if page.is_empty() {
            return found.into_iter().map(|row| row.decision).collect();
        }
        found.extend(page);
    }
}

/// Names and decisions have different orders, and the name of walk 1 begins as that of walk 11.
#[tokio::test]
async fn candidates_of_a_walk_come_in_decision_order() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let declined = Fate::Declined(DeclineReason::Covered);
    for step in [90, 200, 1000] {
        let records = [1, 11, 2].map(|walk| {
            let fate = if walk == 1 && step == 200 { declined } else { Fate::Accepted };
            candidate(walk, step, Origin::Biased, fate)
        });
        store.commit(&commit_of(records.to_vec())).await.unwrap();
    }
    for limit in [1, 2, 10] {
        assert_eq!(decisions(&store, 1, false, limit).await, [1, 4, 7]);
        assert_eq!(decisions(&store, 11, true, limit).await, [8, 5, 2]);
        assert!(decisions(&store, 5, true, limit).await.is_empty());
    }
    let all = store.list_decided_of_walk(1, true, None, 9).await.unwrap();
    let fates: Vec<_> =
        all.iter().map(|row| (row.step, row.fate.as_str(), row.job_state.as_deref())).collect();
    assert_eq!(
        fates,
        [(1000, "accepted", Some("queued")), (200, "covered", None), (90, "accepted", Some("queued"))]
    );
}
