//! Creates, opens and migrates a database in one SQLite file.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use sqlx::ConnectOptions;
use sqlx::migrate::Migrator;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection, SqlitePool};

use super::file::{BUSY_TIMEOUT, DatabaseFile, UNFINISHED, make_private, options, readers, writer};
use super::file_identity::FileIdentity;
use crate::database::{Database, Transaction};
use crate::error::{Result, StoreError};
use crate::file_names::DATABASE;
use crate::filesystem::check_directory;
use crate::migrations::{MigrationSource, migrator, schema_error};
use crate::old_schema::{self, FIRST_WITH_CHECKSUMS, FIRST_WITH_PRESENT_WORDS};
use crate::tables::{checksums, renamed_words};

/// `PRAGMA application_id` of a campaign: "CALM".
pub(super) const APPLICATION: i64 = 0x4341_4c4d;
/// `PRAGMA user_version` after the newest migration.
pub(super) const SCHEMA: i64 = 22;
/// Tries to migrate a database while other processes try the same.
const MIGRATION_ATTEMPTS: u32 = 50;
/// Time between two tries to open a database.
const OPEN_RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// The migrations in order.
pub(crate) static STEPS: [MigrationSource; 22] = [
    (1, "campaign", include_str!("../../migrations/sqlite/0001_campaign.sql")),
    (2, "processes", include_str!("../../migrations/sqlite/0002_processes.sql")),
    (3, "calculations", include_str!("../../migrations/sqlite/0003_calculations.sql")),
    (4, "counts", include_str!("../../migrations/sqlite/0004_counts.sql")),
    (5, "jobs", include_str!("../../migrations/sqlite/0005_jobs.sql")),
    (6, "relabel", include_str!("../../migrations/sqlite/0006_relabel.sql")),
    (7, "listing", include_str!("../../migrations/sqlite/0007_listing.sql")),
    (8, "brought", include_str!("../../migrations/sqlite/0008_brought.sql")),
    (9, "checksums", include_str!("../../migrations/sqlite/0009_checksums.sql")),
    (10, "exclude", include_str!("../../migrations/sqlite/0010_exclude.sql")),
    (11, "walk conditions", include_str!("../../migrations/sqlite/0011_walk_conditions.sql")),
    (12, "lower states", include_str!("../../migrations/sqlite/0012_lower_states.sql")),
    (13, "queued imports", include_str!("../../migrations/sqlite/0013_queued_imports.sql")),
    (14, "start time", include_str!("../../migrations/sqlite/0014_start_time.sql")),
    (15, "assignments", include_str!("../../migrations/sqlite/0015_assignments.sql")),
    (16, "words", include_str!("../../migrations/sqlite/0016_words.sql")),
    (17, "versions", include_str!("../../migrations/sqlite/0017_versions.sql")),
    (18, "label values", include_str!("../../migrations/sqlite/0018_label_values.sql")),
    (19, "walk traces", include_str!("../../migrations/sqlite/0019_walk_traces.sql")),
    (20, "assignments", include_str!("../../migrations/sqlite/0020_assignments.sql")),
    (21, "trajectories", include_str!("../../migrations/sqlite/0021_trajectories.sql")),
    (22, "samples", include_str!("../../migrations/sqlite/0022_samples.sql")),
];

pub(super) static MIGRATIONS: LazyLock<Migrator> = LazyLock::new(|| migrator(&STEPS));

impl DatabaseFile {
    /// Creates the database in the existing directory `directory`; `fill` writes its initial rows. The database is
    /// created as a whole or not at all.
    pub async fn create(directory: &Path, fill: impl AsyncFnOnce(&Database) -> Result<()>) -> Result<Self> {
        check_directory(directory)?;
        let path = directory.join(DATABASE);
        if path.exists() {
            return Err(StoreError::Exists { path });
        }
        let unfinished = directory.join(UNFINISHED);
        remove_database(&unfinished)?;
        make_private(&unfinished)?;
        let writer = writer(&unfinished).await?;
        MIGRATIONS.run(&writer).await.map_err(schema_error)?;
        let file = FileIdentity::read(&unfinished)?;
        let made = Self { readers: writer.clone(), writer: Some(writer), file };
        fill(&Database::Sqlite(made.clone())).await?;
        made.empty_log().await?;
        made.close().await;
        publish(directory, &unfinished, &path)?;
        Self::open(directory).await
    }

    /// Opens the database in `directory` and migrates its tables to the newest version.
    pub async fn open(directory: &Path) -> Result<Self> {
        let started = Instant::now();
        loop {
            match Self::open_now(directory).await {
                // Another process opens or closes it at this moment; SQLite does not always wait for that.
                Err(StoreError::Busy) if started.elapsed() < BUSY_TIMEOUT => {
                    tokio::time::sleep(OPEN_RETRY_INTERVAL).await;
                }
                opened => return opened,
            }
        }
    }

