//! Two magnetic states of one structure: the lower one is proposed, or becomes the label.

use serde_json::{Value, json};
use store::records::LabelDetails;
use store::{
    CalculationRecord, Commit, CompleteOutcome, ExportFilter, Label, LabelStatus, Lease, LowerStateRule,
    NewProtocol, OnLowerState, RelabelRequest, Store, StoreError, WalkRecord,
};

use crate::common::*;

const SUPERSEDE: LowerStateRule =
    LowerStateRule { min_difference: 0.001, on_lower_state: OnLowerState::Supersede };

/// A campaign with this number of candidates that wait for labels, and their names.
async fn campaign_with(database: &TestDatabase, candidates: u64) -> (Store, Vec<String>) {
    let store = database.create().await.with_caller_clock();
    let names = accept(&store, candidates).await;
    let walk = WalkRecord { accepted: candidates as u32, ..walk(0, 1) };
    store.commit(&Commit { walks: vec![walk], ..Commit::default() }).await.unwrap();
    (store, names)
}

async fn lease(store: &Store, now: i64) -> Lease {
    store.lease(protocol("dft").hash, "host/a", now, 10).await.unwrap().unwrap()
}

/// Leases the next job and labels it, with a calculation that ran with these adjustments.
async fn label_with(store: &Store, adjustments: Option<&str>, energy: f64, now: i64) -> CompleteOutcome {
    let lease = lease(store, now).await;
    let made = CalculationRecord { remedies: adjustments.map(str::to_owned), ..Default::default() };
    store.record_calculation(&lease, &format!("calculation {now}"), &made).await.unwrap();
    store.complete(&lease, &magnetic(energy), now + 1).await.unwrap()
}

/// A label with a magnetisation.
fn magnetic(energy: f64) -> Label {
    let details = LabelDetails { magnetisation: Some(-2.0 * energy), ..LabelDetails::default() };
    Label { details, ..label(energy) }
}

async fn relabel(store: &Store, names: &[String], now: i64) {
    let mut structures = Vec::new();
    for name in names {
        structures.push(store.candidate(name).await.unwrap().unwrap().block.view().id().content);
    }
    let order =
        RelabelRequest { structures: &structures, include_current: true, reason: "doubtful", protocol: None };
    store.relabel(&order, now).await.unwrap();
}

/// Status and energy of every label of a candidate, and why it was superseded.
async fn history(store: &Store, name: &str) -> Vec<(LabelStatus, f64, Option<String>)> {
    let content = store.candidate(name).await.unwrap().unwrap().block.view().id().content;
    let labels = store.labels_of(content).await.unwrap().into_iter().map(|label| label.record);
    labels
        .map(|record| (record.status, record.label.energy, record.superseded.map(|how| how.reason)))
        .collect()
}

async fn exported(store: &Store) -> Vec<f64> {
    let filter = ExportFilter { protocol: protocol("dft").hash, biased: true, control: true, imported: true };
    let rows = store.labelled(&filter, None, 100).await.unwrap();
    rows.iter().map(|row| row.label.energy).collect()
}

/// Details of the operations of this kind.
async fn operations(store: &Store) -> Vec<Value> {
    let all = store.operations(0, 1000).await.unwrap().into_iter();
    all.filter(|operation| operation.kind == "lower_state").map(|operation| operation.detail).collect()
}

async fn whole(store: &Store) {
    let found = store.check(|_, _| {}).await.unwrap();
    assert_eq!(found.iter().map(|finding| finding.what.as_str()).collect::<Vec<_>>(), [""; 0]);
}

