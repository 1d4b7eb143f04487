//! Results of label jobs, as the cost model, `status` and the table of force errors read them.

use store::{
    ArrivalSum, Commit, ExportFilter, FailedCandidate, FailureCount, Fate, FateCount, JobState, LabelUsage,
    LabelledCandidate, Lease, PendingJobs, RelabelRequest, Store, Unlabelled, ValueRange, WalkRecord,
};
use wire::{Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

use crate::common::*;

async fn lease(store: &Store, now: i64) -> Lease {
    store.lease(protocol("dft").hash, "a", now, 1000).await.unwrap().unwrap()
}

/// Accepts a structure with this largest γ under the original mixture and this V/V₀.
async fn accept_with(store: &Store, step: u64, gamma: f64, relative_volume: f64) -> String {
    let mut record = candidate(0, step, Origin::Biased, Fate::Accepted);
    let candidate = Candidate { relative_volume, ..record.block.view().to_candidate() };
    record.block = CandidateBlock::encode(&candidate);
    record.original.gamma[0] = gamma;
    store.commit(&commit_of(vec![record.clone()])).await.unwrap();
    name_of(&record)
}

/// Three labels, the second of which takes two attempts; two failed jobs, and one that waits.
async fn filled(database: &TestDatabase) -> (Store, Vec<String>) {
    let store = database.create().await.with_caller_clock();
    let mut names = Vec::new();
    for (step, gamma, volume) in
        [(1, 1.5, 1.0), (2, 1.6, 1.1), (3, 1.7, 1.2), (4, 4.0, 1.4), (5, 3.0, 1.35), (6, 2.0, 1.3)]
    {
        names.push(accept_with(&store, step, gamma, volume).await);
    }
    let first = lease(&store, 0).await;
    store.complete(&first, &label(-1.0), 2_000).await.unwrap();
    let second = lease(&store, 2_000).await;
    store.fail(&second, "not_converged", "60 steps", 2, 7_000).await.unwrap();
    let second = lease(&store, 7_000).await;
    store.complete(&second, &label(-2.0), 11_000).await.unwrap();
    let third = lease(&store, 11_000).await;
    store.complete(&third, &label(-3.0), 19_000).await.unwrap();
    for class in ["crashed", "not_converged"] {
        let failing = lease(&store, 20_000).await;
        store.fail(&failing, class, "", 1, 21_000).await.unwrap();
    }
    (store, names)
}

#[tokio::test]
async fn costs_are_those_of_successful_attempts() {
    let database = TestDatabase::new();
    let (store, _) = filled(&database).await;
    let costs = store.label_costs(protocol("dft").hash, 10).await.unwrap();
    let seconds: Vec<_> = costs.iter().map(|cost| cost.core_seconds).collect();
    assert_eq!(seconds, [8.0, 4.0, 2.0], "newest first");
    assert_eq!((costs[0].atoms, costs[0].formula.as_str(), costs[0].seed_structure), (2, "Si2", 0));
    assert_eq!(store.label_costs(protocol("dft").hash, 1).await.unwrap(), costs[..1]);
    let waiting = store.waiting_jobs(protocol("dft").hash).await.unwrap();
    assert_eq!(waiting, [PendingJobs { seed_structure: 0, formula: "Si2".into(), atoms: 2, jobs: 1 }]);
    // Three failed attempts: 5 s, and twice 1 s.
    let expected = LabelUsage { core_seconds: Some(21.0), label_core_seconds: Some(14.0), cores: 0 };
    assert_eq!(store.label_usage().await.unwrap(), expected);
    // There are no walks here, but the totals are those of the attempts.
    let findings = store.check(|_, _| ()).await.unwrap();
    assert!(
        findings.iter().all(|finding| finding.what.contains("candidates of missing walks")),
        "{findings:?}"
    );
    lease(&store, 30_000).await;
    assert_eq!(
        store.label_usage().await.unwrap(),
        LabelUsage { cores: 1, ..store.label_usage().await.unwrap() }
    );
}

/// A structure without a seed structure counts in the cost and the failures like others, and can be relabelled.
#[tokio::test]
async fn imported_structures_count_as_others_do() {
    let database = TestDatabase::new();
    let (store, _) = filled(&database).await;
    let dft = protocol("dft").hash;
    let files: Vec<_> = (0..2).map(|k| ("new.extxyz".to_owned(), k, structure(50.0 + k as f64))).collect();
    store.queue_imports(&files, 0, 30_000).await.unwrap();
    assert_eq!(store.imported_jobs(JobState::Queued).await.unwrap(), 2);
    for name in ["import-1", "import-2"] {
        store.prioritise_job(name, 20, 30_000).await.unwrap();
    }
    let done = lease(&store, 30_000).await;
    assert_eq!(done.candidate, "import-1");
    store.complete(&done, &label(-5.0), 36_000).await.unwrap();
    let failing = lease(&store, 36_000).await;
    assert_eq!(failing.candidate, "import-2");
    store.fail(&failing, "crashed", "", 1, 37_000).await.unwrap();

    let newest = store.label_costs(dft, 1).await.unwrap().remove(0);
    assert_eq!((newest.seed_structure, newest.atoms, newest.core_seconds), (u32::MAX, 2, 6.0));
    for ranges in [true, false] {
        let unlabelled = store.unlabelled(dft, 0, ranges).await.unwrap();
        let rows: Vec<_> =
            unlabelled.iter().map(|row| (row.seed_structure.as_str(), row.failed, row.labelled)).collect();
        assert_eq!(rows, [("diamond", 2, 3), ("imported", 1, 1)], "ranges: {ranges}");
        assert_eq!(unlabelled[1].gamma, ValueRange::default());
    }

    let found = store.relabellable(dft).await.unwrap();
    let import = found.last().unwrap();
    assert_eq!((found.len(), import.content), (4, ContentHash::from_structure(&structure(50.0))));
    assert_eq!((import.seed_structure, import.formula.as_str(), import.atoms), (u32::MAX, "Si2", 2));
    let request = RelabelRequest {
        structures: &[import.content],
        include_current: true,
        reason: "doubtful",
        protocol: None,
    };
    assert_eq!(store.relabel(&request, 40_000).await.unwrap().relabelling, 1);
    store.prioritise_job("import-1", 20, 40_000).await.unwrap();
    let again = lease(&store, 40_000).await;
    assert_eq!(again.candidate, "import-1");
    store.complete(&again, &label(-6.0), 41_000).await.unwrap();
    let imported = ExportFilter { protocol: dft, biased: false, control: false, imported: true };
    let rows = store.labelled(&imported, None, 10).await.unwrap();
    assert_eq!(rows.iter().map(|row| row.label.energy).collect::<Vec<_>>(), [-6.0]);
}

/// Labels come in another order than their structures were found, and a structure of two walks comes with both candidates.
#[tokio::test]
async fn labels_are_read_in_the_order_in_which_they_came() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    for step in [1, 2, 3] {
        accept_with(&store, step, 1.5, 1.0).await;
    }
    let mut again = candidate(0, 2, Origin::Control, Fate::Accepted);
    let first = again.block.view().to_candidate();
    let id = CandidateId { walk: WalkId(1), ..first.id };
    again.block = CandidateBlock::encode(&Candidate { id, origin: Origin::Control, ..first });
    store.commit(&commit_of(vec![again])).await.unwrap();
    let leases = [lease(&store, 0).await, lease(&store, 0).await, lease(&store, 0).await];
    for (lease, energy) in leases.iter().zip([-1.0, -2.0, -3.0]).rev() {
        store.complete(lease, &label(energy), 1000).await.unwrap();
    }
    let (dft, mut after, mut found) = (protocol("dft").hash, None, Vec::new());
    let mut sum = ArrivalSum::default();
    loop {
        assert_eq!(store.label_arrivals_until(dft, after).await.unwrap(), sum, "of what was read");
        let page = store.label_arrivals(dft, after, 1).await.unwrap();
        let Some(arrival) = page.first() else { break };
        after = Some((arrival.number, arrival.candidate.decision));
        sum.add(arrival);
        found.push((arrival.candidate.label.energy, arrival.candidate.decision));
    }
    assert_eq!(found, [(-3.0, 3), (-2.0, 2), (-2.0, 4), (-1.0, 1)]);
    assert_eq!(store.label_arrivals(dft, None, 10).await.unwrap().len(), 4);
    store.exclude(&[leases[1].candidate.clone()], "bad", 2000).await.unwrap();
    assert_ne!(store.label_arrivals_until(dft, after).await.unwrap(), sum, "a label is gone");
    store.include(&[leases[1].candidate.clone()], 3000).await.unwrap();
    assert_eq!(store.label_arrivals_until(dft, after).await.unwrap(), sum);
}

