//! The label queue step by step, imports and exports.

use std::collections::BTreeSet;

use store::{
    CalculationRecord, CompleteOutcome, ExportCursor, ExportFilter, ExportSource, FailOutcome, Fate,
    ImportCounts, JobState, LabelSource, LabelStatus, Lease, QueuedImports, Store, StoreError,
};
use wire::{ContentHash, Origin};

use crate::common::*;

const LIMIT: u32 = 2;

pub async fn lease(store: &Store, holder: &str, now: i64) -> Option<Lease> {
    store.lease(protocol("dft").hash, holder, now, 10).await.unwrap()
}

pub async fn state(store: &Store, candidate: &str) -> JobState {
    store.queue_show(candidate).await.unwrap().job.state
}

#[tokio::test]
async fn jobs_are_leased_by_priority_then_age_and_return_on_expiry() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 3).await;
    store.prioritise_job(&names[2], 20, 0).await.unwrap();
    let first = lease(&store, "host-1/a", 0).await.unwrap();
    assert_eq!((first.candidate.as_str(), first.attempt), (names[2].as_str(), 1));
    assert_eq!(ContentHash::from_structure(&first.structure), ContentHash::from_structure(&structure(3e-6)));
    store.record_calculation(&first, "slurm 17", &CalculationRecord::default()).await.unwrap();
    assert_eq!(lease(&store, "host-1/b", 0).await.unwrap().candidate, names[0]);
    assert_eq!(lease(&store, "host-2", 0).await.unwrap().candidate, names[1]);
    assert!(lease(&store, "host-2", 9_999).await.is_none());
    assert!(store.renew(&first, 5_000, 60).await.unwrap());
    assert_eq!(store.unfinished_jobs().await.unwrap(), 3);

    // The two others expired; the renewed one did not.
    assert_eq!(lease(&store, "c", 10_000).await.unwrap().candidate, names[0]);
    assert_eq!(state(&store, &names[1]).await, JobState::Queued);
    assert_eq!(state(&store, &names[2]).await, JobState::Leased);
    let again = lease(&store, "c", 65_000).await.unwrap();
    assert_eq!((again.candidate.as_str(), again.attempt), (names[2].as_str(), 2));
    assert_eq!(again.earlier_calculations, ["slurm 17"]);
    assert!(!store.renew(&first, 65_000, 60).await.unwrap());
    // Expiry says nothing about the job.
    let details = store.queue_show(&names[0]).await.unwrap();
    assert_eq!((details.job.state, details.job.failures), (JobState::Queued, 0));
    let outcomes: Vec<_> = details.attempts_made.iter().map(|a| a.outcome.as_deref()).collect();
    assert_eq!(outcomes, [Some("expired"), Some("expired")]);
}

#[tokio::test]
async fn the_first_result_becomes_the_label() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    let lost = lease(&store, "a", 0).await.unwrap();
    let holds = lease(&store, "b", 10_000).await.unwrap();
    assert_eq!(store.complete(&lost, &label(-1.0), 11_000).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(state(&store, &names[0]).await, JobState::Labelled);
    assert_eq!(store.complete(&holds, &label(-2.0), 12_000).await.unwrap(), CompleteOutcome::KeptAsCheck);
    assert_eq!(store.complete(&lost, &label(-3.0), 13_000).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(store.fail(&holds, "timeout", "", LIMIT, 14_000).await.unwrap(), FailOutcome::LeaseLost);
    assert_eq!(state(&store, &names[0]).await, JobState::Labelled);

    let attempts = store.queue_show(&names[0]).await.unwrap().attempts_made;
    let outcomes: Vec<_> = attempts.iter().map(|attempt| attempt.outcome.as_deref().unwrap()).collect();
    assert_eq!(outcomes, ["labelled", "check"]);
    let history = store.labels_of(ContentHash::from_structure(&holds.structure)).await.unwrap();
    let lines: Vec<_> =
        history.iter().map(|label| (label.record.status, label.record.label.energy)).collect();
    assert_eq!(lines, [(LabelStatus::Label, -1.0), (LabelStatus::Check, -2.0)]);
    assert_eq!(history[0].record.source, LabelSource::Attempt { job: lost.job, attempt: lost.attempt });
}

#[tokio::test]
async fn impossible_results_are_rejected() {
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 1).await;
    let lease = lease(&store, "a", 0).await.unwrap();
    let mut short = label(-1.0);
    short.forces.pop();
    let mut infinite = label(-1.0);
    infinite.forces[1][2] = f64::INFINITY;
    for wrong in [label(f64::NAN), short, infinite] {
        let refused = store.complete(&lease, &wrong, 1).await;
        assert!(matches!(refused, Err(StoreError::InvalidLabel(_))));
    }
    assert_eq!(store.complete(&lease, &label(-1.0), 2).await.unwrap(), CompleteOutcome::Label);
}