#[tokio::test]
async fn a_label_says_with_what_its_calculation_ran_also_after_a_takeover() {
    let database = TestDatabase::new();
    let (store, names) = campaign_with(&database, 1).await;
    let first = lease(&store, 0).await;
    let made = CalculationRecord {
        remedies: Some("slower_mixing,other_moments".into()),
        difference: Some("- 1\n+ 0.5".into()),
        ..CalculationRecord::default()
    };
    store.record_calculation(&first, "pid 7", &made).await.unwrap();
    // The labeller is killed. The next one takes over its calculation without adjustments of its own.
    assert_eq!(store.release_all("host", 1).await.unwrap(), 1);
    let second = lease(&store, 2).await;
    assert_eq!(second.earlier_calculations, ["pid 7"]);
    store.record_calculation(&second, "pid 7", &CalculationRecord::default()).await.unwrap();
    assert_eq!(store.complete(&second, &label(-1.0), 3).await.unwrap(), CompleteOutcome::Label);
    let job = store.queue_show(&names[0]).await.unwrap();
    assert_eq!(job.attempts_made[1].made.remedies, made.remedies);
    assert_eq!(job.attempts_made[1].made.difference, made.difference);
    assert_eq!(job.retry_adjustments[0], ["slower_mixing", "other_moments"]);
    let content = store.candidate(&names[0]).await.unwrap().unwrap().block.view().id().content;
    let details = store.labels_of(content).await.unwrap().remove(0).record.label.details;
    assert_eq!(details.retry_adjustments, ["slower_mixing", "other_moments"]);
    assert!(details.has_changed_moments());
    // Another calculation of the job has its own.
    relabel(&store, &names, 10).await;
    assert_eq!(label_with(&store, Some("more_steps"), -1.0, 11).await, CompleteOutcome::Label);
    let details = store.labels_of(content).await.unwrap().remove(1).record.label.details;
    assert_eq!(
        (details.retry_adjustments.as_slice(), details.has_changed_moments()),
        (&["more_steps".to_owned()][..], false)
    );
    whole(&store).await;
}

#[tokio::test]
async fn the_lower_of_two_states_is_proposed_and_taken_by_hand() {
    let database = TestDatabase::new();
    let (store, names) = campaign_with(&database, 3).await;
    for (energy, now) in [(-1.0, 0), (-2.0, 10), (-3.0, 20)] {
        label_with(&store, None, energy, now).await;
    }
    relabel(&store, &names, 30).await;
    // Higher than before; the same state; lower than before.
    for (adjustments, energy, now) in
        [(Some("other_moments"), -0.9, 40), (None, -1.9985, 50), (None, -3.1, 60)]
    {
        assert_eq!(label_with(&store, adjustments, energy, now).await, CompleteOutcome::Label);
    }
    assert_eq!(exported(&store).await, [-0.9, -1.9985, -3.1]);
    assert_eq!(store.status().await.unwrap().labels.lower_states, 1);
    let found = store.lower_states().await.unwrap();
    assert_eq!(found.len(), 1);
    let state = &found[0];
    assert_eq!((state.id.as_str(), state.protocol.as_str(), state.atoms), (names[0].as_str(), "dft", 2));
    assert!((state.difference_per_atom + 0.05).abs() < 1e-12, "{state:?}");
    assert_eq!((state.label.energy_per_atom, state.lower.energy_per_atom), (-0.45, -0.5));
    assert_eq!((state.label.magnetisation, state.lower.magnetisation), (Some(1.8), Some(2.0)));
    assert_eq!((state.label.changed_moments, state.lower.changed_moments), (true, false));
    assert_eq!(
        (state.label.source.as_str(), state.lower.source.as_str()),
        ("attempt 2 of job 1", "attempt 1 of job 1")
    );
    assert_eq!((state.label.status, state.lower.status), (LabelStatus::Label, LabelStatus::Superseded));

    // All or nothing.
    let unknown = [names[0].clone(), "99.0.1".to_owned()];
    assert!(matches!(
        store.take_lower_states(Some(&unknown), None, 70).await,
        Err(StoreError::UnknownCandidate { .. })
    ));
    assert_eq!(store.status().await.unwrap().labels.lower_states, 1);
    let ids = [names[0].clone(), "0.0.1".to_owned(), names[1].clone()];
    let changes = store.take_lower_states(Some(&ids), Some("seen in the DOS"), 70).await.unwrap();
    assert_eq!(
        changes.iter().map(|change| (change.id.as_str(), change.taken.len())).collect::<Vec<_>>(),
        [(names[0].as_str(), 1), (names[1].as_str(), 0)]
    );
    assert_eq!(changes[0].taken[0], *state);
    let why = Some("a lower state: −0.05 eV/atom (seen in the DOS)".to_owned());
    assert_eq!(
        history(&store, &names[0]).await,
        [(LabelStatus::Label, -1.0, None), (LabelStatus::Superseded, -0.9, why)]
    );
    assert_eq!(exported(&store).await, [-1.0, -1.9985, -3.1]);
    let logged = operations(&store).await;
    assert_eq!(
        (logged.len(), &logged[0]["by"], &logged[0]["candidate"]),
        (1, &json!("user"), &json!(names[0]))
    );
    assert_eq!(logged[0]["superseded_before"], json!({ "time": 41, "reason": "doubtful" }));
    assert_eq!(logged[0]["higher"]["changed_moments"], true);
    assert_eq!(store.manual_operations(1).await.unwrap().len(), 1);
    assert_eq!(store.status().await.unwrap().labels.lower_states, 0);
    whole(&store).await;
    // Repeating it changes nothing.
    assert!(
        store
            .take_lower_states(Some(&ids), None, 80)
            .await
            .unwrap()
            .iter()
            .all(|change| change.taken.is_empty())
    );
    assert_eq!(store.take_lower_states(None, None, 80).await.unwrap(), []);
    assert_eq!(operations(&store).await.len(), 1);
}