    async fn open_now(directory: &Path) -> Result<Self> {
        let path = existing(directory)?;
        check_directory(directory)?;
        let found = identify(&path, false).await?;
        let writer = writer(&path).await?;
        let mut tries = 1;
        while let Err(error) = migrate(&writer).await {
            // Another process that opened it at the same time is migrating it; when it is done, nothing is left to
            // do.
            if found == SCHEMA || tries == MIGRATION_ATTEMPTS {
                return Err(error);
            }
            tries += 1;
            tokio::time::sleep(OPEN_RETRY_INTERVAL).await;
        }
        let readers = readers(options(&path).read_only(true), None);
        Ok(Self { writer: Some(writer), readers, file: FileIdentity::read(&path)? })
    }

    /// Opens the database in `directory` for reading, also where nothing may be written. Tables of an earlier
    /// version are not migrated: reading functions fill in what they lack.
    pub async fn open_read_only(directory: &Path) -> Result<Self> {
        let path = existing(directory)?;
        let immutable = match check_directory(directory) {
            Ok(()) => false,
            // Without a write-ahead log the file is complete and can be read without a lock.
            Err(StoreError::Directory { .. }) => !directory.join(format!("{DATABASE}-wal")).exists(),
            Err(error) => return Err(error),
        };
        let version = identify(&path, immutable).await?;
        let options = options(&path).read_only(true).immutable(immutable);
        let views = match version {
            SCHEMA => None,
            _ => old_schema::views("main", version, &columns(&options).await?),
        };
        let readers = readers(options, views.map(Arc::from));
        Ok(Self { writer: None, readers, file: FileIdentity::read(&path)? })
    }
}

/// Migrates the tables to the newest version, checksums and words included, in one transaction.
async fn migrate(writer: &SqlitePool) -> Result<()> {
    let mut transaction = writer.begin_with("BEGIN IMMEDIATE").await?;
    let found: i64 = sqlx::query_scalar("PRAGMA user_version").fetch_one(&mut *transaction).await?;
    // The function that `run` calls. With a borrowed connection, `run` gives a future that is not `Send`.
    MIGRATIONS.run_direct(None, &mut *transaction, false).await.map_err(schema_error)?;
    let mut transaction = Transaction::Sqlite(transaction);
    if found < FIRST_WITH_CHECKSUMS {
        checksums::fill(&mut transaction).await?;
    }
    if found < FIRST_WITH_PRESENT_WORDS {
        renamed_words::rename(&mut transaction).await?;
    }
    transaction.commit().await
}

/// The name of each table with each of its columns.
async fn columns(options: &SqliteConnectOptions) -> Result<Vec<(String, String)>> {
    let sql = "SELECT found.name, info.name FROM sqlite_schema AS found
        CROSS JOIN pragma_table_info(found.name) AS info WHERE found.type = 'table'";
    let mut connection = options.connect().await?;
    Ok(sqlx::query_as(sql).fetch_all(&mut connection).await?)
}

fn existing(directory: &Path) -> Result<PathBuf> {
    let path = directory.join(DATABASE);
    if path.exists() {
        Ok(path)
    } else {
        Err(StoreError::Missing { location: directory.display().to_string(), lacks: DATABASE })
    }
}

/// Checks, without changing the file, that it is a campaign which this program can read. Returns the schema
/// version.
async fn identify(path: &Path, immutable: bool) -> Result<i64> {
    let mut begin = Vec::new();
    let read = File::open(path).and_then(|file| file.take(16).read_to_end(&mut begin));
    read.map_err(|source| StoreError::File { path: path.into(), source })?;
    if begin != b"SQLite format 3\0" {
        let found = begin.escape_ascii().to_string();
        return Err(StoreError::NotADatabase { path: path.into(), found });
    }
    let mut connection = options(path).read_only(true).immutable(immutable).connect().await?;
    let found = pragma(&mut connection, "PRAGMA application_id").await?;
    if found != APPLICATION {
        return Err(StoreError::Foreign { path: path.into(), found, expected: APPLICATION });
    }
    let found = pragma(&mut connection, "PRAGMA user_version").await?;
    if !(1..=SCHEMA).contains(&found) {
        return Err(StoreError::Version { path: path.into(), found, reads: SCHEMA });
    }
    Ok(found)
}

async fn pragma(connection: &mut SqliteConnection, pragma: &'static str) -> Result<i64> {
    Ok(sqlx::query_scalar(pragma).fetch_one(connection).await?)
}

/// Removes what a killed [`Store::create`] left behind.
fn remove_database(path: &Path) -> Result<()> {
    for suffix in ["", "-wal", "-shm"] {
        let mut name = path.as_os_str().to_owned();
        name.push(suffix);
        match fs::remove_file(&name) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                return Err(StoreError::File { path: name.into(), source });
            }
            _ => {}
        }
    }
    Ok(())
}

/// Renames the finished database to its final name.
fn publish(directory: &Path, unfinished: &Path, path: &Path) -> Result<()> {
    let failed = |source| StoreError::File { path: path.into(), source };
    fs::rename(unfinished, path).map_err(failed)?;
    File::open(directory).and_then(|directory| directory.sync_all()).map_err(failed)
}