#[tokio::test]
async fn failures_count_and_releases_do_not() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    for (stop, holder) in [(true, "h-1/a"), (false, "h-1/b"), (true, "h-1")] {
        lease(&store, holder, 0).await.unwrap();
        assert_eq!(store.release_all("h", 1).await.unwrap(), 0, "another holder");
        let released = if stop { store.release_all("h-1", 1) } else { store.release_all(holder, 1) };
        assert_eq!(released.await.unwrap(), 1);
    }
    lease(&store, "h-1/c", 1).await.unwrap();
    assert_eq!(store.release_leases_of_dead_processes(2).await.unwrap(), 1);
    let first = lease(&store, "h", 2).await.unwrap();
    assert_eq!(first.attempt, 5);
    assert_eq!(store.fail(&first, "not converged", "SCF", LIMIT, 3).await.unwrap(), FailOutcome::Requeued);
    let second = lease(&store, "h", 3).await.unwrap();
    assert!(second.earlier_calculations.is_empty(), "that one ended");
    assert_eq!(second.failures, ["not converged"]);
    assert_eq!(store.fail(&second, "not converged", "SCF", LIMIT, 4).await.unwrap(), FailOutcome::Failed);
    let details = store.queue_show(&names[0]).await.unwrap();
    assert_eq!((details.job.state, details.job.failures), (JobState::Failed, 2));
    let outcomes: Vec<_> = details.attempts_made.iter().map(|a| a.outcome.as_deref().unwrap()).collect();
    assert_eq!(outcomes, ["released", "released", "released", "lost", "failed", "failed"]);
    assert_eq!(details.attempts_made[5].class.as_deref(), Some("not converged"));
    assert!(lease(&store, "h", 5).await.is_none());
    store.retry_job(&names[0], 6).await.unwrap();
    assert_eq!(lease(&store, "h", 7).await.unwrap().attempt, 7);
}

#[tokio::test]
async fn a_job_that_crashes_its_labellers_fails() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 2).await;
    for crash in 1..=2 {
        let holder = format!("h-{crash}");
        assert_eq!(lease(&store, &holder, 0).await.unwrap().candidate, names[0]);
        assert_eq!(store.fail_leases_of("other", "crashed", "", LIMIT, 1).await.unwrap(), 0);
        assert_eq!(store.fail_leases_of(&holder, "crashed", "SIGSEGV", LIMIT, 1).await.unwrap(), 1);
    }
    let details = store.queue_show(&names[0]).await.unwrap();
    assert_eq!((details.job.state, details.job.failures), (JobState::Failed, 2));
    let last = &details.attempts_made[1];
    assert_eq!((last.outcome.as_deref(), last.class.as_deref()), (Some("failed"), Some("crashed")));
    assert_eq!((last.log.as_deref(), last.ended), (Some("SIGSEGV"), Some(1)));
    assert_eq!(lease(&store, "h-3", 2).await.unwrap().candidate, names[1]);
}

