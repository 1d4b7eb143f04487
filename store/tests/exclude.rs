//! Excluding labels by hand and including them again.

use serde_json::json;
use store::{
    Commit, CompleteOutcome, ExclusionChange, ExportFilter, ExportRow, ExportSource, Fate, JobState,
    LabelMark, LabelStatus, Lease, ListOrder, ListedCandidate, Protocol, RelabelRequest, Store, StoreError,
    WalkRecord,
};
use wire::messages::DeclineReason;
use wire::{ContentHash, Origin};

use crate::common::*;

async fn lease(store: &Store, now: i64) -> Lease {
    store.lease(protocol("dft").hash, "host/a", now, 10).await.unwrap().unwrap()
}

/// Labelled candidates with energies −1, −2, … Returns their names.
async fn labelled(database: &TestDatabase, number: u64) -> (Store, Vec<String>) {
    let store = database.create().await.with_caller_clock();
    let names = accept(&store, number).await;
    let walk = WalkRecord { accepted: number as u32, ..walk(0, 1) };
    store.commit(&Commit { walks: vec![walk], ..Commit::default() }).await.unwrap();
    for energy in 1..=number {
        let lease = lease(&store, 0).await;
        store.complete(&lease, &label(-(energy as f64)), 1).await.unwrap();
    }
    (store, names)
}

fn names(ids: &[&str]) -> Vec<String> {
    ids.iter().map(|id| (*id).to_owned()).collect()
}

fn content(step: u64) -> ContentHash {
    ContentHash::from_structure(&structure(1e-6 * step as f64))
}

/// Energies in an export, by protocol.
async fn exported(store: &Store, protocol: &Protocol) -> Vec<f64> {
    let filter = ExportFilter { protocol: protocol.hash, biased: true, control: true, imported: true };
    let rows = store.labelled(&filter, None, 100).await.unwrap();
    let mark = |row: &ExportRow| LabelMark {
        cursor: row.cursor,
        walk: match &row.source {
            ExportSource::Candidate { seed_structure_name, origin, .. } => {
                Some((seed_structure_name.clone(), *origin))
            }
            ExportSource::Import { .. } => None,
        },
        energy: row.label.energy,
    };
    let expected: Vec<_> = rows.iter().map(mark).collect();
    assert_eq!(store.label_marks(protocol.hash).await.unwrap(), expected);
    rows.iter().map(|row| row.label.energy).collect()
}

/// Status, energy and reason of exclusion of every label of a structure.
async fn history(store: &Store, structure: ContentHash) -> Vec<(LabelStatus, f64, Option<String>)> {
    let labels = store.labels_of(structure).await.unwrap().into_iter().map(|label| label.record);
    labels.map(|record| (record.status, record.label.energy, record.excluded.map(|e| e.reason))).collect()
}

async fn whole(store: &Store) {
    let found = store.check(|_, _| {}).await.unwrap();
    assert_eq!(found.iter().map(|finding| finding.what.clone()).collect::<Vec<_>>(), [""; 0]);
}

fn change(id: &str, changed: bool, excluded: Option<&str>) -> ExclusionChange {
    let excluded = excluded.map(str::to_owned);
    ExclusionChange { id: id.into(), protocols: vec!["dft".into()], changed, excluded }
}

