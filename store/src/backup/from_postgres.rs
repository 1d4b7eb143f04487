//! Copies the tables of a server into an SQLite file, from one snapshot.

use std::path::Path;

use sqlx::{AssertSqlSafe, Executor, Postgres};

use crate::database::value::ColumnType;
use crate::database::{Database, SqlRow, SqlValue, Transaction, execute_rows, query};
use crate::error::{Result, StoreError};
use crate::postgres::server::PostgresServer;
use crate::sqlite::file::DatabaseFile;
use crate::tables::budget::rebuild_totals;
use crate::tables::checksums;

/// Pages per transaction of the copy.
const PAGES: usize = 32;

use ColumnType::{Bytes as B, Integer as I, Real as R, Text as T};

struct CopiedTable {
    name: &'static str,
    columns: &'static [&'static str],
    kinds: &'static [ColumnType],
    insert: &'static str,
    /// Rows fetched at a time: a row of a large structure has megabytes.
    page: usize,
    fetch: &'static str,
}

/// A table with the types of its columns.
macro_rules! table {
    ($name:literal { $($columns:tt)* }) => { table!($name 64 { $($columns)* }) };
    ($name:literal $page:literal { $($column:ident: $kind:ident),* $(,)? }) => {
        CopiedTable {
            name: $name,
            columns: &[$(stringify!($column)),*],
            kinds: &[$($kind),*],
            insert: concat!("INSERT OR REPLACE INTO ", $name, " ({columns}) SELECT * FROM {rows}"),
            page: $page,
            fetch: concat!("FETCH ", $page, " FROM copy_of_", $name),
        }
    };
}

/// All tables except those of the leader, of processes and their progress, and of job counts, which triggers count
/// again. Each table comes after those that it references. A new database already has some rows of `campaign`.
const TABLES: [CopiedTable; 24] = [
    table!("campaign" { key: T, value: T, checksum: I }),
    table!("value" { name: T, value: T, checksum: I }),
    table!("structure" { number: I, hash: B, atoms: I, formula: T, data: B, checksum: I }),
    table!("seed_structure" { seed: I, name: T, source: T, structure: I, checksum: I }),
    table!("protocol" { number: I, hash: B, name: T, settings: T, checksum: I }),
    table!("decision" {
        sequence: I, round: I, kind: T, walk: I, candidate: T, mixture_version: I, detail: T,
        checksum: I,
    }),
    table!("candidate" {
        decision: I, id: T, content: B, structure: I, walk: I, segment: I, step: I, seed_structure: I, origin: T,
        fate: T, reason: T, mixture_version: I, atoms: I, formula: T, temperature: R, relative_volume: R, energy: R,
        walker_gamma: R, walker_gamma_nbr: R, walker_above: I, selector_gamma: R, selector_gamma_nbr: R,
        selector_above: I, original_gamma: R, original_gamma_nbr: R, original_above: I,
        checksum: I, features_checksum: I, selector_checksum: I, original_checksum: I,
    }),
    table!("candidate_count" { origin: T, fate: T, number: I }),
    table!("candidate_data" { decision: I, block: B, features: B, selector_grades: B, original_grades: B }),
    table!("component" { element: I, slot: I, bytes: B, checksum: I }),
    table!("walk" {
        walk: I, origin: T, partner: I, seed_structure: I, state: T, reason: T, assignments: I, accepted: I, step: I,
        segment: I, tau: R, temperature: R, relative_volume: R, gamma_max: R, rejected: I, rollbacks: I,
        selector_state: T, checkpoint: B, checksum: I, checkpoint_checksum: I,
    }),
    table!("walk_conditions" { walk: I, conditions: T, checksum: I }),
    table!("walk_trace" { walk: I, points: I, data: B, checksum: I }),
    table!("assignment" {
        walk: I, part: I, number: I, mixture_version: I, threshold_factor: R, verdict: T, start_segment: I, start_step: I,
        start_reference_step: I, segment: I, step: I, reference_step: I, checksum: I,
    }),
    table!("trajectory" 8 { walk: I, part: I, frames: I, data: B, checksum: I }),
    table!("reference_volume" { walk: I, volume: R, checksum: I }),
    table!("job" {
        number: I, structure: I, protocol: I, decision: I, state: T, priority: I, holder: T, expires: I, attempts: I,
        failures: I, overruled: I, relabel: T, relabel_after: I, value: R, value_factors: T,
    }),
    table!("attempt" {
        job: I, attempt: I, holder: T, calculation: T, started: I, ended: I, outcome: T, class: T, log: T, cores: I,
        core_seconds: R, remedies: T, difference: T, atoms: I, electrons: R, k_points: I,
    }),
    table!("label" {
        number: I, structure: I, protocol: I, status: T, energy: R, forces: B, stress: B, job: I, attempt: I,
        file: T, frame: I, correction: T, received: I, details: T,
        superseded: I, reason: T, checksum: I, excluded: I, exclusion: T,
    }),
    table!("import" { number: I, structure: I, file: T, frame: I, checksum: I }),
    table!("archive" 1 { job: I, attempt: I, bytes: B, left_out: T, checksum: I }),
    table!("version" {
        number: I, parent: I, state: T, reason: T, method: T, structures: I, last_decision: I, labels: I,
        model_hash: T, mixture_hash: T, figures: T, seconds: R, core_hours: R, time: I, checksum: I,
    }),
    table!("sample" {
        time: I, run: I, seen: I, accepted: I, queued: I, leased: I, labels: I, failed_attempts: I, failed_jobs: I,
        core_milliseconds: I, mixture_version: I, steps_per_second: R, walkers_busy: R,
    }),
    table!("version_file" 1 { version: I, name: T, data: B }),
];
const OPERATIONS: CopiedTable = table!("operation" { number: I, time: I, kind: T, detail: T });