#[tokio::test]
async fn a_job_that_is_lost_repeatedly_fails() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    let lose = async |losses: usize| {
        for loss in 0..losses {
            let now = 10_000 * loss as i64;
            lease(&store, "h", now).await.unwrap();
            let released = match loss % 3 {
                0 => store.release_all("h", now).await.unwrap(),
                1 => store.release_leases_of_dead_processes(now).await.unwrap(),
                // It expires.
                _ => continue,
            };
            assert_eq!(released, 1);
        }
    };
    lose(24).await;
    let failing = lease(&store, "h", 240_000).await.unwrap();
    assert_eq!(store.fail(&failing, "not converged", "SCF", LIMIT, 0).await.unwrap(), FailOutcome::Requeued);
    // Each time with as many attempts as at first: after a failure, and when it is requeued by hand.
    for attempts in [50, 75] {
        lose(25).await;
        let details = store.queue_show(&names[0]).await.unwrap();
        assert_eq!((details.job.state, details.job.attempts), (JobState::Failed, attempts));
        let last = details.attempts_made.last().unwrap();
        assert_eq!(
            (last.outcome.as_deref(), last.class.as_deref()),
            (Some("released"), Some("lost_too_often"))
        );
        assert!(last.log.as_ref().unwrap().starts_with("25 attempts in a row"));
        assert!(lease(&store, "h", 300_000).await.is_none());
        store.retry_job(&names[0], 0).await.unwrap();
    }
}

#[tokio::test]
async fn jobs_are_found_by_name_or_prefix() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let error = store.drop_job("0.0.1", 0).await.unwrap_err();
    assert!(error.to_string().contains("queue is empty"), "{error}");
    let names = accept(&store, 12).await;
    assert_eq!(store.queue_show(&names[4]).await.unwrap().job.candidate, names[4]);
    assert_eq!(store.drop_job("0.0.5", 1).await.unwrap(), names[4]);
    assert_eq!(store.queue_show("9f9f9f9f-0.0.5").await.unwrap().job.state, JobState::Dropped);
    let error = store.drop_job("0.0.1", 2).await.unwrap_err();
    assert!(matches!(&error, StoreError::AmbiguousJob { matches, .. } if matches.len() == 4), "{error}");
    let error = store.drop_job("0.0.77", 2).await.unwrap_err();
    assert!(matches!(&error, StoreError::UnknownJob { near, .. } if near[0] == names[6]), "{error}");
    let message = store.drop_job("0.0.5", 3).await.unwrap_err().to_string();
    assert!(
        message.contains("is dropped, and only queued, leased and failed jobs can be dropped"),
        "{message}"
    );
    assert!(matches!(store.retry_job("0.0.6", 3).await, Err(StoreError::WrongState { .. })));
    let dropped = store.queue_list(Some(JobState::Dropped), 5, 0).await.unwrap();
    assert_eq!((dropped.len(), dropped[0].candidate.as_str()), (1, names[4].as_str()));
    let page = store.queue_list(Some(JobState::Queued), 2, 3).await.unwrap();
    assert_eq!([&page[0].candidate, &page[1].candidate], [&names[3], &names[5]]);
    let operation = store.operations(0, 100).await.unwrap().pop().unwrap();
    assert_eq!((operation.kind.as_str(), operation.time), ("drop", 1));
    assert_eq!(operation.detail["candidate"], names[4]);
}

#[tokio::test]
async fn all_jobs_are_listed_by_state_and_priority() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 6).await;
    store.drop_job(&names[0], 1).await.unwrap();
    store.prioritise_job(&names[4], 50, 1).await.unwrap();
    lease(&store, "a", 0).await.unwrap();
    store.prioritise_job(&names[5], 99, 1).await.unwrap();
    let expected = [4, 5, 1, 2, 3, 0].map(|k: usize| names[k].clone());
    let listed = async |limit, offset| -> Vec<String> {
        let jobs = store.queue_list(None, limit, offset).await.unwrap();
        jobs.into_iter().map(|job| job.candidate).collect()
    };
    assert_eq!(listed(u32::MAX, 0).await, expected);
    // Pages have the same order, wherever one ends.
    for limit in 1..=6_u32 {
        let mut pages = Vec::new();
        for offset in (0..8).step_by(limit as usize) {
            pages.extend(listed(limit, offset).await);
        }
        assert_eq!(pages, expected, "{limit}");
    }
}

