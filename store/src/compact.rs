//! Reclaiming disk space.

use serde_json::json;

use crate::Store;
use crate::checksum::CheckedColumn;
use crate::database::{Database, execute_rows, query};
use crate::error::Result;
use crate::tables::logs::insert_operation;

impl Store {
    /// Size of the campaign in bytes, with its write-ahead log in SQLite and with its indexes on a server.
    pub async fn size(&self) -> Result<u64> {
        match &self.database {
            Database::Sqlite(file) => file.size(),
            Database::Postgres(server) => server.size().await,
        }
    }

    /// Rewrites every table without the gaps of changed rows. The caller holds the [`crate::CampaignLock`]; other
    /// writers wait.
    ///
    /// # Errors
    /// [`crate::StoreError::InsufficientSpace`] if the disk cannot hold the copy that this needs. A server does not
    /// report its free space.
    pub async fn compact(&self) -> Result<()> {
        match &self.database {
            Database::Sqlite(file) => file.compact().await,
            Database::Postgres(server) => server.compact().await,
        }
    }

    /// Number of declined candidates with features.
    pub async fn declined_features(&self) -> Result<u64> {
        let with = "SELECT count(*) FROM candidate CROSS JOIN candidate_data
                    ON candidate_data.decision = candidate.decision
                    WHERE fate = 'declined' AND features IS NOT NULL";
        query(with).fetch_one(&self.database).await
    }

    /// Deletes the features of declined candidates, which only a replay with other rules needs. The caller holds
    /// the [`crate::CampaignLock`]. Returns the number of candidates.
    pub async fn drop_declined_features(&self, now: i64) -> Result<u64> {
        let mut transaction = self.database.begin_as_leader().await?;
        // The checksum of missing features depends on the candidate's number.
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
