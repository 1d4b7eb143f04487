//! Campaigns created by earlier versions of the program.

use std::fs;
use std::path::Path;

use sqlx::migrate::Migrator;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection};
use store::{Commit, DATABASE, JobState, ProcessRecord, Store, VersionState, WalkRecord};

use crate::common::*;
use crate::version_records::{version_files, version_record};

const FIRST: &str = "0001_campaign.sql";

async fn connect(path: &Path) -> SqliteConnection {
    SqliteConnectOptions::new().filename(path).create_if_missing(true).connect().await.unwrap()
}

async fn version(directory: &Path) -> i64 {
    let mut connection = connect(&directory.join(DATABASE)).await;
    sqlx::query_scalar("PRAGMA user_version").fetch_one(&mut connection).await.unwrap()
}

/// Counted candidates.
async fn counts(directory: &Path) -> i64 {
    let mut connection = connect(&directory.join(DATABASE)).await;
    sqlx::query_scalar("SELECT sum(number) FROM candidate_count").fetch_one(&mut connection).await.unwrap()
}

/// Counted label jobs by state.
async fn job_counts(directory: &Path) -> Vec<(String, i64)> {
    let mut connection = connect(&directory.join(DATABASE)).await;
    let sql = "SELECT state, sum(number) FROM job_count GROUP BY state ORDER BY state";
    sqlx::query_as(sql).fetch_all(&mut connection).await.unwrap()
}

/// A campaign as left by a killed version 1, with one leased job. Returns its decision log.
async fn version_1(directory: &Path) -> String {
    let now = tempfile::tempdir().unwrap();
    let store = create(now.path()).await;
    accept(&store, 2).await;
    store.lease(protocol("dft").hash, "old/0", 0, 86_400).await.unwrap().unwrap();
    let log = store.decision_log_text().await.unwrap();
    store.close().await;

    let migrations = tempfile::tempdir().unwrap();
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations/sqlite").join(FIRST);
    fs::copy(source, migrations.path().join(FIRST)).unwrap();
    let mut connection = connect(&directory.join(DATABASE)).await;
    Migrator::new(migrations.path()).await.unwrap().run(&mut connection).await.unwrap();
    let other = now.path().join(DATABASE).to_str().unwrap().to_owned();
    sqlx::query("ATTACH ? AS other").bind(other).execute(&mut connection).await.unwrap();
    sqlx::query("PRAGMA foreign_keys = OFF").execute(&mut connection).await.unwrap();
    let sql =
        "SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT IN ('process', '_sqlx_migrations')";
    let tables: Vec<String> = sqlx::query_scalar(sql).fetch_all(&mut connection).await.unwrap();
    assert!(tables.len() > 10);
    for table in tables {
        // Later versions have more.
        let columns = AssertSqlSafe(format!("SELECT name FROM pragma_table_info('{table}', 'main')"));
        let columns: Vec<String> = sqlx::query_scalar(columns).fetch_all(&mut connection).await.unwrap();
        if columns.is_empty() {
            continue;
        }
        let renamed = |name: &String| match name.as_str() {
            "turn" => "assignments".to_owned(),
            "refused" => "rejected".to_owned(),
            "returns" => "rollbacks".to_owned(),
            "standing" => "status".to_owned(),
            _ => name.clone(),
        };
        let columns = columns.iter().map(renamed).collect::<Vec<_>>().join(", ");
        let copy = format!("INSERT INTO main.{table} SELECT {columns} FROM other.{table}");
        sqlx::query(AssertSqlSafe(copy)).execute(&mut connection).await.unwrap();
    }
    let sums =
        "DELETE FROM campaign WHERE key IN ('labels_made', 'core_milliseconds', 'label_core_milliseconds')";
    assert_eq!(sqlx::query(sums).execute(&mut connection).await.unwrap().rows_affected(), 3);
    let sql = "INSERT INTO process VALUES ('old', 'orchestrator', ?, ?, 5, 6, 'running')";
    let query = sqlx::query(sql).bind(std::process::id()).bind(store::this_host());
    query.execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    assert_eq!(version(directory).await, 1);
    log
}

fn old_process() -> ProcessRecord {
    ProcessRecord {
        id: "old".into(),
        kind: "orchestrator".into(),
        pid: std::process::id(),
        host: store::this_host(),
        started: 5,
        last_seen: 6,
        state: "running".into(),
        ..ProcessRecord::default()
    }
}

