//! Creating and opening campaigns; committed data are read back.

use store::{
    CandidateRecord, Commit, ComponentRecord, Decision, Fate, ProcessRecord, Store, StoreError, WalkRecord,
};
use wire::messages::{DeclineReason, WalkProgress};
use wire::{CellConditions, ConstantPressure, Origin, WalkConditions, WalkId};

use crate::common::*;

#[tokio::test]
async fn a_campaign_is_created_once_and_opened_often() {
    let database = TestDatabase::new();
    let error = Store::open(database.location()).await.unwrap_err();
    assert!(matches!(error, StoreError::Missing { .. }), "{error}");
    database.create().await.close().await;
    let error = Store::create(database.location(), &campaign(), &[], 0).await.unwrap_err();
    assert!(matches!(error, StoreError::Exists { .. } | StoreError::Occupied { .. }), "{error}");

    let store = database.open().await;
    assert_eq!(store.campaign().await.unwrap(), campaign());
    let seed_structures = store.seed_structures().await.unwrap();
    assert_eq!((seed_structures.len(), seed_structures[0].name.as_str()), (1, "diamond"));
    assert_eq!(seed_structures[0].structure, structure(0.0));
    assert_eq!(store.protocols().await.unwrap(), [protocol("dft")]);
    let change = serde_json::json!({ "key": "walkers", "before": 1, "after": 2 });
    store.set_configuration_in_force("{\"walkers\":2}", std::slice::from_ref(&change), 7).await.unwrap();
    assert_eq!(store.campaign().await.unwrap().configuration_in_force, "{\"walkers\":2}");
    let operations = store.operations(0, 10).await.unwrap();
    let kinds: Vec<_> = operations.iter().map(|o| (o.time, o.kind.as_str())).collect();
    assert_eq!(kinds, [(0, "created"), (0, "protocol"), (7, "configuration")]);
    assert_eq!(operations[2].detail, change);
}

fn mixed_commit() -> Commit {
    let mut declined = candidate(1, 20, Origin::Biased, Fate::Declined(DeclineReason::Covered));
    declined.keep_features = false;
    let candidates = vec![
        candidate(0, 10, Origin::Biased, Fate::Accepted),
        declined,
        candidate(1, 30, Origin::Biased, Fate::Declined(DeclineReason::TooClose)),
        candidate(2, 10, Origin::Control, Fate::Accepted),
    ];
    Commit {
        components: vec![
            ComponentRecord { element: 0, slot: 4, bytes: vec![1, 2] },
            ComponentRecord { element: 0, slot: 4, bytes: vec![3, 4] },
        ],
        walks: vec![walk(0, 1), walk(1, 1)],
        values: vec![("round".into(), "1".into())],
        ..commit_of(candidates)
    }
}