#[tokio::test]
async fn failures_are_counted_by_class_and_outcome() {
    let database = TestDatabase::new();
    let (store, _) = filled(&database).await;
    let found = store.failures(protocol("dft").hash).await.unwrap();
    let count =
        |class: &str, labelled, failed| FailureCount { class: class.into(), labelled, failed, unfinished: 0 };
    assert_eq!(found, [count("crashed", 0, 1), count("not_converged", 1, 1)]);
}

#[tokio::test]
async fn failed_labels_are_grouped_by_seed_structure_and_formula() {
    let database = TestDatabase::new();
    let (store, names) = filled(&database).await;
    let unlabelled = store.unlabelled(protocol("dft").hash, 0, true).await.unwrap();
    let without = |part: &Unlabelled| Unlabelled {
        gamma_labelled: ValueRange::default(),
        relative_volume_labelled: ValueRange::default(),
        ..part.clone()
    };
    let expected: Vec<_> = unlabelled.iter().map(without).collect();
    assert_eq!(store.unlabelled(protocol("dft").hash, 0, false).await.unwrap(), expected);
    let [only] = unlabelled.as_slice() else { panic!("{unlabelled:?}") };
    assert_eq!((only.seed_structure.as_str(), only.formula.as_str()), ("diamond", "Si2"));
    assert_eq!((only.failed, only.labelled), (2, 3));
    let range = |low, high| ValueRange { low: Some(low), high: Some(high) };
    assert_eq!((only.gamma, only.gamma_labelled), (range(3.0, 4.0), range(1.5, 1.7)));
    assert_eq!((only.relative_volume, only.relative_volume_labelled), (range(1.35, 1.4), range(1.0, 1.2)));
    // No walk has this version of the potential, so there are no grades to compare; all else is of all versions.
    for ranges in [true, false] {
        let other = store.unlabelled(protocol("dft").hash, 7, ranges).await.unwrap().remove(0);
        let none = ValueRange::default();
        assert_eq!((other.gamma, other.gamma_labelled), (none, none));
        assert_eq!((other.failed, other.labelled, other.relative_volume), (2, 3, range(1.35, 1.4)));
    }

    // In pages of any length.
    let (dft, mut failed, mut labelled) = (protocol("dft").hash, Vec::new(), Vec::new());
    loop {
        let after = failed.last().map_or(0, |last: &FailedCandidate| last.decision);
        let page = store.failed_after(dft, after, 1).await.unwrap();
        if page.is_empty() {
            break;
        }
        failed.extend(page);
    }
    loop {
        let after = labelled.last().map_or(0, |last: &LabelledCandidate| last.decision);
        let page = store.labelled_after(dft, after, 2).await.unwrap();
        if page.is_empty() {
            break;
        }
        labelled.extend(page);
    }
    let seen: Vec<_> = failed.iter().map(|one| (one.candidate.as_str(), one.gamma)).collect();
    assert_eq!(seen, [(names[3].as_str(), Some(4.0)), (names[4].as_str(), Some(3.0))]);
    for one in &failed {
        // campaign-walk.segment.step-content
        let place = format!("-{}.0.{}-", one.walk, one.step);
        assert!(one.candidate.contains(&place), "{} {place}", one.candidate);
        assert!(one.content.to_string().starts_with(one.candidate.rsplit('-').next().unwrap()));
    }
    assert_eq!((&failed[0].original.gamma[..], failed[0].relative_volume), (&[4.0, 0.8][..], Some(1.4)));
    let seen: Vec<_> =
        labelled.iter().map(|one| (one.block.view().id().to_string(), one.gamma, one.label.energy)).collect();
    let expected = [(1.5, -1.0), (1.6, -2.0), (1.7, -3.0)];
    let expected =
        names.iter().zip(expected).map(|(name, (gamma, energy))| (name.clone(), Some(gamma), energy));
    assert_eq!(seen, expected.collect::<Vec<_>>());
    assert!(
        labelled
            .iter()
            .all(|one| one.job == Some(JobState::Labelled) && one.structure == one.block.view().structure())
    );
    let decisions = [5, 3, 1].map(|place| labelled[0].decision + place - 1);
    let listed = store.labelled_of_decisions(dft, &decisions).await.unwrap();
    let listed: Vec<_> = listed.iter().map(|one| one.label.energy).collect();
    assert_eq!(listed, [-1.0, -3.0], "those with a label");
    // A protocol without jobs has no results.
    store.add_protocol(&protocol("other"), 0).await.unwrap();
    assert!(store.failed_after(protocol("other").hash, 0, 9).await.unwrap().is_empty());
    assert!(store.labelled_after(protocol("other").hash, 0, 9).await.unwrap().is_empty());
    assert!(store.unlabelled(protocol("other").hash, 0, true).await.unwrap().is_empty());
    assert!(store.unlabelled(ContentHash([9; 32]), 0, true).await.is_err());
}