#[tokio::test]
async fn a_campaign_of_version_1_opens_read_only_without_migration() {
    let directory = tempfile::tempdir().unwrap();
    let log = version_1(directory.path()).await;
    let before = fs::read(directory.path().join(DATABASE)).unwrap();
    let store = Store::open_read_only(directory.path()).await.unwrap();
    let status = store.status().await.unwrap();
    assert_eq!((status.candidates.accepted, store.accepted_structures().await.unwrap()), (2, 2));
    assert_eq!((status.labels.leased, status.processes), (1, vec![old_process()]));
    assert_eq!(store.processes(Some("orchestrator")).await.unwrap(), [old_process()]);
    assert_eq!(store.decision_log_text().await.unwrap(), log);
    store.close().await;
    assert_eq!(fs::read(directory.path().join(DATABASE)).unwrap(), before);
}

#[tokio::test]
async fn a_campaign_of_version_1_continues() {
    let directory = tempfile::tempdir().unwrap();
    let log = version_1(directory.path()).await;
    let store = Store::open(directory.path()).await.unwrap();
    assert_eq!(version(directory.path()).await, 22);
    assert_eq!(store.decision_log_text().await.unwrap(), log);
    assert_eq!((store.status().await.unwrap().candidates.accepted, counts(directory.path()).await), (2, 2));
    assert_eq!(job_counts(directory.path()).await, [("leased".into(), 1), ("queued".into(), 1)]);
    assert_eq!(store.processes(None).await.unwrap(), [old_process()]);
    // Its process id is in use again, but the lock proves that it is another process.
    assert!(!old_process().is_dead());
    assert_eq!(store.reclaim_leases(7).await.unwrap(), 1);
    assert_eq!(store.processes(None).await.unwrap(), []);
    let queued = store.queue_list(Some(JobState::Queued), 9, 0).await.unwrap();
    assert_eq!((queued.len(), queued[0].failures), (2, 0));
    assert_eq!(job_counts(directory.path()).await, [("leased".into(), 0), ("queued".into(), 2)]);
    let found = store.check(|_, _| {}).await.unwrap();
    assert!(!found.iter().any(|finding| finding.what.contains("counted")), "{found:?}");
    store.close().await;
    Store::open(directory.path()).await.unwrap();
}

#[tokio::test]
async fn columns_of_version_13_are_read_under_their_former_names_and_renamed() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    let walks = vec![WalkRecord { accepted: 0, ..walk(0, 3) }, WalkRecord { accepted: 0, ..walk(1, 0) }];
    store.commit(&Commit { walks: walks.clone(), ..Commit::default() }).await.unwrap();
    let process = ProcessRecord { start_time: "another-boot/1/1".into(), ..old_process() };
    store.upsert_process(&process).await.unwrap();
    store.close().await;
    let mut connection = connect(&directory.path().join(DATABASE)).await;
    let sql = "DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume; ALTER TABLE walk_progress DROP COLUMN reference_step;
    DROP TABLE walk_trace; DROP INDEX job_order; ALTER TABLE job DROP COLUMN value; ALTER TABLE job DROP COLUMN value_factors;
        CREATE INDEX job_order ON job (state, priority DESC, decision, protocol);
        DROP TABLE version_file; DROP TABLE version;
        ALTER TABLE process RENAME COLUMN start_time TO birth;
        ALTER TABLE walk RENAME COLUMN assignments TO turn; ALTER TABLE walk RENAME COLUMN rejected TO refused;
        ALTER TABLE walk RENAME COLUMN rollbacks TO returns; ALTER TABLE walk_progress RENAME TO pace;
        ALTER TABLE label RENAME COLUMN status TO standing; PRAGMA user_version = 13;
        DELETE FROM _sqlx_migrations WHERE version > 13;";
    sqlx::raw_sql(sql).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    for (writes, expected) in [(false, 13), (true, 22)] {
        let path = directory.path();
        let store = if writes { Store::open(path).await } else { Store::open_read_only(path).await }.unwrap();
        assert_eq!(store.load_walks().await.unwrap(), walks);
        assert_eq!(store.processes(None).await.unwrap(), std::slice::from_ref(&process));
        assert_eq!(store.status().await.unwrap().walks.len(), 2);
        assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
        store.close().await;
        assert_eq!(version(path).await, expected);
    }
}

/// A campaign of version 15 with the words of that version.
async fn version_15(directory: &Path) -> SqliteConnection {
    let store = create(directory).await;
    write_former_words(&store).await;
    store.close().await;
    let mut connection = connect(&directory.join(DATABASE)).await;
    sqlx::raw_sql(TO_VERSION_15).execute(&mut connection).await.unwrap();
    sqlx::raw_sql("PRAGMA user_version = 15").execute(&mut connection).await.unwrap();
    connection
}

