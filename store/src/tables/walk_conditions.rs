//! The conditions of walks. They never change, so they have a table of their own, which commits do not write again.

use std::collections::BTreeMap;

use wire::{WalkConditions, WalkId};

use crate::Store;
use crate::checksum::{Names, WALK_CONDITIONS};
use crate::database::{FromRow, SqlRow, Transaction, query};
use crate::error::{Result, StoreError};
use crate::versions::WalkVersions;

const TABLE: &str = "walk_conditions";

impl Store {
    /// The conditions of each walk. Those of campaigns of earlier versions are missing.
    pub async fn walk_conditions(&self) -> Result<BTreeMap<WalkId, WalkConditions>> {
        let mut transaction = self.database.begin_read().await?;
        let conditions = read(&mut transaction).await?;
        transaction.commit().await?;
        Ok(conditions)
    }

    /// The version of the potential of each walk.
    pub async fn walk_versions(&self) -> Result<WalkVersions> {
        let mut transaction = self.database.begin_read().await?;
        let found = versions(&mut transaction).await?;
        transaction.commit().await?;
        Ok(found)
    }
}

/// The version of the potential of each walk, within a transaction.
pub(super) async fn versions(transaction: &mut Transaction) -> Result<WalkVersions> {
    let conditions = read(transaction).await?;
    Ok(WalkVersions::from_walks(conditions.iter().map(|(walk, of)| (walk.0, of.version))))
}

/// The conditions of each walk, within a transaction.
pub(super) async fn read(transaction: &mut Transaction) -> Result<BTreeMap<WalkId, WalkConditions>> {
    if !transaction.has_table(TABLE).await? {
        return Ok(BTreeMap::new());
    }
    let rows = query("SELECT * FROM walk_conditions ORDER BY walk");
    let rows: Vec<(WalkId, WalkConditions)> = rows.fetch_all(transaction).await?;
    Ok(rows.into_iter().collect())
}

impl FromRow for (WalkId, WalkConditions) {
    fn from_row(row: &SqlRow) -> Result<Self> {
        WALK_CONDITIONS.verify(row, Names::Plain)?;
        let (walk, text): (u32, String) = (row.get("walk")?, row.get("conditions")?);
        let conditions = serde_json::from_str(&text)
            .map_err(|error| StoreError::damaged(format!("conditions of walk {walk}"), error.to_string()))?;
        Ok((WalkId(walk), conditions))
    }
}