#[tokio::test]
async fn committed_data_is_read_back() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let commit = mixed_commit();
    assert_eq!(store.commit(&commit).await.unwrap(), 1..5);
    store.close().await;

    let store = database.open().await;
    assert_eq!(store.load_walks().await.unwrap(), commit.walks);
    assert_eq!(store.load_components().await.unwrap(), commit.components[1..]);
    assert_eq!(store.values().await.unwrap(), commit.values);
    let content = |record: &CandidateRecord| record.block.view().id().content;
    assert_eq!(store.known_hashes().await.unwrap(), [content(&commit.candidates[0])]);
    for (record, decision) in commit.candidates.iter().zip(1..) {
        let stored = store.candidate(&name_of(record)).await.unwrap().unwrap();
        assert_eq!(stored.decision, decision);
        assert_eq!(stored.block, record.block.without_features());
        assert_eq!((stored.fate, stored.seed_structure), (record.fate, 0));
        assert_eq!((&stored.selector, &stored.original), (&record.selector, &record.original));
        let features = record.keep_features.then(|| record.block.view().features.to_vec());
        assert_eq!(stored.features, features);
    }
    assert!(store.candidate("9f").await.unwrap().is_none());
    let third = store.candidates(2, true, 1).await.unwrap();
    assert_eq!(third, [store.candidate(&name_of(&commit.candidates[2])).await.unwrap().unwrap()]);

    let jobs = store.queue_list(None, 10, 0).await.unwrap();
    let names: Vec<_> = jobs.iter().map(|job| job.candidate.clone()).collect();
    assert_eq!(names, [name_of(&commit.candidates[0]), name_of(&commit.candidates[3])]);
    let decisions = store.decisions(2..=3).await.unwrap();
    assert_eq!(decisions.len(), 2);
    assert_eq!(decisions[0].kind, "declined");
    assert_eq!(decisions[0].detail, commit.decisions[1].detail);
    let line = store.decision_log_text().await.unwrap().lines().next().unwrap().to_owned();
    let id = name_of(&commit.candidates[0]);
    assert_eq!(
        line,
        format!(
            r#"{{"sequence":1,"round":1,"kind":"accepted","walk":0,"candidate":"{id}","mixture_version":10,"detail":{{"gamma":1.25,"text":"a \"quoted\" line\n"}}}}"#
        )
    );

    let restart = Commit {
        restart_mixture: true,
        components: vec![ComponentRecord { element: 1, slot: 0, bytes: vec![9] }],
        ..Commit::default()
    };
    assert_eq!(store.commit(&restart).await.unwrap(), 5..5);
    assert_eq!(store.load_components().await.unwrap(), restart.components);
}

#[tokio::test]
async fn a_contradictory_commit_leaves_nothing() {
    let database = TestDatabase::new();
    let store = database.create().await;
    store.commit(&mixed_commit()).await.unwrap();
    let log = store.decision_log_text().await.unwrap();

    let fresh = || candidate(0, 99, Origin::Biased, Fate::Accepted);
    let again = commit_of(vec![fresh(), candidate(0, 10, Origin::Biased, Fate::Accepted)]);
    assert!(matches!(store.commit(&again).await, Err(StoreError::DuplicateCandidate(_))));
    let twice = commit_of(vec![fresh(), fresh()]);
    assert!(matches!(store.commit(&twice).await, Err(StoreError::Inconsistent(_))));
    let mut undecided = commit_of(vec![fresh()]);
    undecided.decisions.clear();
    assert!(matches!(store.commit(&undecided).await, Err(StoreError::Inconsistent(_))));
    let mut missing = commit_of(vec![fresh()]);
    missing.candidates.clear();
    assert!(matches!(store.commit(&missing).await, Err(StoreError::Inconsistent(_))));
    let mut short = commit_of(vec![fresh()]);
    short.candidates[0].original.gamma.pop();
    assert!(matches!(store.commit(&short).await, Err(StoreError::Inconsistent(_))));

    assert_eq!(store.decision_log_text().await.unwrap(), log);
    assert!(store.candidate(&name_of(&fresh())).await.unwrap().is_none());
    assert_eq!(store.commit(&commit_of(vec![fresh()])).await.unwrap(), 5..6);
}

/// A walk interrupted during an assignment is committed without a decision.
#[tokio::test]
async fn a_checkpoint_is_kept_between_decisions() {
    let database = TestDatabase::new();
    let store = database.create().await;
    store.commit(&mixed_commit()).await.unwrap();
    let decisions = store.decision_log_text().await.unwrap();
    let mut paused = walk(0, 1);
    paused.progress.step = 150;
    paused.progress.gamma_max = f64::NAN;
    paused.checkpoint = Some(b"state".to_vec());
    store.commit(&Commit { walks: vec![paused], ..Commit::default() }).await.unwrap();
    let walks = store.load_walks().await.unwrap();
    assert_eq!((walks[0].progress.step, walks[0].checkpoint.as_deref()), (150, Some(&b"state"[..])));
    assert!(walks[0].progress.gamma_max.is_nan());
    assert_eq!(walks[1], walk(1, 1));
    assert_eq!(store.decision_log_text().await.unwrap(), decisions);
}

