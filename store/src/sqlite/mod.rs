//! Creates and opens a database in one SQLite file.

mod disk_space;
mod file_identity;
mod old_schema;

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use sqlx::migrate::Migrator;
use sqlx::sqlite::{
    Sqlite, SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool, SqlitePoolOptions,
    SqliteSynchronous,
};
use sqlx::{ConnectOptions, Connection, Executor};

use self::file_identity::FileIdentity;
use crate::database::{Database, Transaction};
use crate::error::{Result, StoreError};
use crate::file_names::DATABASE;
use crate::filesystem::check_directory;
use crate::migrations::{Step, migrator};
use crate::tables::checksums;

/// Temporary name of the database while it is created.
const UNFINISHED: &str = "campaign.sqlite.new";
/// `PRAGMA application_id` of a campaign: "CALM".
const APPLICATION: i64 = 0x4341_4c4d;
/// `PRAGMA user_version` after the newest migration.
const SCHEMA: i64 = 13;
/// The first version whose rows have checksums.
const FIRST_WITH_CHECKSUMS: i64 = 9;
/// How long to wait for another connection that holds the database.
const BUSY_TIMEOUT: Duration = Duration::from_secs(30);
const MAX_READERS: u32 = 4;
/// Tries to migrate a database while other processes try the same.
const MIGRATION_ATTEMPTS: u32 = 50;
/// Time between two tries to open a database.
const OPEN_RETRY_INTERVAL: Duration = Duration::from_millis(20);
/// Time between two progress reports of a copy.
const COPY_PROGRESS_INTERVAL: Duration = Duration::from_millis(200);
/// Page size of a new database in bytes. A candidate with features has about 100 kB and every page costs time;
/// larger pages would cost too much for short rows.
const PAGE_SIZE: u32 = 1 << 14;
/// Number of pages in the write-ahead log at which they are copied into the database, while commits wait: 64 MB,
/// about 0.1 s. Pages that are rewritten in between, such as those of walks, are copied once.
const WAL_PAGES: u32 = 1 << 12;

/// The migrations in order.
pub(crate) static STEPS: [Step; 13] = [
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
];

static MIGRATIONS: LazyLock<Migrator> = LazyLock::new(|| migrator(&STEPS));

/// An open database file. Clones share its connections.
#[derive(Clone, Debug)]
pub struct DatabaseFile {
    /// A single connection: writers queue for it. `None` in a store opened read-only.
    writer: Option<SqlitePool>,
    pub readers: SqlitePool,
    /// Checked before every write transaction.
    file: FileIdentity,
}

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
        identify(&path, immutable).await?;
        let options = options(&path).read_only(true).immutable(immutable);
        let views = old_schema::views(&options).await?;
        let readers = readers(options, views);
        Ok(Self { writer: None, readers, file: FileIdentity::read(&path)? })
    }

    pub async fn close(&self) {
        self.readers.close().await;
        if let Some(writer) = &self.writer {
            writer.close().await;
        }
    }

    /// Moves the write-ahead log into the database. The log is named after the database and would be lost if that
    /// were renamed. Closing does the same, but reports no error if the disk is full.
    pub async fn empty_log(&self) -> Result<()> {
        let writer = self.writer.as_ref().ok_or(StoreError::ReadOnly)?;
        let checkpoint = sqlx::query_as("PRAGMA wal_checkpoint(TRUNCATE)").fetch_one(writer);
        let (busy, _, _): (bool, i64, i64) = checkpoint.await?;
        if busy { Err(StoreError::Busy) } else { Ok(()) }
    }

    /// Copies a snapshot of the database into another directory, which has none. `tell` receives the approximate
    /// number of bytes written, and the total. Does not sync the copy to disk.
    pub async fn copy_into(&self, directory: &Path, mut tell: impl FnMut(u64, u64)) -> Result<()> {
        let (unfinished, path) = (directory.join(UNFINISHED), directory.join(DATABASE));
        let failed = |source| StoreError::File { path: path.clone(), source };
        let all = self.size()?;
        make_private(&unfinished)?;
        let copy = sqlx::query("VACUUM INTO $1").bind(unfinished.to_string_lossy().into_owned());
        let mut copying = pin!(copy.execute(&self.readers));
        loop {
            tokio::select! {
                copied = &mut copying => break copied.map(drop)?,
                () = tokio::time::sleep(COPY_PROGRESS_INTERVAL) => {
                    tell(fs::metadata(&unfinished).map_or(0, |file| file.len()).min(all), all);
                }
            }
        }
        fs::rename(&unfinished, &path).map_err(failed)
    }

    /// Size of the database and its log in bytes.
    pub fn size(&self) -> Result<u64> {
        let path = self.file.path();
        let log = path.with_file_name(format!("{DATABASE}-wal"));
        let size = |path: &Path| fs::metadata(path).map(|file| file.len());
        let database = size(path).map_err(|source| StoreError::File { path: path.into(), source })?;
        Ok(database + size(&log).unwrap_or(0))
    }

    /// Rewrites the database without gaps. Needs space for two copies: one in the directory for temporary files,
    /// one in the log.
    pub async fn compact(&self) -> Result<()> {
        let writer = self.writer.as_ref().ok_or(StoreError::ReadOnly)?;
        self.file.check()?;
        disk_space::check(self.file.path(), self.size()?)?;
        sqlx::query("VACUUM").execute(writer).await?;
        self.empty_log().await
    }

    /// Begins a transaction that locks the database for writing at once. Locking it later could fail without
    /// waiting for the timeout.
    pub async fn begin(&self) -> Result<sqlx::Transaction<'static, Sqlite>> {
        let writer = self.writer.as_ref().ok_or(StoreError::ReadOnly)?;
        self.file.check()?;
        Ok(writer.begin_with("BEGIN IMMEDIATE").await?)
    }
}