#[tokio::test]
async fn near_duplicates_are_the_labelled_structures_nearest_in_energy() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    let mut names = Vec::new();
    for (step, energy) in [(1, -8.0), (2, -7.0), (3, -8.4), (4, -9.0)] {
        let mut record = candidate(0, step, Origin::Biased, Fate::Accepted);
        let candidate = Candidate { energy, ..record.block.view().to_candidate() };
        record.block = CandidateBlock::encode(&candidate);
        store.commit(&commit_of(vec![record.clone()])).await.unwrap();
        names.push(name_of(&record));
    }
    let first = lease(&store, 0).await;
    let (own, others) = store.near_duplicates(&first, 9).await.unwrap().unwrap();
    assert_eq!((own.len(), others.len()), (3 * ATOMS, 0), "nothing has its label");
    store.complete(&first, &label(-1.0), 1).await.unwrap();
    for _ in 0..2 {
        store.complete(&lease(&store, 2).await, &label(-1.0), 3).await.unwrap();
    }
    let last = lease(&store, 4).await;
    let near = |others: Vec<store::NearDuplicate>| -> Vec<_> {
        others.into_iter().map(|other| other.candidate).collect()
    };
    let (_, others) = store.near_duplicates(&last, 2).await.unwrap().unwrap();
    let mut found = near(others);
    found.sort();
    let mut expected = [names[0].clone(), names[2].clone()];
    expected.sort();
    assert_eq!(found, expected, "-8.4 and -8.0 are nearest to -9.0");
}

