//! The connections to a database in one SQLite file.

use std::fs::{self, OpenOptions};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use sqlx::sqlite::{
    Sqlite, SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{AssertSqlSafe, Connection, Executor};

use super::disk_space;
use super::file_identity::FileIdentity;
use crate::error::{Result, StoreError};
use crate::file_names::DATABASE;

/// Temporary name of the database while it is created.
pub(super) const UNFINISHED: &str = "campaign.sqlite.new";
/// How long to wait for another connection that holds the database.
pub(super) const BUSY_TIMEOUT: Duration = Duration::from_secs(30);
const MAX_READERS: u32 = 4;
/// Time between two progress reports of a copy.
const COPY_PROGRESS_INTERVAL: Duration = Duration::from_millis(200);
/// Page size of a new database in bytes. A candidate with features has about 100 kB and every page costs time;
/// larger pages would cost too much for short rows.
pub(super) const PAGE_SIZE: u32 = 1 << 14;
/// Number of pages in the write-ahead log at which they are copied into the database, while commits wait: 64 MB,
/// about 0.1 s. Pages that are rewritten in between, such as those of walks, are copied once.
pub(super) const WAL_PAGES: u32 = 1 << 12;

/// An open database file. Clones share its connections.
#[derive(Clone, Debug)]
pub struct DatabaseFile {
    /// A single connection: writers queue for it. `None` in a store opened read-only.
    pub(super) writer: Option<SqlitePool>,
    pub readers: SqlitePool,
    /// Checked before every write transaction.
    pub(super) file: FileIdentity,
}

impl DatabaseFile {
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

    /// Copies a snapshot of the database into another directory, which has none. `on_progress` receives the approximate
    /// number of bytes written, and the total. Does not sync the copy to disk.
    pub async fn copy_into(&self, directory: &Path, mut on_progress: impl FnMut(u64, u64)) -> Result<()> {
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
                    on_progress(fs::metadata(&unfinished).map_or(0, |file| file.len()).min(all), all);
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

pub(super) fn options(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new().filename(path).foreign_keys(true).busy_timeout(BUSY_TIMEOUT)
}

pub(super) async fn writer(path: &Path) -> Result<SqlitePool> {
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

/// Each connection creates `views`, see `old_schema`.
pub(super) fn readers(options: SqliteConnectOptions, views: Option<Arc<str>>) -> SqlitePool {
    let pool = SqlitePoolOptions::new().max_connections(MAX_READERS).max_lifetime(None);
    let pool = pool.after_connect(move |connection, _| {
        let views = views.clone();
        Box::pin(async move {
            match views {
                Some(views) => connection.execute(AssertSqlSafe(views.to_string())).await.map(drop),
                None => Ok(()),
            }
        })
    });
    pool.connect_lazy_with(options)
}

/// Creates an empty file for SQLite that only its owner may read. The log and its index get the same mode.
pub(super) fn make_private(path: &Path) -> Result<()> {
    let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path);
    made.map(drop).map_err(|source| StoreError::File { path: path.into(), source })
}
