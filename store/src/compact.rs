//! Giving space back.

use serde_json::json;

use crate::Store;
use crate::checksum::CheckedColumn;
use crate::database::{Database, execute_rows, query};
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
    /// [`crate::StoreError::InsufficientSpace`] where the disk cannot hold the copy that this takes; a server does not tell.
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
        // That of no features depends on the number of the candidate.
        let with = "SELECT candidate.decision FROM candidate CROSS JOIN candidate_data
                    ON candidate_data.decision = candidate.decision
                    WHERE fate = 'declined' AND features IS NOT NULL";
        let with: Vec<i64> = query(with).fetch_all(&mut transaction).await?;
        let checksum =
            |decision: &i64| vec![(*decision).into(), CheckedColumn::checksum(*decision, None).into()];
        let sql = "UPDATE candidate SET features_checksum = new.checksum FROM {rows}
                   WHERE candidate.decision = new.decision";
        let rows = with.iter().map(checksum).collect();
        execute_rows(&mut transaction, sql, &["decision", "checksum"], rows).await?;
        let sql = "UPDATE candidate_data SET features = NULL WHERE features IS NOT NULL
                   AND decision IN (SELECT decision FROM candidate WHERE fate = 'declined')";
        let dropped = query(sql).execute(&mut transaction).await?;
        insert_operation(&mut transaction, now, "features_dropped", &json!({ "candidates": dropped }))
            .await?;
        transaction.commit().await?;
        Ok(dropped)
    }
}
