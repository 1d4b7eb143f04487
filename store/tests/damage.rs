//! Silent damage: flipped bits in stored numbers, and changed bytes in the file.
//!
//! `CALMWALK_FLIPS=1000 CALMWALK_DAMAGES=200 cargo test -p store --test store damage::` tries more.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Row};
use store::{Commit, ComponentRecord, DATABASE, ExportFilter, Fate, Store, StoreError, VersionState};
use wire::Origin;
use wire::messages::DeclineReason;

use crate::assignments::assignment;
use crate::common::*;
use crate::trajectory::trajectory_part;
use crate::version_records::{version_files, version_record};
use crate::walk_trace::trace_point;

/// Columns whose bits are flipped: numbers of labels, structures, features, grades, decisions, the mixture, walks,
/// archives, seed structures, imports, versions of the potential, traces and assignments of walks. Keys are left out: foreign keys and other rows
/// check them.
const COLUMNS: [(&str, &[&str]); 18] = [
    ("structure", &["hash", "atoms", "data", "checksum"]),
    ("seed_structure", &["structure", "checksum"]),
    ("protocol", &["hash", "checksum"]),
    ("decision", &["round", "walk", "mixture_version", "detail", "checksum"]),
    (
        "candidate",
        &[
            "content",
            "walk",
            "segment",
            "step",
            "seed_structure",
            "mixture_version",
            "atoms",
            "temperature",
            "relative_volume",
            "energy",
            "walker_gamma",
            "walker_gamma_nbr",
            "walker_above",
            "selector_gamma",
            "selector_gamma_nbr",
            "selector_above",
            "original_gamma",
            "original_gamma_nbr",
            "original_above",
            "checksum",
            "features_checksum",
            "selector_checksum",
            "original_checksum",
        ],
    ),
    ("candidate_data", &["block", "features", "selector_grades", "original_grades"]),
    ("component", &["bytes", "checksum"]),
    (
        "walk",
        &[
            "assignments",
            "accepted",
            "step",
            "segment",
            "tau",
            "temperature",
            "relative_volume",
            "gamma_max",
            "rejected",
            "rollbacks",
            "checkpoint",
            "checksum",
            "checkpoint_checksum",
        ],
    ),
    ("label", &["energy", "forces", "stress", "received", "details", "checksum"]),
    ("import", &["frame", "checksum"]),
    ("archive", &["bytes", "left_out", "checksum"]),
    ("value", &["value", "checksum"]),
    (
        "version",
        &[
            "parent",
            "state",
            "method",
            "structures",
            "last_decision",
            "labels",
            "model_hash",
            "mixture_hash",
            "figures",
            "seconds",
            "core_hours",
            "time",
            "checksum",
        ],
    ),
    ("version_file", &["data"]),
    ("walk_trace", &["points", "data", "checksum"]),
    ("trajectory", &["frames", "data", "checksum"]),
    (
        "assignment",
        &[
            "number",
            "mixture_version",
            "threshold_factor",
            "verdict",
            "start_segment",
            "start_step",
            "segment",
            "step",
            "reference_step",
            "checksum",
        ],
    ),
    ("reference_volume", &["volume", "checksum"]),
];

fn wanted(variable: &str, by_default: u64) -> u64 {
    std::env::var(variable).map_or(by_default, |text| text.parse().expect("a number"))
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }
}

/// A campaign with rows in every table and this many accepted candidates.
async fn full(directory: &Path, accepted: u64) -> Store {
    let store = create(directory).await.with_caller_clock();
    for step in 1..=accepted {
        let kind = if step % 3 == 0 { Origin::Control } else { Origin::Biased };
        let mut records = vec![candidate(0, step, kind, Fate::Accepted)];
        records.push(candidate(1, step, Origin::Biased, Fate::Declined(DeclineReason::Covered)));
        let mut walks = vec![walk(0, step), walk(1, step)];
        walks[0].accepted = u32::try_from(step).unwrap();
        walks[1].accepted = 0;
        let components = vec![ComponentRecord { element: 0, slot: 1, bytes: step.to_le_bytes().repeat(20) }];
        let values = vec![("round".to_owned(), step.to_string())];
        walks[0].progress.reference_volume = Some(540.25);
        let traces = vec![(walks[0].walk, vec![trace_point(step - 1)])];
        let (assignments, rest) = (vec![assignment(0, step - 1)], commit_of(records));
        let trajectories = vec![trajectory_part(0, step - 1, 2)];
        let commit = Commit { walks, components, values, traces, assignments, trajectories, ..rest };
        store.commit(&commit).await.unwrap();
    }
    for number in 0..accepted * 3 / 4 {
        let lease = store.lease(protocol("dft").hash, "l", 0, 600).await.unwrap().unwrap();
        let mut made = label(-1.5 - number as f64);
        made.details.magnetisation = Some(0.25);
        store.complete(&lease, &made, 1).await.unwrap();
        if number == 0 {
            store
                .keep_archive(lease.job, 1, &zstd::encode_all(&[0; 1024][..], 3).unwrap(), "x")
                .await
                .unwrap();
        }
    }
    let frames: Vec<_> = (0..accepted / 4).map(|k| (k, structure(0.5 + k as f64), label(-9.0))).collect();
    store.import(protocol("dft").hash, "old.extxyz", &frames, 2).await.unwrap();
    let version = version_record(1, 0, VersionState::Registered);
    store.add_version(&version, Some(&version_files(1))).await.unwrap();
    store
}

