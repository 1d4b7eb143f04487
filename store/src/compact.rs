//! Giving space back.

use serde_json::json;

use crate::Store;
use crate::database::{Database, query};
use crate::error::Result;
use crate::tables::logs::insert_operation;

impl Store {
    /// Bytes that the campaign takes, with its log in SQLite and with its indexes on a server.
    pub async fn size(&self) -> Result<u64> {
        match &self.database {
            Database::Sqlite(file) => file.size(),
            Database::Postgres(server) => server.size().await,
        }
    }

    /// Writes every table anew without the gaps that changed rows have left. The caller holds the
    /// [`crate::CampaignLock`]; whoever else writes waits.
    ///
    /// # Errors
    /// [`crate::StoreError::NoRoom`] where the disk cannot hold the copy that this takes; a server does not tell.
    pub async fn compact(&self) -> Result<()> {
        match &self.database {
            Database::Sqlite(file) => file.compact().await,
            Database::Postgres(server) => server.compact().await,
        }
    }

    /// Drops the features of declined candidates, which only a replay with other rules needs. The caller holds the
    /// [`crate::CampaignLock`]. Returns of how many.
    pub async fn drop_declined_features(&self, now: i64) -> Result<u64> {
        let mut transaction = self.database.begin_to_lead().await?;
        let sql = "UPDATE candidate_data SET features = NULL WHERE features IS NOT NULL
                   AND decision IN (SELECT decision FROM candidate WHERE fate = 'declined')";
        let dropped = query(sql).execute(&mut transaction).await?;
        insert_operation(&mut transaction, now, "features_dropped", &json!({ "candidates": dropped }))
            .await?;
        transaction.commit().await?;
        Ok(dropped)
    }
}