/// Writes the copy into a directory.
pub(super) async fn copy(
    server: &PostgresServer,
    directory: &Path,
    mut on_progress: impl FnMut(u64, u64),
) -> Result<()> {
    let mut from = Transaction::Postgres(server.begin_read().await?, server.clock);
    // Some of their checksums are marked as unknown.
    let earlier_version = !from.has_column("label", "status").await?;
    let tables = || TABLES.iter().chain([&OPERATIONS]);
    let mut all = 0;
    for table in tables() {
        all += count(&mut from, table).await?;
    }
    let mut copied = 0;
    let fill = async |into: &Database| {
        for table in tables() {
            copy_table(&mut from, into, table, |rows| {
                copied += rows;
                on_progress(copied, all);
            })
            .await?;
        }
        rebuild_totals(into).await?;
        if earlier_version {
            let mut transaction = into.begin().await?;
            checksums::fill(&mut transaction).await?;
            transaction.commit().await?;
        }
        Ok(())
    };
    DatabaseFile::create(directory, fill).await?.close().await;
    Ok(())
}

async fn count(from: &mut Transaction, table: &CopiedTable) -> Result<u64> {
    if !exists(from, table).await? {
        return Ok(0);
    }
    let sql = format!("SELECT count(*) FROM {}", table.name);
    let count: i64 = sqlx::query_scalar(AssertSqlSafe(sql)).fetch_one(&mut **postgres(from)?).await?;
    Ok(count.unsigned_abs())
}

async fn copy_table(
    from: &mut Transaction,
    into: &Database,
    table: &CopiedTable,
    mut on_rows: impl FnMut(u64),
) -> Result<()> {
    let name = table.name;
    if !exists(from, table).await? {
        return Ok(());
    }
    let cursor = format!("DECLARE copy_of_{name} NO SCROLL CURSOR FOR SELECT * FROM {name}");
    postgres(from)?.execute(AssertSqlSafe(cursor)).await?;
    loop {
        let mut transaction = into.begin().await?;
        for _ in 0..PAGES {
            let page = query(table.fetch).rows(&mut *from).await?;
            let (rows, end) = (page.len(), page.len() < table.page);
            let page = page.iter().map(|row| values(row, table)).collect::<Result<_>>()?;
            execute_rows(&mut transaction, table.insert, table.columns, page).await?;
            on_rows(rows as u64);
            if end {
                return transaction.commit().await;
            }
        }
        transaction.commit().await?;
    }
}

fn postgres(transaction: &mut Transaction) -> Result<&mut sqlx::Transaction<'static, Postgres>> {
    match transaction {
        Transaction::Postgres(transaction, _) => Ok(transaction),
        Transaction::Sqlite(_) => Err(StoreError::Inconsistent("not a transaction of a server".into())),
    }
}

/// Columns that tables of an earlier version lack are NULL.
fn values(row: &SqlRow, table: &CopiedTable) -> Result<Vec<SqlValue>> {
    let value = |(name, kind): (&&str, &ColumnType)| {
        Ok(match kind {
            I => SqlValue::Integer(row.get_or_default(name)?),
            R => SqlValue::Real(row.get_or_default(name)?),
            T => SqlValue::Text(row.get_or_default(name)?),
            B => SqlValue::Bytes(row.get_or_default(name)?),
        })
    };
    table.columns.iter().zip(table.kinds).map(value).collect()
}

/// Whether the server has the table; earlier versions lack some.
async fn exists(from: &mut Transaction, table: &CopiedTable) -> Result<bool> {
    query("SELECT to_regclass($1) IS NOT NULL").bind(table.name).fetch_one(from).await
}
