//! Repeating labels, under the same protocol and under another one.

use serde_json::json;
use store::{
    Commit, CompleteOutcome, ExportFilter, FailOutcome, JobState, LabelSource, LabelStatus, Lease,
    LeaseStatus, NewProtocol, Protocol, RelabelCounts, RelabelRequest, Store, StoreError, WalkRecord,
};
use wire::ContentHash;

use crate::common::*;

const RELABELLING: RelabelCounts = RelabelCounts { relabelling: 1, moved: 0 };

async fn lease(store: &Store, protocol: &Protocol, now: i64) -> Option<Lease> {
    store.lease(protocol.hash, "host/a", now, 10).await.unwrap()
}

/// Leases and labels the next job of a protocol.
async fn label_next(store: &Store, protocol: &Protocol, energy: f64, now: i64) -> CompleteOutcome {
    let lease = lease(store, protocol, now).await.unwrap();
    store.complete(&lease, &label(energy), now + 1).await.unwrap()
}

/// Candidates of which the first `labelled` have labels under "dft", with energies −1, −2, …
async fn campaign_with(database: &TestDatabase, candidates: u64, labelled: u64) -> (Store, Vec<ContentHash>) {
    let store = database.create().await;
    accept(&store, candidates).await;
    let walk = WalkRecord { accepted: candidates as u32, ..walk(0, 1) };
    store.commit(&Commit { walks: vec![walk], ..Commit::default() }).await.unwrap();
    for energy in 1..=labelled {
        assert_eq!(label_next(&store, &protocol("dft"), -(energy as f64), 0).await, CompleteOutcome::Label);
    }
    (
        store,
        (1..=candidates).map(|step| ContentHash::from_structure(&structure(1e-6 * step as f64))).collect(),
    )
}

async fn relabel(store: &Store, structures: &[ContentHash], include_current: bool) -> RelabelCounts {
    let order = RelabelRequest { structures, include_current, reason: "a sick node", protocol: None };
    store.relabel(&order, 100).await.unwrap()
}

async fn change_to(store: &Store, to: &Protocol, structures: &[ContentHash]) -> RelabelCounts {
    let notes = [("label_method", format!("how {} is made", to.name))];
    let changes = [json!({ "key": "label.protocol", "before": "dft", "after": to.name })];
    let new = NewProtocol { protocol: to, configuration: "{\"new\":1}", changes: &changes, notes: &notes };
    let order = RelabelRequest { structures, include_current: false, reason: "cutoff", protocol: Some(new) };
    store.relabel(&order, 200).await.unwrap()
}

/// Status, energy and protocol of every label of a structure.
async fn history(store: &Store, structure: ContentHash) -> Vec<(LabelStatus, f64, String)> {
    let labels = store.labels_of(structure).await.unwrap().into_iter();
    labels.map(|label| (label.record.status, label.record.label.energy, label.protocol.name)).collect()
}

/// Energies in an export.
async fn exported(store: &Store, protocol: &Protocol) -> Vec<f64> {
    let filter = ExportFilter { protocol: protocol.hash, biased: true, control: true, imported: true };
    let rows = store.labelled(&filter, None, 100).await.unwrap();
    rows.iter().map(|row| row.label.energy).collect()
}

/// States of a structure's jobs, by protocol.
async fn jobs(store: &Store, structure: ContentHash) -> Vec<(String, JobState)> {
    let jobs = store.jobs_of(structure).await.unwrap().into_iter();
    jobs.map(|details| (details.job.protocol, details.job.state)).collect()
}

async fn whole(store: &Store) {
    assert_eq!(
        store.check(|_, _| {}).await.unwrap().iter().map(|f| f.what.clone()).collect::<Vec<_>>(),
        [""; 0]
    );
}

