//! Accepted candidates without a label are those that an export leaves out.

use store::{ExportFilter, ExportSource, Fate, Store, StoreError};
use wire::messages::DeclineReason;
use wire::{ContentHash, Origin};

use crate::common::*;

/// Names of the candidates without a label, read in pages of `limit`.
async fn without_label(store: &Store, protocol: Option<ContentHash>, limit: u32) -> Vec<String> {
    let (mut names, mut last) = (Vec::new(), 0);
    loop {
        let page = store.candidates_without_label(protocol, last, limit).await.unwrap();
        assert!(page.len() <= limit as usize);
        let Some(end) = page.last() else { return names };
        assert!(end.decision > last);
        last = end.decision;
        names.extend(page.iter().map(|candidate| candidate.block.view().id().to_string()));
    }
}

/// Names of the candidates of biased walks in an export.
async fn exported(store: &Store, protocol: ContentHash) -> Vec<String> {
    let filter = ExportFilter { protocol, biased: true, control: false, imported: false };
    let rows = store.labelled(&filter, None, 100).await.unwrap();
    let name = |source| match source {
        ExportSource::Candidate { id, .. } => id,
        ExportSource::Import { file, .. } => file,
    };
    rows.into_iter().map(|row| name(row.source)).collect()
}

#[tokio::test]
async fn pending_failed_excluded_and_dropped_candidates_have_no_label() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let dft = protocol("dft").hash;
    let names = accept(&store, 7).await;
    let others = vec![
        candidate(0, 20, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
        candidate(1, 20, Origin::Control, Fate::Accepted),
    ];
    store.commit(&commit_of(others)).await.unwrap();
    assert_eq!(without_label(&store, Some(dft), 3).await, names);

    // Two labels, a failure and a calculation under way; the others wait.
    let mut leases = Vec::new();
    for _ in 0..4 {
        leases.push(store.lease(dft, "host/a", 0, 10).await.unwrap().unwrap());
    }
    for lease in &leases[..2] {
        store.complete(lease, &label(-1.0), 1).await.unwrap();
    }
    store.fail(&leases[2], "crashed", "", 1, 1).await.unwrap();
    assert_eq!(without_label(&store, Some(dft), 2).await, names[2..]);

    store.exclude(&names[1..2], "a test", 2).await.unwrap();
    // A structure that was dropped is not exported, even if a label of it is imported.
    store.drop_job(&names[4], 3).await.unwrap();
    store.import(dft, "old.extxyz", &[(0, structure(1e-6 * 5.0), label(-5.0))], 4).await.unwrap();
    store.import(dft, "old.extxyz", &[(1, structure(1e-6 * 7.0), label(-7.0))], 5).await.unwrap();
    let labelled = [names[0].clone(), names[6].clone()];
    assert_eq!(exported(&store, dft).await, labelled);
    for limit in [1, 4, 100] {
        assert_eq!(without_label(&store, Some(dft), limit).await, names[1..6]);
    }

    // Labels of one protocol are none of another.
    store.add_protocol(&protocol("other"), 6).await.unwrap();
    assert_eq!(without_label(&store, Some(protocol("other").hash), 3).await, names);
    assert_eq!(without_label(&store, None, 3).await, names);
    let unknown = store.candidates_without_label(Some(protocol("unknown").hash), 0, 1).await;
    assert!(matches!(unknown, Err(StoreError::UnknownProtocol(_))), "{unknown:?}");
}