#[tokio::test]
async fn status_counts_everything_once() {
    let database = TestDatabase::new();
    let store = database.create().await;
    assert!(!store.status().await.unwrap().finished);
    store.commit(&mixed_commit()).await.unwrap();
    let dft = protocol("dft").hash;
    store.import(dft, "old.extxyz", &[(0, structure(7.0), label(-7.0))], 0).await.unwrap();
    let mut dead = std::process::Command::new("true").spawn().unwrap();
    dead.wait().unwrap();
    let process = |id: &str, pid| ProcessRecord {
        id: id.into(),
        kind: id.into(),
        pid,
        host: store::this_host(),
        started: 5,
        last_seen: 6,
        state: "running".into(),
        ..ProcessRecord::default()
    };
    store.upsert_process(&process("a", std::process::id())).await.unwrap();
    store.upsert_process(&process("b", dead.id())).await.unwrap();

    let reader = database.open_read_only().await;
    let status = serde_json::to_value(reader.status().await.unwrap()).unwrap();
    let candidates = serde_json::json!({
        "seen": 3, "accepted": 1, "declined": { "covered": 1, "duplicate": 0, "too_close": 1, "budget": 0, "backlog": 0,
            "unlikely_to_complete": 0, "grade_too_large": 0 },
        "control": 1, "rejected_by_guards": 4,
    });
    assert_eq!(status["candidates"], candidates);
    let labels = serde_json::json!({
        "queued": 2, "leased": 0, "labelled": 0, "failed": 0, "dropped": 0, "superseded": 0, "failed_under_new_protocol": 0,
        "relabelling": 0, "relabel_failed": 0, "excluded": 0, "lower_states": 0,
    });
    assert_eq!(status["labels"], labels);
    assert_eq!((&status["imported"], &status["round"]), (&1.into(), &1.into()));
    assert_eq!(status["walks"][1]["seed_structure"], "diamond");
    assert_eq!(status["walks"][1]["step"], 100);
    assert_eq!(status["processes"][0]["state"], "running");
    assert_eq!(status["processes"][1]["state"], "dead");
    assert_eq!(status["finished"], false);
    assert!(matches!(reader.commit(&Commit::default()).await, Err(StoreError::ReadOnly)));

    // A new process of a kind replaces a dead one, and the record is removed at the end.
    let next = ProcessRecord { id: "c".into(), ..process("b", std::process::id()) };
    store.upsert_process(&next).await.unwrap();
    store.remove_process("a").await.unwrap();
    let mut walks = store.load_walks().await.unwrap();
    walks.iter_mut().for_each(|walk| walk.state = "completed".into());
    store.commit(&Commit { walks, ..Commit::default() }).await.unwrap();
    for job in store.queue_list(None, 10, 0).await.unwrap() {
        assert!(!store.status().await.unwrap().finished);
        store.drop_job(&job.candidate, 1).await.unwrap();
    }
    let status = reader.status().await.unwrap();
    assert!(status.finished);
    assert_eq!(status.processes, [next]);
}

#[tokio::test]
async fn unknown_values_of_a_walk_are_not_zero() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let progress = |tau, gamma_max| WalkProgress {
        tau,
        gamma_max,
        temperature: 300.0,
        relative_volume: 1.1,
        ..WalkProgress::default()
    };
    let walks = [progress(0.5, 1.2), progress(0.0, 0.0), WalkProgress::default()];
    let walks = (0..).zip(walks).map(|(number, progress)| WalkRecord { progress, ..walk(number, 1) });
    store.commit(&Commit { walks: walks.collect(), ..Commit::default() }).await.unwrap();
    let known = |walk: store::WalkStatus| (walk.tau, walk.temperature, walk.relative_volume, walk.gamma_max);
    let walks = store.status().await.unwrap().walks.into_iter().map(known).collect::<Vec<_>>();
    // One with a bias, one without, one that has not started.
    let started = (Some(0.5), Some(300.0), Some(1.1), Some(1.2));
    let unbiased = (Some(0.0), Some(300.0), Some(1.1), None);
    assert_eq!(walks, [started, unbiased, (None, None, None, None)]);
}