#[tokio::test]
async fn a_dropped_job_stays_dropped_until_it_is_requeued() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    let lease = lease(&store, "a", 0).await.unwrap();
    store.drop_job(&names[0], 1).await.unwrap();
    assert_eq!(store.complete(&lease, &label(-1.0), 2).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(state(&store, &names[0]).await, JobState::Dropped);
    let all = ExportFilter { protocol: lease.protocol, biased: true, control: true, imported: true };
    assert!(store.labelled(&all, None, 10).await.unwrap().is_empty());
    store.retry_job(&names[0], 3).await.unwrap();
    assert_eq!(state(&store, &names[0]).await, JobState::Labelled);
    assert_eq!(store.labelled(&all, None, 10).await.unwrap().len(), 1);
}

#[tokio::test]
async fn candidates_found_before_there_is_a_protocol_get_jobs_later() {
    let database = TestDatabase::new();
    let store = Store::create(database.location(), &campaign(), &[], 0).await.unwrap().with_caller_clock();
    let names = accept(&store, 2).await;
    assert_eq!(store.unfinished_jobs().await.unwrap(), 0);
    let unknown = store.lease(protocol("dft").hash, "a", 0, 10).await;
    assert!(matches!(unknown, Err(StoreError::UnknownProtocol(_))));
    for _ in 0..2 {
        store.add_protocol(&protocol("dft"), 1).await.unwrap();
    }
    assert_eq!(lease(&store, "a", 2).await.unwrap().candidate, names[0]);
    assert_eq!(store.unfinished_jobs().await.unwrap(), 2);
    let mut other = protocol("other");
    other.name = "dft".into();
    assert!(matches!(store.add_protocol(&other, 3).await, Err(StoreError::ProtocolName(_))));
    // A new protocol applies to new candidates only.
    store.add_protocol(&protocol("finer"), 4).await.unwrap();
    assert!(store.lease(protocol("finer").hash, "a", 5, 10).await.unwrap().is_none());
}

#[tokio::test]
async fn imports_label_waiting_jobs_and_can_be_repeated() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 2).await;
    let dft = protocol("dft").hash;
    let frames = [(0, structure(50.0), label(-5.0)), (1, structure(1e-6), label(-1.0))];
    let first = store.import(dft, "old.extxyz", &frames, 1).await.unwrap();
    assert_eq!(first, ImportCounts { labels: 2, ..ImportCounts::default() });
    let second = store.import(dft, "old.extxyz", &frames, 2).await.unwrap();
    assert_eq!(second, ImportCounts { known: 2, ..ImportCounts::default() });
    let other = [(0, structure(50.0), label(-5.1))];
    let third = store.import(dft, "other.extxyz", &other, 3).await.unwrap();
    assert_eq!(third, ImportCounts { checks: 1, ..ImportCounts::default() });
    assert_eq!(state(&store, &names[0]).await, JobState::Labelled);
    assert_eq!(state(&store, &names[1]).await, JobState::Queued);
    let known = store.known_hashes().await.unwrap();
    let expected: Vec<_> =
        [1e-6, 2e-6, 50.0, 1e-6].map(|shift| ContentHash::from_structure(&structure(shift))).into();
    assert_eq!(known, expected);
    // All frames or none.
    let mut wrong = label(-6.0);
    wrong.forces.pop();
    let frames = [(0, structure(60.0), label(-6.0)), (1, structure(61.0), wrong)];
    assert!(store.import(dft, "bad.extxyz", &frames, 4).await.is_err());
    assert_eq!(store.status().await.unwrap().imported, 2);
}

/// What the check finds, but for the candidates of these tests, which have no walks.
async fn problems(store: &Store) -> Vec<String> {
    let findings = store.check(|_, _| {}).await.unwrap().into_iter().map(|finding| finding.what);
    findings.filter(|what| !what.contains("candidates of missing walks")).collect()
}