#[tokio::test]
async fn an_excluded_label_counts_nowhere_until_it_is_included_again() {
    let database = TestDatabase::new();
    let (store, candidates) = labelled(&database, 3).await;
    let dft = protocol("dft");
    let second = candidates[1].as_str();
    let ids = names(&["0.0.2"]);
    let expected = [change(second, true, Some("it has a hole"))];
    assert_eq!(store.exclude(&ids, "it has a hole", 100).await.unwrap(), expected);
    // Repeating it changes nothing; the first reason stays.
    let expected = [change(second, false, Some("it has a hole"))];
    assert_eq!(store.exclude(&ids, "another", 200).await.unwrap(), expected);

    assert_eq!(exported(&store, &dft).await, [-1.0, -3.0]);
    let energies = store.labelled_energies(dft.hash, 0, 100).await.unwrap();
    assert_eq!(energies.iter().map(|e| (e.model, e.label)).collect::<Vec<_>>(), [(-8.5, -1.0), (-8.5, -3.0)]);
    assert_eq!(store.labelled_after(dft.hash, 0, 9).await.unwrap().len(), 2);
    let collected = store.collected(Some(dft.hash), 0, 9).await.unwrap();
    let forces: Vec<_> = collected.iter().map(|row| row.label_forces.is_some()).collect();
    assert_eq!(forces, [true, false, true]);
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.labelled, labels.excluded), (3, 1));
    let shown = store.queue_show(second).await.unwrap();
    assert_eq!(shown.job.excluded.as_deref(), Some("it has a hole"));
    assert_eq!(shown.energies, [(LabelStatus::Excluded, -2.0)]);
    let listed = store.queue_list(Some(JobState::Labelled), 9, 0).await.unwrap();
    assert_eq!(listed.iter().filter(|job| job.excluded.is_some()).count(), 1);
    let table = store.list_candidates(ListOrder::Decision, false, None, 9).await.unwrap();
    let energies = |table: &[ListedCandidate]| table.iter().map(|line| line.energy).collect::<Vec<_>>();
    assert_eq!(energies(&table), [Some(-1.0), None, Some(-3.0)]);
    let queue = store.list_queue(JobState::Labelled, None, 9).await.unwrap();
    assert_eq!(energies(&queue), energies(&table));
    assert_eq!(table[0].max_force, Some(label(-1.0).max_force()));
    let all = store.excluded().await.unwrap();
    assert_eq!((all.len(), all[0].id.as_str(), all[0].exclusion.time), (1, second, 100));
    whole(&store).await;
    // Its job is finished, so it is not labelled again automatically.
    assert!(store.lease(dft.hash, "host/a", 300, 10).await.unwrap().is_none());

    assert_eq!(store.include(&ids, 400).await.unwrap(), [change(second, true, None)]);
    assert_eq!(store.include(&ids, 500).await.unwrap(), [change(second, false, None)]);
    assert_eq!(exported(&store, &dft).await, [-1.0, -2.0, -3.0]);
    assert_eq!(history(&store, content(2)).await, [(LabelStatus::Label, -2.0, None)]);
    assert_eq!(store.status().await.unwrap().labels.excluded, 0);
    let operations = store.manual_operations(shown.job.job).await.unwrap();
    let kinds: Vec<_> =
        operations.iter().map(|done| (done.kind.as_str(), done.time, &done.detail["reason"])).collect();
    assert_eq!(kinds, [("exclude", 100, &json!("it has a hole")), ("include", 400, &json!(null))]);
    whole(&store).await;
}

#[tokio::test]
async fn either_all_named_structures_are_excluded_or_none() {
    let database = TestDatabase::new();
    let (store, candidates) = labelled(&database, 2).await;
    let covered = candidate(0, 7, Origin::Biased, Fate::Declined(DeclineReason::Covered));
    let waiting = candidate(0, 8, Origin::Biased, Fate::Accepted);
    store.commit(&commit_of(vec![covered.clone(), waiting.clone()])).await.unwrap();
    for (wrong, why) in
        [(name_of(&covered), "it was declined"), (name_of(&waiting), "its label job is queued")]
    {
        let ids = [candidates[0].clone(), wrong.clone()];
        let error = store.exclude(&ids, "bad", 1).await.unwrap_err().to_string();
        assert_eq!(error, format!("{wrong} has no label: {why}"));
    }
    for wrong in ["99.0.1", "import-1", "nonsense"] {
        let ids = [candidates[0].clone(), wrong.to_owned()];
        let error = store.exclude(&ids, "bad", 1).await.unwrap_err();
        assert!(
            matches!(error, StoreError::UnknownCandidate { .. } | StoreError::UnknownImport { .. }),
            "{error}"
        );
    }
    assert_eq!(store.status().await.unwrap().labels.excluded, 0);
    // Naming it twice counts once.
    let ids = [candidates[0].clone(), "0.0.1".to_owned(), "0.0.2".to_owned()];
    let changes = store.exclude(&ids, "bad", 1).await.unwrap();
    assert_eq!(
        changes.iter().map(|change| &change.id).collect::<Vec<_>>(),
        candidates.iter().collect::<Vec<_>>()
    );
    assert_eq!(exported(&store, &protocol("dft")).await, [0.0; 0]);
}