#[tokio::test]
async fn words_of_version_15_are_read_and_renamed() {
    let directory = tempfile::tempdir().unwrap();
    version_15(directory.path()).await.close().await.unwrap();
    let store = Store::open_read_only(directory.path()).await.unwrap();
    check_present_words(&store).await;
    store.close().await;
    assert_eq!(version(directory.path()).await, 15);
    let store = Store::open(directory.path()).await.unwrap();
    check_present_words(&store).await;
    store.close().await;
    let mut connection = connect(&directory.path().join(DATABASE)).await;
    let sql = "SELECT (SELECT count(*) FROM candidate WHERE checksum = -1),
        (SELECT count(*) FROM candidate WHERE reason = 'too_close'), (SELECT class FROM attempt)";
    let found: (i64, i64, String) = sqlx::query_as(sql).fetch_one(&mut connection).await.unwrap();
    assert_eq!(found, (0, 1, "node_failure".to_owned()));
}

#[tokio::test]
async fn a_campaign_of_version_16_has_no_versions_of_the_potential() {
    let directory = tempfile::tempdir().unwrap();
    create(directory.path()).await.close().await;
    let mut connection = connect(&directory.path().join(DATABASE)).await;
    sqlx::raw_sql(TO_VERSION_16).execute(&mut connection).await.unwrap();
    sqlx::raw_sql("PRAGMA user_version = 16").execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    for (writes, expected) in [(false, 16), (true, 22)] {
        let path = directory.path();
        let store = if writes { Store::open(path).await } else { Store::open_read_only(path).await }.unwrap();
        assert_eq!(store.versions().await.unwrap(), []);
        assert_eq!(store.version_files(1).await.unwrap(), None);
        assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
        if writes {
            let record = version_record(1, 0, VersionState::Registered);
            store.add_version(&record, Some(&version_files(1))).await.unwrap();
            assert_eq!(store.version_files(1).await.unwrap(), Some(version_files(1)));
        }
        store.close().await;
        assert_eq!(version(path).await, expected);
    }
}

#[tokio::test]
async fn jobs_of_version_17_have_no_values() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    let names = accept(&store, 2).await;
    store.close().await;
    let mut connection = connect(&directory.path().join(DATABASE)).await;
    sqlx::raw_sql(TO_VERSION_17).execute(&mut connection).await.unwrap();
    sqlx::raw_sql("PRAGMA user_version = 17").execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    for (writes, expected) in [(false, 17), (true, 22)] {
        let path = directory.path();
        let store = if writes { Store::open(path).await } else { Store::open_read_only(path).await }.unwrap();
        let jobs = store.queue_list(Some(JobState::Queued), 9, 0).await.unwrap();
        assert_eq!(jobs.iter().map(|job| job.candidate.clone()).collect::<Vec<_>>(), names);
        assert!(jobs.iter().all(|job| job.value.is_none() && job.value_factors.is_none()));
        assert_eq!(store.list_queue(JobState::Queued, None, 9).await.unwrap().len(), 2);
        store.close().await;
        assert_eq!(version(path).await, expected);
    }
    let store = Store::open(directory.path()).await.unwrap();
    let job = store.queue_show(&names[1]).await.unwrap().job.job;
    let value = store::LabelValue { job, value: 2.0, factors: serde_json::json!({}) };
    assert_eq!(store.set_label_values(&[value]).await.unwrap(), 1);
    let lease = store.lease(protocol("dft").hash, "a", 0, 60).await.unwrap().unwrap();
    assert_eq!(lease.candidate, names[1]);
}

#[tokio::test]
async fn a_new_word_covers_up_no_damage() {
    let directory = tempfile::tempdir().unwrap();
    let mut connection = version_15(directory.path()).await;
    let sql = "UPDATE decision SET mixture_version = 77 WHERE sequence = 4";
    sqlx::query(sql).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    let store = Store::open(directory.path()).await.unwrap();
    let found = store.check(|_, _| {}).await.unwrap();
    assert!(found.len() == 1 && found[0].what.contains("decision 4"), "{found:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_processes_may_migrate_it() {
    for _ in 0..10 {
        let directory = tempfile::tempdir().unwrap();
        version_1(directory.path()).await;
        let path = directory.path().to_owned();
        let open = |path: std::path::PathBuf| tokio::spawn(async move { Store::open(&path).await });
        for opened in [open(path.clone()), open(path.clone()), open(path)] {
            opened.await.unwrap().unwrap().processes(None).await.unwrap();
        }
    }
}