#[tokio::test]
async fn imported_structures_wait_for_their_labels_behind_candidates() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let names = accept(&store, 1).await;
    let new = |frame: u64| ("new.extxyz".to_owned(), frame, structure(50.0 + frame as f64));
    let structures = [new(0), ("new.extxyz".to_owned(), 1, structure(1e-6)), new(2)];
    let found = store.queue_imports(&structures, 0, 1).await.unwrap();
    assert_eq!(found, QueuedImports { queued: 2, known: 1 });
    assert_eq!(store.queue_imports(&structures, 0, 2).await.unwrap(), QueuedImports { queued: 0, known: 3 });
    let operations = store.operations(0, 100).await.unwrap();
    let imports: Vec<_> = operations.iter().filter(|line| line.kind == "import").collect();
    assert_eq!((imports.len(), &imports[0].detail["files"]["new.extxyz"]), (1, &2.into()));
    assert_eq!((store.unfinished_jobs().await.unwrap(), store.status().await.unwrap().labels.queued), (3, 3));
    let listed = store.queue_list(Some(JobState::Queued), 10, 0).await.unwrap();
    let listed: Vec<_> = listed.iter().map(|job| (job.candidate.as_str(), job.origin.as_str())).collect();
    assert_eq!(listed, [(names[0].as_str(), "biased"), ("import-1", "imported"), ("import-2", "imported")]);
    assert_eq!(store.queue_list(None, 1, 1).await.unwrap()[0].candidate, "import-1");
    let waiting = store.waiting_jobs(protocol("dft").hash).await.unwrap();
    assert_eq!(waiting.iter().map(|jobs| jobs.jobs).sum::<u64>(), 3);
    assert_eq!(problems(&store).await, [""; 0]);

    store.prioritise_job("import-2", 20, 3).await.unwrap();
    let first = lease(&store, "a", 4).await.unwrap();
    assert_eq!((first.candidate.as_str(), first.model_energy), ("import-2", None));
    assert_eq!(first.structure, structure(52.0));
    assert!(store.near_duplicates(&first, 3).await.unwrap().is_none());
    assert_eq!(store.complete(&first, &label(-5.0), 5).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(lease(&store, "a", 6).await.unwrap().candidate, names[0]);
    assert_eq!(lease(&store, "a", 7).await.unwrap().candidate, "import-1");
    assert_eq!(state(&store, "import-2").await, JobState::Labelled);
    assert!(matches!(store.queue_show("import-3").await, Err(StoreError::UnknownJob { .. })));

    let imported = ExportFilter { protocol: first.protocol, biased: false, control: false, imported: true };
    let rows = store.labelled(&imported, None, 10).await.unwrap();
    assert_eq!(rows.len(), 1);
    assert!(matches!(&rows[0].source, ExportSource::Import { file, frame: 2 } if file == "new.extxyz"));
    let expected = BTreeSet::from([rows[0].cursor]);
    assert_eq!(store.labelled_cursors(&imported).await.unwrap(), expected);
    store.check_for_export().await.unwrap();
    // Walks must not find them again.
    let known = store.known_hashes().await.unwrap();
    assert!(
        [50.0, 52.0].iter().all(|shift| known.contains(&ContentHash::from_structure(&structure(*shift))))
    );
    // An import with labels ends a job that waits.
    store.release_all("a", 8).await.unwrap();
    let labelled = [(0, structure(50.0), label(-7.0))];
    assert_eq!(store.import(first.protocol, "old.extxyz", &labelled, 9).await.unwrap().labels, 1);
    assert_eq!(state(&store, "import-1").await, JobState::Labelled);
    assert_eq!(problems(&store).await, [""; 0]);
}

/// A campaign whose labels arrive in the order `order`. Returns the text of its export, read in pages of `page`.
async fn export_text(order: &[usize], page: u32, filter: &ExportFilter) -> Vec<String> {
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 4).await;
    store.commit(&commit_of(vec![candidate(3, 5, Origin::Control, Fate::Accepted)])).await.unwrap();
    let imports = [(4, structure(50.0), label(-50.0)), (6, structure(40.0), label(-40.0))];
    store.import(filter.protocol, "old.extxyz", &imports, 0).await.unwrap();
    let mut leases = Vec::new();
    while let Some(lease) = lease(&store, "a", 0).await {
        leases.push(lease);
    }
    for k in order {
        let energy = leases[*k].structure.positions[0][0];
        store.complete(&leases[*k], &label(energy), 1).await.unwrap();
    }
    let (mut rows, mut after): (Vec<String>, Option<ExportCursor>) = (Vec::new(), None);
    loop {
        let found = store.labelled(filter, after, page).await.unwrap();
        let Some(last) = found.last() else { return rows };
        assert!(after < Some(last.cursor));
        after = Some(last.cursor);
        rows.extend(found.iter().map(|row| format!("{row:?}")));
    }
}

