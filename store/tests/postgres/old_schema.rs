//! Tables of an earlier version on a server.

use sqlx::ConnectOptions;
use sqlx::sqlite::SqliteConnectOptions;
use store::{ExportFilter, Fate, Location, Store, VersionState};
use wire::Origin;

use super::common::*;
use super::version_records::{version_files, version_record};

/// Turns them into tables of version 8 by undoing what later versions add and rename.
const WITHOUT_CHECKSUMS: &str = "
    ALTER TABLE campaign DROP COLUMN checksum; ALTER TABLE value DROP COLUMN checksum;
    ALTER TABLE structure DROP COLUMN checksum; ALTER TABLE seed_structure DROP COLUMN checksum;
    ALTER TABLE protocol DROP COLUMN checksum; ALTER TABLE decision DROP COLUMN checksum;
    ALTER TABLE candidate DROP COLUMN checksum, DROP COLUMN features_checksum, DROP COLUMN selector_checksum,
        DROP COLUMN original_checksum;
    ALTER TABLE component DROP COLUMN checksum; DROP INDEX label_excluded;
    DROP INDEX label_other;
    ALTER TABLE label DROP COLUMN checksum, DROP COLUMN excluded, DROP COLUMN exclusion;
    ALTER TABLE walk DROP COLUMN checksum, DROP COLUMN checkpoint_checksum;
    ALTER TABLE import DROP COLUMN checksum; ALTER TABLE archive DROP COLUMN checksum;
    DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume; ALTER TABLE walk_progress DROP COLUMN reference_step;
    DROP TABLE walk_trace; DROP INDEX job_order; ALTER TABLE job DROP COLUMN value, DROP COLUMN value_factors;
    CREATE INDEX job_order ON job (state, priority DESC, decision, protocol);
    DROP TABLE walk_conditions; DROP TABLE version_file; DROP TABLE version;
    ALTER TABLE process RENAME COLUMN start_time TO birth; ALTER TABLE leader RENAME COLUMN start_time TO birth;
    ALTER TABLE walk RENAME COLUMN assignments TO turn; ALTER TABLE walk RENAME COLUMN rejected TO refused;
    ALTER TABLE walk RENAME COLUMN rollbacks TO returns; ALTER TABLE walk_progress RENAME TO pace;
    ALTER TABLE label RENAME CONSTRAINT label_status_check TO label_standing_check;
    ALTER TABLE label RENAME COLUMN status TO standing;
    DELETE FROM _sqlx_migrations WHERE version > 8";

async fn exported(location: impl Into<Location>) -> Vec<String> {
    let store = Store::open_read_only(location).await.unwrap();
    let filter = ExportFilter { protocol: protocol("dft").hash, biased: true, control: true, imported: true };
    store.check_for_export().await.unwrap();
    let rows = store.labelled(&filter, None, 100).await.unwrap();
    assert_eq!(rows.len(), store.labelled_cursors(&filter).await.unwrap().len());
    store.close().await;
    rows.iter().map(|row| format!("{row:?}")).collect()
}

#[tokio::test]
async fn tables_without_checksums_are_read_copied_and_migrated() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let records = (1..=3).map(|step| candidate(0, step, Origin::Biased, Fate::Accepted)).collect();
    let walks = vec![store::WalkRecord { accepted: 3, ..walk(0, 1) }];
    store.commit(&store::Commit { walks, ..commit_of(records) }).await.unwrap();
    let lease = store.lease(protocol("dft").hash, "l", 0, 600).await.unwrap().unwrap();
    store.complete(&lease, &label(-1.0), 1).await.unwrap();
    store.import(protocol("dft").hash, "old.extxyz", &[(0, structure(0.5), label(-9.0))], 2).await.unwrap();
    store.close().await;
    let expected = exported(database.location()).await;
    assert_eq!(expected.len(), 2);

    database.execute(WITHOUT_CHECKSUMS).await;
    assert_eq!(exported(database.location()).await, expected);
    let copies = tempfile::tempdir().unwrap();
    let copy = copies.path().join("copy");
    let store = database.open_read_only().await;
    store.backup(&copy, 3, |_, _| {}).await.unwrap();
    store.close().await;
    assert_eq!(exported(copy.as_path()).await, expected);
    let copied = Store::open(copy.as_path()).await.unwrap();
    assert_eq!(copied.check(|_, _| {}).await.unwrap(), []);

    let (one, other) = tokio::join!(Store::open(database.location()), Store::open(database.location()));
    let store = one.unwrap();
    other.unwrap().close().await;
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    database.execute("UPDATE label SET energy = -1.5 WHERE number = 1").await;
    let found = store.check(|_, _| {}).await.unwrap();
    assert!(found.len() == 1 && found[0].what.contains("label 1"), "{found:?}");
    store.close().await;
}

#[tokio::test]
async fn tables_of_version_16_have_no_versions_of_the_potential() {
    let database = TestDatabase::new();
    database.create().await.close().await;
    database.execute(TO_VERSION_16).await;
    let copies = tempfile::tempdir().unwrap();
    let copy = copies.path().join("copy");
    let store = database.open_read_only().await;
    assert_eq!(store.versions().await.unwrap(), []);
    assert_eq!(store.version_files(1).await.unwrap(), None);
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    store.backup(&copy, 3, |_, _| {}).await.unwrap();
    store.close().await;
    for store in [Store::open(copy.as_path()).await.unwrap(), database.open().await] {
        assert_eq!(store.versions().await.unwrap(), []);
        let record = version_record(1, 0, VersionState::Registered);
        store.add_version(&record, Some(&version_files(1))).await.unwrap();
        assert_eq!(store.versions().await.unwrap(), [record]);
        assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
        store.close().await;
    }
}

#[tokio::test]
async fn words_of_version_15_are_read_copied_and_renamed() {
    let database = TestDatabase::new();
    let store = database.create().await;
    write_former_words(&store).await;
    store.close().await;
    database.execute(TO_VERSION_15).await;
    database.execute("ALTER TABLE label RENAME CONSTRAINT label_status_check TO label_standing_check").await;
    let copies = tempfile::tempdir().unwrap();
    let copy = copies.path().join("copy");
    let store = database.open_read_only().await;
    check_present_words(&store).await;
    store.backup(&copy, 3, |_, _| {}).await.unwrap();
    store.close().await;
    let copied = Store::open(copy.as_path()).await.unwrap();
    check_present_words(&copied).await;
    copied.close().await;
    let options = SqliteConnectOptions::new().filename(copy.join(store::DATABASE));
    let mut connection = options.connect().await.unwrap();
    let sql = "SELECT (SELECT count(*) FROM decision WHERE checksum = -1),
        (SELECT count(*) FROM candidate WHERE checksum = -1), (SELECT count(*) FROM walk WHERE checksum = -1)";
    let unknown: (i64, i64, i64) = sqlx::query_as(sql).fetch_one(&mut connection).await.unwrap();
    assert_eq!(unknown, (0, 0, 0), "the copy has all checksums");
    let store = database.open().await;
    check_present_words(&store).await;
    store.close().await;
    database.execute("UPDATE decision SET mixture_version = 77 WHERE sequence = 4").await;
    let store = database.open().await;
    let found = store.check(|_, _| {}).await.unwrap();
    assert!(found.len() == 1 && found[0].what.contains("decision 4"), "{found:?}");
    store.close().await;
}