#[tokio::test]
async fn a_doubtful_label_stays_until_the_new_one_arrives() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 2, 1).await;
    let dft = protocol("dft");
    assert_eq!(relabel(&store, &structures, false).await, RelabelCounts::default(), "it has its label");
    assert_eq!(relabel(&store, &structures, true).await, RELABELLING);
    assert_eq!(relabel(&store, &structures, true).await, RelabelCounts::default(), "it waits already");
    assert_eq!(exported(&store, &dft).await, [-1.0]);
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.queued, labels.labelled, labels.relabelling, labels.relabel_failed), (2, 0, 1, 0));
    assert_eq!(store.unfinished_jobs().await.unwrap(), 1, "walks did not find it");
    let kept: Vec<_> =
        store.labelled_after(dft.hash, 0, 9).await.unwrap().iter().map(|found| found.job).collect();
    assert_eq!(kept, [Some(JobState::Queued)]);
    whole(&store).await;

    let found = lease(&store, &dft, 300).await.unwrap();
    assert_eq!(ContentHash::from_structure(&found.structure), structures[0]);
    assert!(found.overruled && found.failures.is_empty() && found.attempt == 2);
    assert_eq!(store.complete(&found, &label(-1.5), 400).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(
        store.complete(&found, &label(-1.5), 500).await.unwrap(),
        CompleteOutcome::Label,
        "brought twice"
    );
    let expected = [(LabelStatus::Superseded, -1.0, "dft".into()), (LabelStatus::Label, -1.5, "dft".into())];
    assert_eq!(history(&store, structures[0]).await, expected);
    let old = store.labels_of(structures[0]).await.unwrap().remove(0).record;
    assert_eq!(old.superseded.map(|s| (s.time, s.reason)), Some((400, "a sick node".into())));
    assert_eq!(old.label, label(-1.0));
    assert_eq!(exported(&store, &dft).await, [-1.5]);
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.queued, labels.labelled, labels.relabelling), (1, 1, 0));
    let operation = store.operations(0, 100).await.unwrap().pop().unwrap();
    assert_eq!((operation.kind.as_str(), &operation.detail["relabelling"]), ("relabel", &json!(1)));
    whole(&store).await;
}

#[tokio::test]
async fn a_label_that_cannot_be_remade_stays() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 1, 1).await;
    let dft = protocol("dft");
    relabel(&store, &structures, true).await;
    let first = lease(&store, &dft, 300).await.unwrap();
    assert_eq!(store.fail(&first, "crashed", "", 2, 301).await.unwrap(), FailOutcome::Requeued);
    let second = lease(&store, &dft, 302).await.unwrap();
    assert_eq!(store.fail(&second, "crashed", "", 2, 303).await.unwrap(), FailOutcome::Failed);
    assert_eq!(jobs(&store, structures[0]).await, [("dft".into(), JobState::Labelled)]);
    assert_eq!(exported(&store, &dft).await, [-1.0]);
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.labelled, labels.failed, labels.relabelling, labels.relabel_failed), (1, 0, 0, 1));
    whole(&store).await;
    // It may be requested again, and a late result satisfies the request.
    assert_eq!(relabel(&store, &structures, true).await, RELABELLING);
    let third = lease(&store, &dft, 400).await.unwrap();
    assert!(third.failures.is_empty());
    assert_eq!(store.release_all("host", 401).await.unwrap(), 1);
    assert_eq!(store.complete(&third, &label(-1.5), 402).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(store.status().await.unwrap().labels.relabel_failed, 0);
    assert_eq!(exported(&store, &dft).await, [-1.5]);
    whole(&store).await;
}

#[tokio::test]
async fn an_attempt_from_before_the_request_gives_a_check() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 1, 0).await;
    let dft = protocol("dft");
    let late = lease(&store, &dft, 0).await.unwrap();
    assert_eq!(label_next(&store, &dft, -1.0, 20_000).await, CompleteOutcome::Label);
    relabel(&store, &structures, true).await;
    assert_eq!(store.complete(&late, &label(-9.0), 30_000).await.unwrap(), CompleteOutcome::KeptAsCheck);
    let frames = [(0, structure(1e-6), label(-8.0))];
    assert_eq!(store.import(dft.hash, "x", &frames, 30_001).await.unwrap().checks, 1);
    assert_eq!(jobs(&store, structures[0]).await, [("dft".into(), JobState::Queued)], "it still waits");
    assert_eq!(exported(&store, &dft).await, [-1.0]);
    assert_eq!(label_next(&store, &dft, -1.5, 30_002).await, CompleteOutcome::Label);
    assert_eq!(exported(&store, &dft).await, [-1.5]);
    whole(&store).await;
}