#[tokio::test]
async fn walks_can_be_paused_and_resumed_at_any_time() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let pause = async |walks: &[u32], paused| {
        let walks: Vec<_> = walks.iter().copied().map(WalkId).collect();
        let changed = store.pause_walks(&walks, paused, 5).await?;
        Ok::<_, StoreError>(changed.into_iter().map(|walk| walk.0).collect::<Vec<_>>())
    };
    let error = pause(&[0], true).await.unwrap_err();
    assert_eq!(error.to_string(), "the campaign has no walk 0; no walk has started yet");
    let ended = WalkRecord { state: "diverged".into(), ..walk(2, 1) };
    store.commit(&Commit { walks: vec![walk(0, 1), walk(1, 1), ended], ..Commit::default() }).await.unwrap();
    assert_eq!(pause(&[1, 0, 1], true).await.unwrap(), [1, 0]);
    assert_eq!(pause(&[1], true).await.unwrap(), [0_u32; 0], "it is paused already");
    assert_eq!(pause(&[0, 2], false).await.unwrap(), [0]);
    // Nothing changes if one of them cannot be paused.
    let error = pause(&[0, 2], true).await.unwrap_err().to_string();
    assert_eq!(error, "walk 2 has ended (diverged): only running walks can be paused");
    let error = pause(&[0, 3], true).await.unwrap_err().to_string();
    assert_eq!(error, "the campaign has no walk 3; they are 0 to 2");

    let reader = database.open_read_only().await;
    assert_eq!(reader.paused_walks().await.unwrap(), [WalkId(1)].into());
    let paused =
        |status: store::CampaignStatus| status.walks.iter().map(|walk| walk.paused).collect::<Vec<_>>();
    assert_eq!(paused(reader.status().await.unwrap()), [false, true, false]);
    assert!(reader.walk(WalkId(1)).await.unwrap().unwrap().0.paused);
    assert!(matches!(reader.pause_walks(&[WalkId(1)], false, 5).await, Err(StoreError::ReadOnly)));
    let log = reader.operations(0, 100).await.unwrap();
    let log = log.iter().filter(|line| line.time == 5).map(|line| format!("{} {}", line.kind, line.detail));
    assert_eq!(log.collect::<Vec<_>>(), ["pause {\"walk\":1}", "pause {\"walk\":0}", "resume {\"walk\":0}"]);
    // The end of a walk ends its pause.
    store
        .commit(&Commit {
            walks: vec![WalkRecord { state: "completed".into(), ..walk(1, 2) }],
            ..Commit::default()
        })
        .await
        .unwrap();
    assert_eq!(paused(reader.status().await.unwrap()), [false; 3]);
}