#[tokio::test]
async fn excluded_and_dropped_results_are_no_states() {
    let database = TestDatabase::new();
    let (store, names) = campaign_with(&database, 3).await;
    for (energy, now) in [(-1.0, 0), (-2.0, 10)] {
        label_with(&store, None, energy, now).await;
    }
    // An excluded label that a requested one superseded does not return.
    store.exclude(&names[..1], "bad", 15).await.unwrap();
    relabel(&store, &names[..2], 20).await;
    for (energy, now) in [(-0.5, 30), (-1.5, 40)] {
        label_with(&store, None, energy, now).await;
    }
    let ids = |found: Vec<store::LowerState>| found.into_iter().map(|state| state.id).collect::<Vec<_>>();
    assert_eq!(ids(store.lower_states().await.unwrap()), [names[1].clone()]);
    // Neither does any for a label that is excluded itself.
    store.exclude(&names[1..2], "bad as well", 50).await.unwrap();
    assert_eq!(ids(store.lower_states().await.unwrap()), [""; 0]);
    for (name, why) in [(&names[1], "its label is excluded"), (&names[2], "its label job is queued")] {
        let error = store.take_lower_states(Some(std::slice::from_ref(name)), None, 60).await.unwrap_err();
        assert_eq!(error.to_string(), format!("{name} has no label: {why}"));
    }
    store.include(&names[1..2], 70).await.unwrap();
    assert_eq!(store.lower_states().await.unwrap().len(), 1);
    // A structure that is dropped while it waits for another label.
    relabel(&store, &names[1..2], 80).await;
    store.drop_job(&names[1], 81).await.unwrap();
    assert_eq!(
        (store.lower_states().await.unwrap(), store.status().await.unwrap().labels.lower_states),
        (vec![], 0)
    );
    whole(&store).await;
}