#[tokio::test]
async fn another_protocol_supersedes_label_by_label() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 5, 2).await;
    let (dft, fine) = (protocol("dft"), protocol("fine"));
    // One is running, one failed, one waits.
    let under_way = lease(&store, &dft, 10).await.unwrap();
    let failing = lease(&store, &dft, 10).await.unwrap();
    store.fail(&failing, "crashed", "", 1, 11).await.unwrap();
    let all = store.relabellable(fine.hash).await.unwrap();
    assert_eq!(
        all.iter().map(|one| (one.content, one.job)).collect::<Vec<_>>(),
        [(structures[0], None), (structures[1], None)]
    );
    assert_eq!(store.unlabelled_under_other_protocols(fine.hash).await.unwrap(), 3);

    for expected in [RelabelCounts { relabelling: 2, moved: 3 }, RelabelCounts::default()] {
        assert_eq!(change_to(&store, &fine, &structures).await, expected, "asking twice is asking once");
        assert_eq!(store.protocol_in_force().await.unwrap().unwrap(), fine);
        whole(&store).await;
    }
    assert_eq!(store.campaign().await.unwrap().configuration_in_force, "{\"new\":1}");
    assert_eq!(store.metadata("label_method").await.unwrap().unwrap(), "how fine is made");
    assert!(store.is_in_force(fine.hash).await.unwrap() && !store.is_in_force(dft.hash).await.unwrap());
    // The running one is no longer needed, and nothing starts under the old protocol.
    assert!(!store.renew(&under_way, 210, 10).await.unwrap());
    assert_eq!(store.lease_status(&under_way).await.unwrap(), LeaseStatus::Over);
    assert_eq!(store.complete(&under_way, &label(-7.0), 211).await.unwrap(), CompleteOutcome::KeptAsCheck);
    assert!(lease(&store, &dft, 220).await.is_none());
    let old = ("dft".to_owned(), JobState::Labelled);
    assert_eq!(jobs(&store, structures[0]).await, [old.clone(), ("fine".into(), JobState::Queued)]);
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.queued, labels.labelled, labels.failed, labels.relabelling), (5, 2, 0, 2));
    assert_eq!(exported(&store, &dft).await, [-1.0, -2.0]);

    // The first is labelled under the new protocol, the second fails.
    assert_eq!(label_next(&store, &fine, -1.5, 300).await, CompleteOutcome::Label);
    let in_vain = lease(&store, &fine, 310).await.unwrap();
    assert_eq!(store.fail(&in_vain, "crashed", "", 1, 311).await.unwrap(), FailOutcome::Failed);
    let superseded = ("dft".to_owned(), JobState::Superseded);
    assert_eq!(jobs(&store, structures[0]).await, [superseded, ("fine".into(), JobState::Labelled)]);
    assert_eq!(jobs(&store, structures[1]).await, [old, ("fine".into(), JobState::Failed)]);
    let expected = [(LabelStatus::Superseded, -1.0, "dft".into()), (LabelStatus::Label, -1.5, "fine".into())];
    assert_eq!(history(&store, structures[0]).await, expected);
    assert_eq!((exported(&store, &dft).await, exported(&store, &fine).await), (vec![-2.0], vec![-1.5]));
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.labelled, labels.failed, labels.relabelling, labels.relabel_failed), (2, 1, 0, 1));
    whole(&store).await;

    // Those without a label get their first under the new protocol; the failed one is requested again.
    for energy in [-3.0, -4.0, -5.0] {
        assert_eq!(label_next(&store, &fine, energy, 400).await, CompleteOutcome::Label);
    }
    assert_eq!(relabel(&store, &structures, false).await, RELABELLING);
    assert_eq!(label_next(&store, &fine, -2.5, 500).await, CompleteOutcome::Label);
    assert_eq!(exported(&store, &dft).await, [0.0; 0]);
    assert_eq!(exported(&store, &fine).await, [-1.5, -2.5, -3.0, -4.0, -5.0]);
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.queued, labels.labelled, labels.failed, labels.relabel_failed), (0, 5, 0, 0));
    whole(&store).await;
}

