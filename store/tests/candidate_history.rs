//! The history of a candidate, found by number, name or prefix.

use store::{CandidateRef, Commit, CoveredCandidate, Fate, JobState, LabelStatus, StoreError, WalkRecord};
use wire::messages::DeclineReason;
use wire::{Origin, WalkId};

use crate::common::*;

#[tokio::test]
async fn a_candidate_is_found_with_related_records() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    // Their walkers saw version 3; each decision adds a version.
    let covered = Fate::Declined(DeclineReason::Covered);
    let records = [
        candidate(0, 4, Origin::Biased, Fate::Accepted),
        candidate(1, 5, Origin::Biased, covered),
        candidate(1, 6, Origin::Biased, Fate::Declined(DeclineReason::TooClose)),
        candidate(11, 7, Origin::Biased, covered),
    ];
    let named = |k: usize| CandidateRef { decision: k as i64 + 1, candidate: name_of(&records[k]) };
    let walks = vec![walk(0, 2), walk(1, 2)];
    store.commit(&Commit { walks, ..commit_of(records.to_vec()) }).await.unwrap();

    for id in ["1", &named(0).candidate, "9f9f9f9f-0.", "0.0.4"] {
        assert_eq!(store.find_candidate(id).await.unwrap(), named(0), "{id}");
    }
    let error = store.find_candidate("1.0").await.unwrap_err();
    assert!(matches!(&error, StoreError::AmbiguousJob { matches, .. } if matches.len() == 2), "{error}");
    for id in ["0", "5", "2.0", "x"] {
        let error = store.find_candidate(id).await.unwrap_err();
        let expected = Some((named(0), named(3)));
        assert!(
            matches!(&error, StoreError::UnknownCandidate { range, .. } if *range == expected),
            "{error}"
        );
    }

    assert_eq!(store.updates_since(3, 2).await.unwrap(), [named(0)]);
    assert_eq!(store.updates_since(4, 2).await.unwrap(), []);
    let later = |k: usize, decided| CoveredCandidate { named: named(k), seen: 3, decided };
    for staleness in [None, Some(9), Some(1)] {
        // A page of the log is read as a whole.
        let found = store.covered_since(1, 4, staleness).await.unwrap();
        assert_eq!((found.candidates, found.searched_until), (vec![later(1, 5), later(3, 7)], None));
    }
    assert_eq!(store.covered_since(1, 3, None).await.unwrap().candidates, []);

    let content = records[0].block.view().id().content;
    let lease = store.lease(protocol("dft").hash, "a", 0, 10).await.unwrap().unwrap();
    store.prioritise_job("0.0.4", 42, 5).await.unwrap();
    store.complete(&lease, &label(-1.5), 9).await.unwrap();
    let jobs = store.jobs_of(content).await.unwrap();
    assert_eq!((jobs.len(), jobs[0].job.state, jobs[0].attempts_made.len()), (1, JobState::Labelled, 1));
    let queue_admin = store.manual_operations(jobs[0].job.job).await.unwrap();
    assert_eq!((queue_admin.len(), queue_admin[0].kind.as_str()), (1, "prioritise"));
    assert!(store.manual_operations(jobs[0].job.job + 1).await.unwrap().is_empty());
    let labels = store.labels_of(content).await.unwrap();
    assert_eq!((labels.len(), labels[0].record.status), (1, LabelStatus::Label));
    assert_eq!((&labels[0].protocol, &labels[0].record.label), (&protocol("dft"), &label(-1.5)));
    let declined = records[1].block.view().id().content;
    assert!(
        store.jobs_of(declined).await.unwrap().is_empty()
            && store.labels_of(declined).await.unwrap().is_empty()
    );
    let same = store.same_structure(content).await.unwrap();
    assert_eq!((same.candidates, same.import), (vec![named(0)], None));

    assert_eq!(store.accepted_at(WalkId(0), 4).await.unwrap(), Some(named(0)));
    assert_eq!(store.accepted_at(WalkId(1), 5).await.unwrap(), None, "it was declined");
    let (status, partner) = store.walk(WalkId(1)).await.unwrap().unwrap();
    assert_eq!((status.walk, status.state.as_str(), partner), (1, "running", None));
    assert!(store.walk(WalkId(7)).await.unwrap().is_none());
    let control = WalkRecord { origin: Origin::Control, partner: Some(WalkId(1)), ..walk(2, 1) };
    store.commit(&Commit { walks: vec![control], ..Commit::default() }).await.unwrap();
    assert!(store.matched_walks().await.unwrap().into_iter().eq([(2, 1)]));
    assert_eq!(store.seed_structure(0).await.unwrap().unwrap().name, "diamond");
    assert!(store.seed_structure(1).await.unwrap().is_none());
    assert!(store.imported_structure(1).await.unwrap().is_none());
    assert_eq!(store.imported_structures().await.unwrap(), 0);
}