#[tokio::test]
async fn a_lower_result_supersedes_the_label_when_it_arrives() {
    let database = TestDatabase::new();
    let (store, names) = campaign_with(&database, 1).await;
    store.set_lower_state_rule(&SUPERSEDE).await.unwrap();
    assert_eq!(store.lower_state_rule().await.unwrap(), SUPERSEDE);
    let late = lease(&store, 0).await;
    assert_eq!(label_with(&store, Some("other_moments"), -1.0, 20_000).await, CompleteOutcome::Label);
    assert_eq!(store.complete(&late, &magnetic(-1.5), 30_000).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(
        store.complete(&late, &magnetic(-1.5), 30_001).await.unwrap(),
        CompleteOutcome::Label,
        "brought twice"
    );
    let superseded = |energy, difference: &str| {
        (LabelStatus::Superseded, energy, Some(format!("a lower state: −{difference} eV/atom")))
    };
    assert_eq!(
        history(&store, &names[0]).await,
        [superseded(-1.0, "0.25"), (LabelStatus::Label, -1.5, None)]
    );
    whole(&store).await;

    // Imported: the same state is a check, a lower one is the label.
    let dft = protocol("dft").hash;
    let import = async |energy: f64, now: i64| {
        store.import(dft, "x", &[(0, structure(1e-6), label(energy))], now).await.unwrap()
    };
    assert_eq!(import(-1.501, 40_000).await.checks, 1);
    assert_eq!(import(-1.6, 40_001).await.labels, 1);
    assert_eq!(import(-1.6, 40_002).await.known, 1);
    assert_eq!(exported(&store).await, [-1.6]);
    let states = [
        superseded(-1.0, "0.25"),
        superseded(-1.5, "0.05"),
        (LabelStatus::Check, -1.501, None),
        (LabelStatus::Label, -1.6, None),
    ];
    assert_eq!(history(&store, &names[0]).await, states);
    let logged = operations(&store).await;
    assert_eq!(logged.iter().map(|detail| &detail["by"]).collect::<Vec<_>>(), ["label.on_lower_state"; 2]);
    assert_eq!(logged[1]["label"]["source"], "x, frame 0");
    assert_eq!(store.manual_operations(1).await.unwrap(), [], "it is not a manual operation");
    whole(&store).await;
}

#[tokio::test]
async fn a_requested_label_of_a_higher_state_is_kept_as_a_check() {
    let database = TestDatabase::new();
    let (store, names) = campaign_with(&database, 2).await;
    store.set_lower_state_rule(&SUPERSEDE).await.unwrap();
    for (energy, now) in [(-1.0, 0), (-2.0, 10)] {
        label_with(&store, None, energy, now).await;
    }
    // The user excludes the second.
    store.exclude(&names[1..], "bad", 15).await.unwrap();
    relabel(&store, &names, 20).await;
    assert_eq!(label_with(&store, Some("other_moments"), -0.5, 30).await, CompleteOutcome::KeptAsCheck);
    assert_eq!(label_with(&store, None, -1.5, 40).await, CompleteOutcome::Label);
    assert_eq!(
        history(&store, &names[0]).await,
        [(LabelStatus::Label, -1.0, None), (LabelStatus::Check, -0.5, None)]
    );
    let requested = (LabelStatus::Superseded, -2.0, Some("doubtful".to_owned()));
    assert_eq!(history(&store, &names[1]).await, [requested, (LabelStatus::Label, -1.5, None)]);
    assert_eq!(exported(&store).await, [-1.0, -1.5]);
    let labels = store.status().await.unwrap().labels;
    assert_eq!(
        (labels.labelled, labels.queued, labels.relabelling, labels.lower_states),
        (2, 0, 0, 0),
        "the request is met"
    );
    assert_eq!(operations(&store).await[0]["higher"]["source"], "attempt 2 of job 1");
    whole(&store).await;
}

#[tokio::test]
async fn a_lower_state_of_an_earlier_time_returns_with_its_protocol() {
    let database = TestDatabase::new();
    let (store, names) = campaign_with(&database, 1).await;
    store.set_lower_state_rule(&SUPERSEDE).await.unwrap();
    label_with(&store, None, -1.0, 0).await;
    let content = store.candidate(&names[0]).await.unwrap().unwrap().block.view().id().content;
    let (dft, fine) = (protocol("dft"), protocol("fine"));
    let change_to = async |to: &store::Protocol, now: i64| {
        let new = NewProtocol { protocol: to, configuration: "{}", changes: &[], notes: &[] };
        let order = RelabelRequest {
            structures: &[content],
            include_current: false,
            reason: "cutoff",
            protocol: Some(new),
        };
        store.relabel(&order, now).await.unwrap();
    };
    change_to(&fine, 10).await;
    let lease = store.lease(fine.hash, "host/a", 20, 10).await.unwrap().unwrap();
    assert_eq!(
        store.complete(&lease, &magnetic(-0.2), 21).await.unwrap(),
        CompleteOutcome::Label,
        "protocols are not compared"
    );
    change_to(&dft, 30).await;
    assert_eq!(label_with(&store, None, -0.5, 40).await, CompleteOutcome::KeptAsCheck);
    let gone = (LabelStatus::Superseded, -0.2, Some("cutoff".to_owned()));
    assert_eq!(
        history(&store, &names[0]).await,
        [(LabelStatus::Label, -1.0, None), (LabelStatus::Check, -0.5, None), gone]
    );
    assert_eq!(exported(&store).await, [-1.0]);
    whole(&store).await;
}