#[tokio::test]
async fn a_campaign_may_return_to_its_first_protocol() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 3, 2).await;
    let (dft, fine) = (protocol("dft"), protocol("fine"));
    change_to(&store, &fine, &structures).await;
    assert_eq!(label_next(&store, &fine, -1.5, 300).await, CompleteOutcome::Label);
    // The second waits for its second label, the third for its first.
    assert_eq!(change_to(&store, &dft, &structures).await.relabelling, 1);
    whole(&store).await;
    assert_eq!(
        jobs(&store, structures[1]).await,
        [("dft".into(), JobState::Labelled), ("fine".into(), JobState::Superseded)]
    );
    for energy in [-1.0, -3.0] {
        assert_eq!(label_next(&store, &dft, energy, 400).await, CompleteOutcome::Label);
    }
    assert!(lease(&store, &dft, 500).await.is_none() && lease(&store, &fine, 500).await.is_none());
    assert_eq!(exported(&store, &dft).await, [-1.0, -2.0, -3.0]);
    assert_eq!(exported(&store, &fine).await, [0.0; 0]);
    let expected = [
        (LabelStatus::Superseded, -1.0, "dft".into()),
        (LabelStatus::Label, -1.0, "dft".into()),
        (LabelStatus::Superseded, -1.5, "fine".into()),
    ];
    assert_eq!(history(&store, structures[0]).await, expected);
    whole(&store).await;
}

#[tokio::test]
async fn dropped_jobs_are_not_relabelled() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 1, 1).await;
    let fine = protocol("fine");
    change_to(&store, &fine, &structures).await;
    let lease = lease(&store, &fine, 300).await.unwrap();
    let name = store.drop_job("0.0.1", 301).await.unwrap();
    assert_eq!(store.complete(&lease, &label(-1.5), 302).await.unwrap(), CompleteOutcome::KeptAsCheck);
    assert_eq!(relabel(&store, &structures, true).await, RelabelCounts::default());
    whole(&store).await;
    // Requested again, it waits for the new label.
    store.retry_job(&name, 303).await.unwrap();
    assert_eq!(label_next(&store, &fine, -1.6, 304).await, CompleteOutcome::Label);
    let expected = [
        (LabelStatus::Superseded, -1.0, "dft".into()),
        (LabelStatus::Check, -1.5, "fine".into()),
        (LabelStatus::Label, -1.6, "fine".into()),
    ];
    assert_eq!(history(&store, structures[0]).await, expected);
    whole(&store).await;
}

#[tokio::test]
async fn an_imported_label_may_be_superseded_or_satisfy_a_request() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 2, 0).await;
    let (dft, fine) = (protocol("dft"), protocol("fine"));
    let import = async |protocol: &Protocol, step: f64, energy: f64| {
        let frames = [(0, structure(1e-6 * step), label(energy))];
        store.import(protocol.hash, "old.extxyz", &frames, 50).await.unwrap()
    };
    import(&dft, 1.0, -1.0).await;
    import(&dft, 2.0, -2.0).await;
    assert_eq!(change_to(&store, &fine, &structures).await.relabelling, 2);
    assert_eq!(label_next(&store, &fine, -1.5, 300).await, CompleteOutcome::Label);
    assert_eq!(import(&fine, 2.0, -2.5).await.labels, 1);
    assert!(lease(&store, &fine, 400).await.is_none());
    assert_eq!((exported(&store, &dft).await, exported(&store, &fine).await), (vec![], vec![-1.5, -2.5]));
    let first = store.labels_of(structures[0]).await.unwrap().remove(0);
    assert_eq!(first.protocol, dft);
    assert!(matches!(first.record.source, LabelSource::Import { .. }));
    whole(&store).await;
}

#[tokio::test]
async fn two_protocols_cannot_share_a_name() {
    let database = TestDatabase::new();
    let (store, structures) = campaign_with(&database, 1, 1).await;
    let mut other = protocol("other");
    other.name = "dft".into();
    let new = NewProtocol { protocol: &other, configuration: "{}", changes: &[], notes: &[] };
    let order =
        RelabelRequest { structures: &structures, include_current: false, reason: "", protocol: Some(new) };
    assert!(matches!(store.relabel(&order, 1).await, Err(StoreError::ProtocolName(_))));
    assert_eq!(store.protocol_in_force().await.unwrap().unwrap(), protocol("dft"));
    assert_eq!(store.status().await.unwrap().labels.relabelling, 0, "all or nothing");
}