#[tokio::test]
async fn only_a_requested_label_replaces_an_excluded_one() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    let (names, dft) = (accept(&store, 1).await, protocol("dft"));
    let walk = WalkRecord { accepted: 1, ..walk(0, 1) };
    store.commit(&Commit { walks: vec![walk], ..Commit::default() }).await.unwrap();
    let late = lease(&store, 0).await;
    let first = lease(&store, 20_000).await;
    store.complete(&first, &label(-1.0), 20_001).await.unwrap();
    store.exclude(&names, "bad", 20_002).await.unwrap();
    assert_eq!(store.complete(&late, &label(-9.0), 20_003).await.unwrap(), CompleteOutcome::KeptAsCheck);
    let frames = [(0, structure(1e-6), label(-8.0))];
    assert_eq!(store.import(dft.hash, "x", &frames, 20_004).await.unwrap().checks, 1);
    assert_eq!(exported(&store, &dft).await, [0.0; 0]);
    whole(&store).await;

    let order =
        RelabelRequest { structures: &[content(1)], include_current: true, reason: "better", protocol: None };
    assert_eq!(store.relabel(&order, 20_005).await.unwrap().relabelling, 1);
    whole(&store).await;
    // The earlier label stays excluded until the new one arrives, even if it never does.
    let failing = lease(&store, 20_006).await;
    store.fail(&failing, "crashed", "", 1, 20_007).await.unwrap();
    assert_eq!(store.queue_show(&names[0]).await.unwrap().job.state, JobState::Labelled);
    assert_eq!(store.status().await.unwrap().labels.excluded, 1);
    store.relabel(&order, 20_008).await.unwrap();
    let again = lease(&store, 20_009).await;
    assert_eq!(store.complete(&again, &label(-1.5), 20_010).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(exported(&store, &dft).await, [-1.5]);
    let bad = Some("bad".to_owned());
    let (superseded, check) =
        ((LabelStatus::Superseded, -1.0, bad), |energy| (LabelStatus::Check, energy, None));
    let expected = [superseded, check(-9.0), check(-8.0), (LabelStatus::Label, -1.5, None)];
    assert_eq!(history(&store, content(1)).await, expected);
    // The new label is not excluded.
    assert_eq!(store.include(&names, 20_011).await.unwrap(), [change(&names[0], false, None)]);
    assert_eq!(exported(&store, &dft).await, [-1.5]);
    whole(&store).await;
}

#[tokio::test]
async fn imported_structures_have_labels_to_exclude() {
    let database = TestDatabase::new();
    let (store, _) = labelled(&database, 1).await;
    let dft = protocol("dft");
    let frames = [(0, structure(0.1), label(-5.0)), (1, structure(0.2), label(-6.0))];
    store.import(dft.hash, "known.extxyz", &frames, 10).await.unwrap();
    let ids = names(&["import-2"]);
    assert_eq!(store.exclude(&ids, "bad", 20).await.unwrap(), [change("import-2", true, Some("bad"))]);
    assert_eq!(exported(&store, &dft).await, [-1.0, -5.0]);
    assert_eq!(store.excluded().await.unwrap()[0].id, "import-2");
    // Identical results change nothing.
    assert_eq!(store.import(dft.hash, "known.extxyz", &frames, 30).await.unwrap().known, 2);
    assert_eq!(exported(&store, &dft).await, [-1.0, -5.0]);
    store.include(&ids, 40).await.unwrap();
    assert_eq!(exported(&store, &dft).await, [-1.0, -5.0, -6.0]);
    whole(&store).await;
}

/// What was excluded by hand is not calculated again without a request.
#[tokio::test]
async fn a_job_of_a_structure_with_an_excluded_label_is_done() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    let (names, dft) = (accept(&store, 1).await, protocol("dft"));
    let state = async |name: &str| store.queue_show(name).await.unwrap().job.state;
    // Its job was dropped before the result came.
    let first = lease(&store, 0).await;
    store.drop_job(&names[0], 1).await.unwrap();
    assert_eq!(store.complete(&first, &label(-1.0), 2).await.unwrap(), CompleteOutcome::Label);
    store.exclude(&names, "bad", 3).await.unwrap();
    assert_eq!(state(&names[0]).await, JobState::Dropped);
    store.retry_job(&names[0], 4).await.unwrap();
    assert_eq!(state(&names[0]).await, JobState::Labelled);
    // The label was imported before a walk came to the structure.
    store.import(dft.hash, "x", &[(0, structure(2e-6), label(-2.0))], 5).await.unwrap();
    store.exclude(&["import-1".to_owned()], "bad", 6).await.unwrap();
    let found = candidate(0, 2, Origin::Biased, Fate::Accepted);
    store.commit(&commit_of(vec![found.clone()])).await.unwrap();
    assert_eq!(state(&name_of(&found)).await, JobState::Labelled);
    assert!(store.lease(dft.hash, "host/a", 7, 10).await.unwrap().is_none());
}