#[tokio::test]
async fn collected_structures_come_with_their_labels() {
    let database = TestDatabase::new();
    let (store, _) = filled(&database).await;
    store.commit(&commit_of(vec![candidate(1, 9, Origin::Control, Fate::Accepted)])).await.unwrap();
    let declined = Fate::Declined(wire::messages::DeclineReason::Covered);
    store.commit(&commit_of(vec![candidate(0, 10, Origin::Biased, declined)])).await.unwrap();
    let dft = protocol("dft").hash;
    let mut found = Vec::new();
    loop {
        let page = store.collected(
            Some(dft),
            found.last().map_or(0, |last: &store::CollectedStructure| last.decision),
            3,
        );
        let page = page.await.unwrap();
        if page.is_empty() {
            break;
        }
        found.extend(page);
    }
    let states: Vec<_> = found.iter().map(|row| (row.job.unwrap(), row.label_forces.is_some())).collect();
    let (labelled, failed) = ((JobState::Labelled, true), (JobState::Failed, false));
    let queued = (JobState::Queued, false);
    assert_eq!(states, [labelled, labelled, labelled, failed, failed, queued, queued]);
    assert_eq!(found[1].label_forces, Some(label(-2.0).forces));
    assert_eq!(found.iter().filter(|row| row.origin == Origin::Control).count(), 1);
    assert_eq!((found[3].original.gamma[0], found[3].block.view().relative_volume()), (4.0, 1.4));
    let without = store.collected(None, 0, 100).await.unwrap();
    assert!(without.len() == 7 && without.iter().all(|row| row.job.is_none() && row.label_forces.is_none()));

    let fate = |part, fate: &str, number| FateCount { part, fate: fate.into(), number };
    let parts = store.fates_by_decision(4).await.unwrap();
    assert_eq!(parts, [fate(0, "accepted", 4), fate(1, "accepted", 2), fate(1, "covered", 1)]);
    let seeds = store.fates_by_seed_structure().await.unwrap();
    assert_eq!(seeds, [fate(0, "accepted", 6), fate(0, "covered", 1)]);
    let other = candidate(3, 11, Origin::Biased, declined);
    store.commit(&commit_of(vec![other])).await.unwrap();
    let walks = store.fates_by_walk().await.unwrap();
    assert_eq!(walks, [fate(0, "accepted", 6), fate(0, "covered", 1), fate(3, "covered", 1)]);
}

#[tokio::test]
async fn labels_of_different_versions_are_kept_apart() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    for number in 0..2 {
        let conditions = WalkConditions { version: number, ..WalkConditions::default() };
        let walks = vec![WalkRecord { conditions, ..walk(number, 0) }];
        let found = candidate(number, 1, Origin::Biased, Fate::Accepted);
        store.commit(&Commit { walks, ..commit_of(vec![found]) }).await.unwrap();
    }
    assert_eq!(store.walk_versions().await.unwrap().numbers().collect::<Vec<_>>(), [0, 1]);
    let dft = protocol("dft").hash;
    store.complete(&lease(&store, 0).await, &label(-1.0), 1).await.unwrap();
    let second = lease(&store, 2).await;
    let (_, others) = store.near_duplicates(&second, 9).await.unwrap().unwrap();
    assert_eq!(others, [], "the features of another version say nothing");
    store.complete(&second, &label(-2.0), 3).await.unwrap();
    assert_eq!(store.labels_by_walk(dft).await.unwrap(), [(0, 1), (1, 1)]);
    for (version, expected) in [(0, vec![-1.0]), (1, vec![-2.0]), (2, vec![])] {
        let energies = store.labelled_energies(dft, version, 9).await.unwrap();
        assert_eq!(energies.iter().map(|found| found.label).collect::<Vec<_>>(), expected);
    }
    let labelled = store.labelled_after(dft, 0, 9).await.unwrap();
    let walks: Vec<_> = labelled.iter().map(|found| found.block.view().id().walk.0).collect();
    assert_eq!(walks, [0, 1]);
}