async fn connect(directory: &Path) -> SqliteConnection {
    let options = SqliteConnectOptions::new().filename(directory.join(DATABASE)).foreign_keys(false);
    options.connect().await.unwrap()
}

/// Flips a bit of a value in a random row. Returns SQL that undoes it; `None` if the value has no number.
async fn flip(connection: &mut SqliteConnection, random: &mut Random) -> Option<(String, String)> {
    let (table, columns) = COLUMNS[random.below(COLUMNS.len())];
    let column = columns[random.below(columns.len())];
    let keys = match table {
        "component" => "element || ',' || slot",
        "archive" => "job || ',' || attempt",
        "assignment" => "walk || ',' || part",
        "value" => "name",
        _ => "rowid",
    };
    let sql = AssertSqlSafe(format!("SELECT {keys}, typeof({column}), quote({column}) FROM {table}"));
    let rows = sqlx::query(sql).fetch_all(&mut *connection).await.unwrap();
    let row = &rows[random.below(rows.len())];
    let key = row.try_get::<i64, _>(0).map_or_else(|_| row.get::<String, _>(0), |key| key.to_string());
    let (kind, before): (String, String) = (row.get(1), row.get(2));
    let after = match kind.as_str() {
        "integer" => (before.parse::<i64>().unwrap() ^ (1 << random.below(63))).to_string(),
        "real" => {
            let sql = AssertSqlSafe(format!("SELECT {column} FROM {table} WHERE {keys} = '{key}'"));
            let value: f64 = sqlx::query_scalar(sql).fetch_one(&mut *connection).await.unwrap();
            let flipped = f64::from_bits(value.to_bits() ^ (1 << random.below(64)));
            // SQLite has no NaN; the value becomes NULL.
            if flipped.is_finite() { format!("{flipped:e}") } else { "9e999".to_owned() }
        }
        "blob" | "text" => {
            let hex =
                AssertSqlSafe(format!("SELECT CAST({column} AS BLOB) FROM {table} WHERE {keys} = '{key}'"));
            let mut bytes: Vec<u8> = sqlx::query_scalar(hex).fetch_one(&mut *connection).await.unwrap();
            if bytes.is_empty() {
                return None;
            }
            let at = random.below(bytes.len());
            // Only valid text: readers detect invalid text anyway.
            bytes[at] ^= 1 << random.below(if kind == "text" { 7 } else { 8 });
            let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
            if kind == "text" { format!("CAST(x'{hex}' AS TEXT)") } else { format!("x'{hex}'") }
        }
        _ => return None,
    };
    // A key of two numbers is compared as text.
    let set = |value: &str| format!("UPDATE {table} SET {column} = {value} WHERE {keys} = '{key}'");
    let undo = match kind.as_str() {
        // Its text form has fewer digits.
        "real" => {
            let sql = AssertSqlSafe(format!("SELECT {column} FROM {table} WHERE {keys} = '{key}'"));
            let value: f64 = sqlx::query_scalar(sql).fetch_one(&mut *connection).await.unwrap();
            set(&format!("{value:e}"))
        }
        _ => set(&before),
    };
    let changed = sqlx::query(AssertSqlSafe(set(&after))).execute(&mut *connection).await;
    // Values that violate a constraint are skipped: SQLite's own check finds them.
    match changed {
        Ok(changed) => assert_eq!(changed.rows_affected(), 1, "{}", set(&after)),
        Err(error) => panic!("{}: {error}", set(&after)),
    }
    Some((format!("{table}.{column} of {key}: {before} became {after}"), undo))
}

