//! Backups: a directory with an SQLite database, for either kind of campaign, created as a whole or not at all.

mod directory;
mod from_postgres;

use std::path::Path;

use serde_json::json;

use self::directory::StagedDirectory;
use crate::Store;
use crate::database::{Database, query};
use crate::error::Result;
use crate::sqlite::file::DatabaseFile;
use crate::tables::attempt_end::{AttemptEnd, end_without_label};
use crate::tables::logs::insert_operation;
use crate::tables::processes::LEASED;

impl Store {
    /// Copies a snapshot of the campaign into a new directory `target`, which appears once it is complete and on
    /// disk. The copy has no processes; its leased jobs return to the queue. `on_progress` receives progress and total, in
    /// bytes or rows.
    ///
    /// # Errors
    /// [`crate::StoreError::BackupExists`] if anything exists at `target`.
    pub async fn backup(&self, target: &Path, now: i64, on_progress: impl FnMut(u64, u64)) -> Result<()> {
        let unfinished = StagedDirectory::beside(target)?;
        match &self.database {
            Database::Sqlite(file) => file.copy_into(unfinished.path(), on_progress).await?,
            Database::Postgres(server) => from_postgres::copy(server, unfinished.path(), on_progress).await?,
        }
        let copy = DatabaseFile::open(unfinished.path()).await?;
        let store = Self { database: Database::Sqlite(copy.clone()) };
        store.forget_processes(now).await?;
        copy.empty_log().await?;
        store.close().await;
        unfinished.publish(target)
    }

    /// Removes the processes of the original campaign and releases their leases.
    async fn forget_processes(&self, now: i64) -> Result<()> {
        let mut transaction = self.database.begin().await?;
        let leased: Vec<(i64, String)> = query(LEASED).fetch_all(&mut transaction).await?;
        for (job, _) in &leased {
            end_without_label(&mut transaction, *job, AttemptEnd::Lost("released"), now).await?;
        }
        query("DELETE FROM process").execute(&mut transaction).await?;
        let detail = json!({ "leases": leased.len() });
        insert_operation(&mut transaction, now, "copied", &detail).await?;
        transaction.commit().await
    }
}