#[tokio::test]
async fn the_newest_decisions_are_summarized() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let records = vec![
        candidate(0, 1, Origin::Biased, Fate::Accepted),
        candidate(0, 2, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
    ];
    let mut commit = commit_of(records);
    commit.decisions.push(Decision {
        round: 1,
        kind: "ended",
        walk: Some(WalkId(0)),
        candidate: None,
        mixture_version: 2,
        detail: serde_json::json!({ "end": "completed", "step": 7 }),
    });
    store.commit(&commit).await.unwrap();
    let newest = store.newest_decisions(0, 10).await.unwrap();
    let short: Vec<_> = newest.iter().map(|d| (d.sequence, d.kind.as_str(), d.mixture_version)).collect();
    assert_eq!(short, [(3, "ended", 2), (2, "declined", 2), (1, "accepted", 1)]);
    assert_eq!((&newest[0].detail["end"], &newest[0].candidate), (&"completed".into(), &None));
    let declined = newest[1].candidate.as_ref().unwrap();
    assert_eq!(
        (declined.reason.as_deref(), declined.step, declined.origin),
        (Some("covered"), 2, Origin::Biased)
    );
    assert_eq!((declined.seed_structure.as_str(), declined.formula.as_str()), ("diamond", "Si2"));
    assert_eq!((declined.selector_gamma, declined.original_gamma), (Some(1.3), Some(1.3 + 0.1)));
    assert!(newest[1].detail.is_null() && newest[2].candidate.as_ref().unwrap().reason.is_none());
    let numbers =
        |decisions: Vec<store::RecentDecision>| decisions.iter().map(|d| d.sequence).collect::<Vec<_>>();
    assert_eq!(numbers(store.newest_decisions(1, 10).await.unwrap()), [3, 2]);
    assert_eq!(numbers(store.newest_decisions(0, 1).await.unwrap()), [3]);
    // Jobs describe their candidates.
    let job = store.queue_list(None, 10, 0).await.unwrap().remove(0);
    assert_eq!(
        (job.walk, job.step, job.seed_structure.as_str(), job.origin.as_str()),
        (0, 1, "diamond", "biased")
    );
    assert_eq!(
        (job.temperature, job.relative_volume, job.original_gamma_nbr),
        (Some(300.25), Some(1.01), Some(1.1))
    );
}

/// Walk conditions are written once, before the first assignment.
#[tokio::test]
async fn conditions_of_walks_are_read_back() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let conditions = WalkConditions {
        group: "hot".into(),
        temperature: 900.0,
        tau: 0.15,
        cell: CellConditions::ConstantPressure(ConstantPressure {
            pressure: 1e4,
            start_volume: 0.94,
            cell_bias: true,
        }),
        repeat: 2,
        version: 2,
    };
    let begun = WalkRecord { conditions: conditions.clone(), ..walk(0, 0) };
    store.commit(&Commit { walks: vec![begun.clone()], ..Commit::default() }).await.unwrap();
    // Interrupted in its first assignment; then reported on.
    store.commit(&Commit { walks: vec![begun], ..Commit::default() }).await.unwrap();
    let later = WalkRecord { conditions: conditions.clone(), ..walk(0, 1) };
    store.commit(&Commit { walks: vec![later.clone()], ..Commit::default() }).await.unwrap();
    assert_eq!(store.load_walks().await.unwrap(), [later]);
    assert_eq!(store.walk_conditions().await.unwrap()[&WalkId(0)], conditions);
    assert_eq!(store.status().await.unwrap().walks[0].conditions, Some(conditions));
}

#[tokio::test]
async fn accepted_structures_are_those_of_biased_walks() {
    let database = TestDatabase::new();
    let store = database.create().await;
    assert_eq!(store.accepted_structures().await.unwrap(), 0);
    let records = vec![
        candidate(0, 1, Origin::Biased, Fate::Accepted),
        candidate(0, 2, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
        candidate(1, 3, Origin::Control, Fate::Accepted),
        candidate(2, 4, Origin::Biased, Fate::Accepted),
    ];
    store.commit(&commit_of(records)).await.unwrap();
    assert_eq!(store.accepted_structures().await.unwrap(), 2);
}

#[tokio::test]
async fn metadata_are_found_by_the_beginning_of_their_names() {
    let database = TestDatabase::new();
    let store = database.create().await;
    for name in ["a_b/2", "a_b/1", "a_b", "axb/1", "other"] {
        store.set_metadata(name, &format!("value of {name}")).await.unwrap();
    }
    let found = store.metadata_below("a_b/").await.unwrap();
    let expected = ["a_b/1", "a_b/2"].map(|name| (name.to_owned(), format!("value of {name}")));
    assert_eq!(found, expected);
    assert_eq!(store.metadata_below("b").await.unwrap(), []);
}