#[tokio::test]
async fn every_flipped_bit_in_a_stored_number_is_found() {
    let directory = tempfile::tempdir().unwrap();
    let store = full(directory.path(), 12).await;
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    let mut connection = connect(directory.path()).await;
    sqlx::query("PRAGMA ignore_check_constraints = ON").execute(&mut connection).await.unwrap();
    let (mut random, mut flips) = (Random(14), 0);
    while flips < wanted("CALMWALK_FLIPS", 100) {
        let Some((what, undo)) = flip(&mut connection, &mut random).await else { continue };
        flips += 1;
        let found = store.check(|_, _| {}).await.unwrap();
        assert!(!found.is_empty(), "{what}");
        sqlx::query(AssertSqlSafe(undo)).execute(&mut connection).await.unwrap();
    }
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
}

/// What a reader of labels gets, then the export in order.
async fn exported(directory: &Path) -> Result<BTreeMap<String, String>, StoreError> {
    let store = Store::open_read_only(directory).await?;
    let exported = read(&store).await;
    store.close().await;
    exported
}

async fn read(store: &Store) -> Result<BTreeMap<String, String>, StoreError> {
    let filter = ExportFilter { protocol: protocol("dft").hash, biased: true, control: true, imported: true };
    store.check_for_export().await?;
    let (mut missing, mut last, mut rows) = (store.labelled_cursors(&filter).await?, None, BTreeMap::new());
    loop {
        let page = store.labelled(&filter, last, 7).await?;
        let Some(row) = page.last() else { break };
        last = Some(row.cursor);
        for row in page {
            missing.remove(&row.cursor);
            rows.insert(format!("{:?}", row.cursor), format!("{row:?}"));
        }
    }
    match missing.is_empty() {
        true => Ok(rows),
        // Refused as by `calmwalk export`.
        false => {
            Err(StoreError::Damaged { what: "an export".into(), reason: format!("{missing:?} are missing") })
        }
    }
}

/// Damages the file as a disk may do, and describes how.
fn damage(bytes: &mut Vec<u8>, page: usize, random: &mut Random) -> String {
    let pages = bytes.len() / page;
    let of = |number: usize| number * page..(number + 1) * page;
    match random.below(6) {
        0 | 1 => {
            let places: Vec<_> = (0..=random.below(16)).map(|_| random.below(bytes.len())).collect();
            places.iter().for_each(|at| bytes[*at] = random.next() as u8);
            format!("bytes {places:?}")
        }
        2 => {
            let number = random.below(pages);
            bytes[of(number)].fill(0);
            format!("page {number} is zero")
        }
        3 => {
            let (from, to) = (random.below(pages), random.below(pages));
            bytes.copy_within(of(from), to * page);
            format!("page {to} is page {from}")
        }
        4 => {
            let end = random.below(bytes.len());
            bytes.truncate(end);
            format!("the file ends at {end}")
        }
        // Changes the number of cells of a page, or the page after its last cell: rows or whole subtrees are
        // skipped.
        _ => {
            let (number, at) = (1 + random.below(pages - 1), [3, 4, 8, 9, 10, 11][random.below(6)]);
            bytes[number * page + at] = bytes[number * page + at].wrapping_sub(1 + random.below(3) as u8);
            format!("byte {at} of page {number}")
        }
    }
}

#[tokio::test]
async fn a_damaged_database_exports_the_original_data_or_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let store = full(directory.path(), 60).await;
    store.close().await;
    let mut connection = connect(directory.path()).await;
    let page: i64 = sqlx::query_scalar("PRAGMA page_size").fetch_one(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    let whole = fs::read(directory.path().join(DATABASE)).unwrap();
    let expected = exported(directory.path()).await.unwrap();
    // 45 of 60 are labelled by jobs, 15 imported.
    assert_eq!(expected.len(), 60);
    let (mut random, mut refused) = (Random(200), 0);
    for _ in 0..wanted("CALMWALK_DAMAGES", 30) {
        let mut damaged = whole.clone();
        let what = damage(&mut damaged, page as usize, &mut random);
        let copy = tempfile::tempdir().unwrap();
        fs::write(copy.path().join(DATABASE), damaged).unwrap();
        match exported(copy.path()).await {
            Ok(rows) => assert!(rows == expected, "{what}: {} of {}", rows.len(), expected.len()),
            Err(_) => refused += 1,
        }
    }
    assert!(refused > 0);
}

/// An index entry is missing, as after damage to its page.
#[tokio::test]
async fn a_label_missing_in_its_index_is_detected() {
    let directory = tempfile::tempdir().unwrap();
    let store = full(directory.path(), 12).await;
    store.close().await;
    lose_from_index(directory.path(), 1).await;
    let error = exported(directory.path()).await.unwrap_err().to_string();
    assert!(error.starts_with("damaged database: SQLite: "), "{error}");
    assert!(error.contains("label_of") && error.contains("would be missing in an export"), "{error}");
}

