//! Findings of `Store::check`, each in a campaign with one kind of damage.

use store::{Commit, Decision, Fate, Finding, Store, VersionState};
use wire::Origin;
use wire::messages::DeclineReason;

use crate::common::*;
use crate::version_records::{version_files, version_record};

/// Two walks with a structure each, one of them labelled, a declined candidate, a decision without a candidate, a
/// registered version of the potential and a refused one.
pub async fn whole(database: &TestDatabase) -> Store {
    let store = database.create().await;
    let records = vec![
        candidate(0, 1, Origin::Biased, Fate::Accepted),
        candidate(0, 2, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
        candidate(1, 1, Origin::Control, Fate::Accepted),
    ];
    let mut commit = Commit { walks: vec![walk(0, 1), walk(1, 1)], ..commit_of(records) };
    let ended = Decision { kind: "ended", candidate: None, ..commit.decisions[0].clone() };
    commit.decisions.extend([ended.clone(), ended]);
    store.commit(&commit).await.unwrap();
    let lease = store.lease(protocol("dft").hash, "l", 0, 600).await.unwrap().unwrap();
    store.complete(&lease, &label(-1.0), 1).await.unwrap();
    // An empty compressed tar file.
    let packed = zstd::encode_all(&[0; 1024][..], 3).unwrap();
    store.keep_archive(lease.job, lease.attempt, &packed, "").await.unwrap();
    let version = version_record(1, 0, VersionState::Registered);
    store.add_version(&version, Some(&version_files(1))).await.unwrap();
    store.add_version(&version_record(2, 1, VersionState::Refused), None).await.unwrap();
    store
}

async fn check(store: &Store) -> Vec<Finding> {
    let mut rows = (0, 0);
    let findings = store.check(|read, all| rows = (read, all)).await.unwrap();
    assert!(rows.0 > 0 && (rows.0 == rows.1 || !findings.is_empty()), "{rows:?}");
    findings
}

#[tokio::test]
async fn an_intact_campaign_has_no_findings() {
    let database = TestDatabase::new();
    assert_eq!(check(&whole(&database).await).await, []);
    assert_eq!(check(&database.open_read_only().await).await, []);
}

#[tokio::test]
async fn each_kind_of_damage_is_found_and_described() {
    for (damage, words) in [
        (
            "DELETE FROM decision WHERE sequence = 4",
            "1 gaps in the decision log, before the decision (such as 5)",
        ),
        (
            "UPDATE decision SET candidate = 'x' WHERE sequence = 1",
            "1 candidates that contradict their decision",
        ),
        ("UPDATE decision SET candidate = 'x' WHERE sequence = 5", "1 decisions on missing candidates"),
        (
            "UPDATE decision SET kind = 'declined' WHERE sequence = 3",
            "1 candidates that contradict their decision",
        ),
        ("DELETE FROM candidate_data WHERE decision = 2", "1 candidates without their structure and grades"),
        ("UPDATE walk SET accepted = 7 WHERE walk = 0", "1 walks with a wrong count of accepted structures"),
        ("DELETE FROM walk WHERE walk = 1", "1 candidates of missing walks"),
        ("DELETE FROM job WHERE state = 'queued'", "1 accepted candidates without a label job"),
        ("UPDATE job SET state = 'queued'", "1 jobs labelled without a label, or not labelled despite one"),
        (
            "UPDATE candidate_count SET number = 7 WHERE fate = 'covered'",
            "1 kinds of candidates are counted wrongly (such as biased covered)",
        ),
        (
            "DELETE FROM candidate_count",
            "3 kinds of candidates are counted wrongly (such as biased accepted)",
        ),
        (
            "UPDATE job_count SET number = 7 WHERE state = 'queued'",
            "1 kinds of label jobs are counted wrongly (such as queued)",
        ),
        ("DELETE FROM label", "1 jobs labelled without a label, or not labelled despite one"),
        ("DELETE FROM archive; DELETE FROM attempt", "1 labels that do not belong to their job"),
        ("UPDATE job SET attempts = 5 WHERE state = 'queued'", "1 jobs with a wrong count of attempts"),
        ("UPDATE attempt SET ended = NULL, outcome = NULL", "1 running attempts at jobs that are not leased"),
        (
            "UPDATE structure SET data = substr(data, 1, 80) WHERE number = 2",
            "structure 2: it does not match its hash",
        ),
        ("UPDATE candidate_data SET block = substr(block, 1, 300) WHERE decision = 1", "candidate 1: "),
        (
            "UPDATE candidate_data SET block = (SELECT block FROM candidate_data WHERE decision = 2) WHERE decision = 3",
            "candidate 3: its block is that of 9f9f9f9f-0.0.2-",
        ),
        (
            "UPDATE candidate_data SET features = substr(features, 1, 20) WHERE decision = 2",
            "candidate 2: its features: ",
        ),
        ("UPDATE label SET forces = substr(forces, 1, 24)", "label 1: 1 forces for 2 atoms"),
        ("UPDATE decision SET detail = '{' WHERE sequence = 5", "decision 5: its text is not valid JSON"),
        (
            "UPDATE archive SET bytes = substr(bytes, 1, 8)",
            "files of job 1, attempt 1: it cannot be unpacked",
        ),
        (
            "UPDATE version SET number = 5 WHERE number = 2",
            "1 versions of the potential with a number below 1 or after a gap (such as 5)",
        ),
        (
            "UPDATE version SET parent = 2 WHERE number = 2",
            "1 versions of the potential without a registered parent (such as 2)",
        ),
        (
            "INSERT INTO version_file SELECT 2, name, data FROM version_file WHERE name = 'model'",
            "1 files of versions of the potential that are not registered (such as 2)",
        ),
        (
            "UPDATE decision SET kind = 'version', detail = '{\"version\":2}' WHERE sequence = 5",
            "decision 5 switches to version 2 of the potential, which is not registered",
        ),
        (
            "UPDATE decision SET kind = 'version', detail = '{\"version\":1,\"model\":\"a\"}' WHERE sequence = 5",
            "decision 5 switches to version 1 of the potential, which has other files than the decision names",
        ),
        (
            "INSERT INTO walk_conditions (walk, conditions) VALUES (7, '{\"version\":1}')",
            "1 walks with versions of the potential that no decision switches to (such as 7)",
        ),
        ("DELETE FROM version_file WHERE name = 'mixture'", "the mixture of version 1: it is missing"),
        ("UPDATE version_file SET data = substr(data, 1, 3)", "the model of version 1: its BLAKE3 hash is "),
        ("UPDATE version SET labels = 7 WHERE number = 2", "version 2: its content has the checksum "),
    ] {
        let database = TestDatabase::new();
        let store = whole(&database).await;
        database.execute(damage).await;
        let findings: Vec<_> = check(&store).await.iter().map(Finding::to_string).collect();
        assert!(findings.iter().any(|finding| finding.starts_with(words)), "{damage}: {findings:#?}");
        assert!(
            findings.iter().all(|finding| finding.rsplit_once(": ").is_some_and(|(_, then)| then.len() > 20))
        );
    }
}

#[tokio::test]
async fn leases_without_a_holder_are_found() {
    let database = TestDatabase::new();
    let store = whole(&database).await;
    store.lease(protocol("dft").hash, "nobody", 0, 600).await.unwrap().unwrap();
    let found = check(&store).await;
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(
        found[0].to_string().contains("1 jobs are leased to processes that are gone (such as 2 to nobody)")
    );
    store.release_leases_of_dead_processes(1).await.unwrap();
    assert_eq!(check(&store).await, []);
}