#[tokio::test]
async fn exports_do_not_depend_on_the_order_of_labels() {
    let filter = |biased, control, imported| ExportFilter {
        protocol: protocol("dft").hash,
        biased,
        control,
        imported,
    };
    let all = filter(true, true, true);
    let rows = export_text(&[0, 1, 2, 3, 4], 100, &all).await;
    assert_eq!(rows.len(), 7);
    assert_eq!(export_text(&[4, 2, 0, 3, 1], 2, &all).await, rows);
    assert_eq!(export_text(&[3, 0, 4, 1, 2], 3, &filter(true, false, true)).await.len(), 6);
    assert_eq!(export_text(&[0, 1, 2, 3, 4], 1, &filter(false, true, false)).await, rows[4..5]);
    assert_eq!(export_text(&[3, 1], 10, &filter(true, false, false)).await, [rows[1].as_str(), &rows[3]]);
}

#[tokio::test]
async fn an_exported_row_has_all_data() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let record = candidate(0, 1, Origin::Biased, Fate::Accepted);
    store.commit(&commit_of(vec![record.clone()])).await.unwrap();
    let lease = lease(&store, "a", 0).await.unwrap();
    store.complete(&lease, &label(-1.0), 1).await.unwrap();
    let filter = ExportFilter { protocol: lease.protocol, biased: true, control: false, imported: false };
    let row = store.labelled(&filter, None, 5).await.unwrap().pop().unwrap();
    assert_eq!((row.structure, row.label), (lease.structure, label(-1.0)));
    assert_eq!((row.protocol_name.as_str(), row.protocol), ("dft", lease.protocol));
    let ExportSource::Candidate { id, seed_structure_name, mixture_version_after, block, original, .. } =
        row.source
    else {
        panic!("not an import")
    };
    assert_eq!((id, seed_structure_name.as_str()), (name_of(&record), "diamond"));
    assert_eq!((mixture_version_after, block.view().mixture_version()), (1, 3));
    assert_eq!((block.view().forces, original), (record.block.view().forces, record.original));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_connections_never_lease_the_same_job() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let records = (1..=60).map(|step| candidate(0, step, Origin::Biased, Fate::Accepted)).collect();
    store.commit(&commit_of(records)).await.unwrap();
    let mut labellers = Vec::new();
    for holder in ["a", "b", "c"] {
        let store = database.open().await;
        labellers.push(tokio::spawn(async move {
            let mut jobs = Vec::new();
            while let Some(lease) = lease(&store, holder, 0).await {
                store.complete(&lease, &label(-1.0), 1).await.unwrap();
                jobs.push(lease.job);
            }
            jobs
        }));
    }
    let (mut all, mut distinct) = (0, BTreeSet::new());
    for labeller in labellers {
        let jobs = labeller.await.unwrap();
        all += jobs.len();
        distinct.extend(jobs);
    }
    assert_eq!((all, distinct.len()), (60, 60));
    assert_eq!(store.status().await.unwrap().labels.labelled, 60);
}

#[tokio::test]
async fn nothing_is_pending_in_an_empty_queue() {
    let database = TestDatabase::new();
    let store = database.create().await;
    assert!(!store.has_pending_labels(0).await.unwrap());
    assert!(!store.all_walks_ended().await.unwrap(), "no walk has begun");
    accept(&store, 1).await;
    assert!(store.has_pending_labels(0).await.unwrap());
    let with_state = |number, state: &str| store::WalkRecord { state: state.into(), ..walk(number, 1) };
    for (state, ended) in [("waiting", false), ("running", false), ("completed", true)] {
        let commit = store::Commit {
            walks: vec![with_state(0, "completed"), with_state(1, state)],
            ..Default::default()
        };
        store.commit(&commit).await.unwrap();
        assert_eq!(store.all_walks_ended().await.unwrap(), ended, "{state}");
    }
}