/// Removes the entry of this label from the index.
async fn lose_from_index(directory: &Path, label: i64) {
    let mut connection = connect(directory).await;
    let take = "PRAGMA writable_schema = ON; CREATE TABLE kept AS SELECT * FROM sqlite_schema WHERE name = 'label_of';";
    let out = format!("UPDATE label SET status = 'superseded' WHERE number = {label};");
    let hide = "DELETE FROM sqlite_schema WHERE name = 'label_of'; PRAGMA writable_schema = RESET;";
    let back = format!("UPDATE label SET status = 'label' WHERE number = {label};");
    let show = "PRAGMA writable_schema = ON; INSERT INTO sqlite_schema SELECT * FROM kept; DROP TABLE kept;
        PRAGMA writable_schema = RESET;";
    for sql in [take, &out, hide, &back, show] {
        sqlx::raw_sql(AssertSqlSafe(sql.to_owned())).execute(&mut connection).await.unwrap();
    }
    connection.close().await.unwrap();
}

/// Rows written before there were checksums are not damaged: each gets its checksum during the migration and is
/// read as before.
#[tokio::test]
async fn a_database_of_an_earlier_version_gets_checksums() {
    let directory = tempfile::tempdir().unwrap();
    let store = full(directory.path(), 12).await;
    store.close().await;
    let expected = exported(directory.path()).await.unwrap();
    without_checksums(directory.path()).await;
    assert_eq!(exported(directory.path()).await.unwrap(), expected, "it is only looked at");
    let store = Store::open(directory.path()).await.unwrap();
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    store.close().await;
    let mut connection = connect(directory.path()).await;
    let sql = "SELECT count(*) FROM label WHERE checksum IS NULL";
    let missing: i64 = sqlx::query_scalar(sql).fetch_one(&mut connection).await.unwrap();
    assert_eq!((exported(directory.path()).await.unwrap(), missing), (expected, 0));
}

/// Turns it into a database of version 8 by undoing what later versions add and rename.
async fn without_checksums(directory: &Path) {
    let mut connection = connect(directory).await;
    let mut sql = "DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume; ALTER TABLE walk_progress DROP COLUMN reference_step;
    DROP TABLE walk_trace; DROP INDEX job_order; ALTER TABLE job DROP COLUMN value; ALTER TABLE job DROP COLUMN value_factors;
        CREATE INDEX job_order ON job (state, priority DESC, decision, protocol);
        DROP TABLE version_file; DROP TABLE version;
        DROP TABLE walk_conditions; DROP TRIGGER label_has_checksum; DROP INDEX label_excluded;
        DROP INDEX label_other;
        ALTER TABLE process RENAME COLUMN start_time TO birth; ALTER TABLE walk RENAME COLUMN assignments TO turn;
        ALTER TABLE walk RENAME COLUMN rejected TO refused; ALTER TABLE walk RENAME COLUMN rollbacks TO returns;
        ALTER TABLE label RENAME COLUMN status TO standing; ALTER TABLE walk_progress RENAME TO pace;
        ALTER TABLE label DROP COLUMN excluded; ALTER TABLE label DROP COLUMN exclusion; "
        .to_owned();
    for table in [
        "campaign",
        "value",
        "structure",
        "seed_structure",
        "protocol",
        "decision",
        "candidate",
        "component",
        "walk",
        "label",
        "import",
        "archive",
    ] {
        sql += &format!("ALTER TABLE {table} DROP COLUMN checksum; ");
    }
    for column in ["features", "selector", "original"] {
        sql += &format!("ALTER TABLE candidate DROP COLUMN {column}_checksum; ");
    }
    sql += "ALTER TABLE walk DROP COLUMN checkpoint_checksum; PRAGMA user_version = 8;
        DELETE FROM _sqlx_migrations WHERE version > 8;";
    sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
}

/// A running labeller of an earlier version gets an error.
#[tokio::test]
async fn a_label_without_a_checksum_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    full(directory.path(), 4).await.close().await;
    let mut connection = connect(directory.path()).await;
    let sql = "INSERT INTO label (structure, protocol, status, energy, forces, received)
               SELECT structure, protocol, 'check', energy, forces, received FROM label LIMIT 1";
    let error = sqlx::query(sql).execute(&mut connection).await.unwrap_err().to_string();
    assert!(error.contains("start this labeller anew"), "{error}");
}