fn options(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new().filename(path).foreign_keys(true).busy_timeout(BUSY_TIMEOUT)
}

async fn writer(path: &Path) -> Result<SqlitePool> {
    let options = options(path)
        .create_if_missing(true)
        .page_size(PAGE_SIZE)
        .journal_mode(SqliteJournalMode::Wal)
        .pragma("wal_autocheckpoint", WAL_PAGES.to_string())
        .synchronous(SqliteSynchronous::Full);
    let pool = SqlitePoolOptions::new().max_connections(1).idle_timeout(None).max_lifetime(None);
    // After a full disk or a failed write SQLite itself rolls back. The driver does not know this, fails to roll
    // back once more and could not begin another transaction, so the connection is closed.
    let pool = pool.after_release(|connection, _| {
        Box::pin(async move {
            connection.ping().await?;
            Ok(!connection.is_in_transaction())
        })
    });
    Ok(pool.connect_with(options).await?)
}

/// Each connection creates `views`, see [`old_schema`].
fn readers(options: SqliteConnectOptions, views: Option<&'static str>) -> SqlitePool {
    let pool = SqlitePoolOptions::new().max_connections(MAX_READERS).max_lifetime(None);
    let pool = pool.after_connect(move |connection, _| {
        Box::pin(async move {
            match views {
                Some(views) => connection.execute(views).await.map(drop),
                None => Ok(()),
            }
        })
    });
    pool.connect_lazy_with(options)
}

/// Migrates the tables to the newest version, checksums included, in one transaction.
async fn migrate(writer: &SqlitePool) -> Result<()> {
    let mut transaction = writer.begin_with("BEGIN IMMEDIATE").await?;
    let found: i64 = sqlx::query_scalar("PRAGMA user_version").fetch_one(&mut *transaction).await?;
    // The function that `run` calls. With a borrowed connection, `run` gives a future that is not `Send`.
    MIGRATIONS.run_direct(None, &mut *transaction, false).await.map_err(schema_error)?;
    let mut transaction = Transaction::Sqlite(transaction);
    if found < FIRST_WITH_CHECKSUMS {
        checksums::fill(&mut transaction).await?;
    }
    transaction.commit().await
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

fn schema_error(error: sqlx::migrate::MigrateError) -> StoreError {
    match error {
        sqlx::migrate::MigrateError::Execute(error)
        | sqlx::migrate::MigrateError::ExecuteMigration(error, _) => error.into(),
        error => StoreError::Schema(error),
    }
}

/// Creates an empty file for SQLite that only its owner may read. The log and its index get the same mode.
fn make_private(path: &Path) -> Result<()> {
    let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path);
    made.map(drop).map_err(|source| StoreError::File { path: path.into(), source })
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

#[cfg(test)]
mod tests;
