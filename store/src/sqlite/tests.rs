//! Tests of internals: query plans, connection settings, a full disk.

use std::path::Path;

use sqlx::AssertSqlSafe;
use wire::CampaignId;

use super::file::{DatabaseFile, PAGE_SIZE, WAL_PAGES};
use super::open::{APPLICATION, MIGRATIONS, SCHEMA};
use crate::Store;
use crate::check;
use crate::database::Database;
use crate::error::StoreError;
use crate::records::{CampaignRecord, Commit, ComponentRecord};
use crate::tables::{
    attempt_end, candidate_history, exclude, export, feature_sample, job_counts, label_arrivals,
    label_values, labelled, listing, lower_states, outcomes, queue, queue_admin, recent, status, structures,
    versions, without_label,
};

/// The store in a directory, and its file.
async fn store(directory: &Path) -> (Store, DatabaseFile) {
    let campaign = CampaignRecord {
        id: CampaignId([1; 16]),
        program_version: "0".into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let store = Store::create(directory, &campaign, &[], 0).await.unwrap();
    let Database::Sqlite(file) = store.database.clone() else { panic!("a directory is on no server") };
    (store, file)
}

async fn plan(file: &DatabaseFile, sql: &str) -> String {
    let explain = AssertSqlSafe(format!("EXPLAIN QUERY PLAN {sql}"));
    let rows: Vec<(i64, i64, i64, String)> =
        sqlx::query_as(explain).fetch_all(file.writer.as_ref().unwrap()).await.unwrap();
    rows.into_iter().map(|(.., step)| step + "\n").collect()
}

#[tokio::test]
async fn frequent_queries_use_indexes() {
    let directory = tempfile::tempdir().unwrap();
    let (_store, file) = store(directory.path()).await;
    for sql in [
        queue::NEXT,
        queue::EXPIRED,
        queue::UNFINISHED,
        queue::HELD,
        queue::HELD_BY,
        attempt_end::LOSSES,
        queue_admin::FIND,
        export::CANDIDATES,
        export::LISTED,
        export::IMPORTS,
        feature_sample::NUMBER,
        feature_sample::SAMPLED,
        feature_sample::FEATURES,
        candidate_history::NUMBERED,
        candidate_history::BEGINNING,
        candidate_history::FIRST,
        candidate_history::LAST,
        candidate_history::SAME_STRUCTURE,
        candidate_history::JOBS,
        candidate_history::LABELS,
        candidate_history::AT_STEP,
        candidate_history::BEFORE,
        candidate_history::AFTER,
        structures::CURRENT,
        exclude::LABEL_STATUS,
        lower_states::OF_STRUCTURE,
        listing::NEWEST,
        listing::OLDEST,
        listing::NEWEST_OF_FATE,
        listing::OLDEST_OF_FATE,
        listing::LARGEST_GAMMA,
        listing::SMALLEST_GAMMA,
        listing::LARGEST_VOLUME,
        listing::SMALLEST_VOLUME,
        listing::OF_WALK,
        label_values::FINISHED_AFTER,
        labelled::AFTER,
        labelled::OF_DECISIONS,
        job_counts::LABELS_SINCE,
        label_arrivals::PAGE,
        outcomes::CORES_IN_USE,
        recent::NEWEST,
        status::ACCEPTED,
        versions::FILE,
        versions::NEXT,
        without_label::ACCEPTED,
    ] {
        // A page is a result of an index and has a bounded length.
        let plan = plan(&file, sql).await.replace("SCAN CONSTANT ROW", "").replace("SCAN page", "");
        assert!(!plan.contains("SCAN") && !plan.contains("TEMP B-TREE"), "{sql}\n{plan}");
    }
    for sql in [queue_admin::LIST, listing::QUEUE] {
        let page = plan(&file, sql).await;
        assert!(page.contains("USING COVERING INDEX job_order (state=?"), "{page}");
    }
    for sql in [listing::NEWEST_OF_WALK, listing::OLDEST_OF_WALK] {
        let page = plan(&file, sql).await.replace("SCAN page", "");
        assert!(
            page.contains("SEARCH candidate USING COVERING INDEX") && page.contains("(id>? AND id<?)"),
            "{page}"
        );
        assert!(!page.contains("SCAN"), "{page}");
    }
    for sql in [
        listing::NEWEST_OF_STATE,
        listing::OLDEST_OF_STATE,
        listing::LARGEST_GAMMA_OF_STATE,
        listing::SMALLEST_GAMMA_OF_STATE,
        listing::LARGEST_VOLUME_OF_STATE,
        listing::SMALLEST_VOLUME_OF_STATE,
    ] {
        let page = plan(&file, sql.all).await.replace("SCAN page", "");
        assert!(page.contains("SEARCH job USING INDEX job_order (state=?)"), "{page}");
        assert!(page.contains("SEARCH candidate USING INDEX candidate_structure"), "{page}");
        assert!(!page.contains("SCAN"), "{page}");
        // A bounded number of rows of an index, in its order.
        let near = plan(&file, sql.near).await.replace("SCAN page", "").replace("SCAN candidate\n", "");
        assert!(near.contains("SEARCH candidate USING I"), "{near}");
        assert!(!near.contains("SCAN"), "{near}");
    }
    for sql in [listing::NEWEST_WITHIN_FATE, listing::OLDEST_WITHIN_FATE] {
        let page = plan(&file, sql).await.replace("SCAN page", "");
        let index = "SEARCH candidate USING INDEX candidate_fate (origin=? AND fate=? AND reason=? AND rowid>? AND rowid<?)";
        assert!(page.contains(index) && !page.contains("SCAN"), "{page}");
    }
    for sql in [listing::NEWEST_WITHIN, listing::OLDEST_WITHIN] {
        let page = plan(&file, sql).await.replace("SCAN page", "");
        assert!(page.contains("SEARCH candidate USING INTEGER PRIMARY KEY (rowid>? AND rowid<?)"), "{page}");
        assert!(!page.contains("SCAN"), "{page}");
    }
    let sum = plan(&file, label_arrivals::SUM).await;
    assert!(
        sum.contains("SCAN label USING COVERING INDEX label_of") && !sum.contains("SCAN candidate"),
        "{sum}"
    );
    let by_structure = plan(&file, check::export::CANDIDATES).await;
    assert!(by_structure.contains("SEARCH candidate USING INDEX candidate_structure"), "{by_structure}");
    for sql in [lower_states::ALL, lower_states::COUNT] {
        let plan = plan(&file, sql).await;
        assert!(plan.contains("SCAN other USING INDEX label_other"), "{plan}");
    }
    for sql in [status::COUNTED_FATES, job_counts::COUNTED_STATES] {
        let plan = plan(&file, sql).await;
        assert!(plan.contains("COVERING INDEX") && !plan.contains("TEMP B-TREE"), "{sql}\n{plan}");
    }
}

#[tokio::test]
async fn connections_survive_power_loss_and_use_large_pages() {
    let directory = tempfile::tempdir().unwrap();
    let (_store, file) = store(directory.path()).await;
    let pool = file.writer.as_ref().unwrap();
    let journal: String = sqlx::query_scalar("PRAGMA journal_mode").fetch_one(pool).await.unwrap();
    assert_eq!(journal, "wal");
    for (sql, expected) in [
        ("PRAGMA synchronous", 2),
        ("PRAGMA foreign_keys", 1),
        ("PRAGMA page_size", i64::from(PAGE_SIZE)),
        ("PRAGMA wal_autocheckpoint", i64::from(WAL_PAGES)),
        ("PRAGMA application_id", APPLICATION),
        ("PRAGMA user_version", SCHEMA),
    ] {
        let found: i64 = sqlx::query_scalar(sql).fetch_one(pool).await.unwrap();
        assert_eq!(found, expected, "{sql}");
    }
    assert_eq!(MIGRATIONS.iter().count() as i64, SCHEMA, "a migration for every version");
}

#[tokio::test]
async fn a_full_disk_is_reported_and_loses_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let (store, file) = store(directory.path()).await;
    let component = |size| Commit {
        components: vec![ComponentRecord { element: 0, slot: 0, bytes: vec![7; size] }],
        ..Commit::default()
    };
    store.commit(&component(10)).await.unwrap();
    // SQLite reports a limit on the file size like a full disk.
    let pool = file.writer.as_ref().unwrap();
    let pages: i64 = sqlx::query_scalar("PRAGMA page_count").fetch_one(pool).await.unwrap();
    sqlx::query(AssertSqlSafe(format!("PRAGMA max_page_count = {}", pages + 2))).execute(pool).await.unwrap();
    let error = store.commit(&component(1_000_000)).await.unwrap_err();
    assert!(matches!(error, StoreError::DiskFull) && error.is_transient(), "{error:?}");
    assert_eq!(store.load_components().await.unwrap()[0].bytes, [7; 10]);
    sqlx::query("PRAGMA max_page_count = 1000000").execute(pool).await.unwrap();
    store.commit(&component(1_000_000)).await.unwrap();
    assert_eq!(store.load_components().await.unwrap()[0].bytes.len(), 1_000_000);
}

#[tokio::test]
async fn a_database_that_another_program_holds_is_busy() {
    let directory = tempfile::tempdir().unwrap();
    let (store, file) = store(directory.path()).await;
    let pool = file.writer.as_ref().unwrap();
    sqlx::query("PRAGMA busy_timeout = 20").execute(pool).await.unwrap();
    let other = Store::open(directory.path()).await.unwrap();
    let held = other.database.begin().await.unwrap();
    let error = store.commit(&Commit::default()).await.unwrap_err();
    assert!(matches!(error, StoreError::Busy) && error.is_transient(), "{error:?}");
    drop(held);
    sqlx::query("PRAGMA busy_timeout = 30000").execute(pool).await.unwrap();
    store.commit(&Commit::default()).await.unwrap();
}
