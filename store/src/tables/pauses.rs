//! Walks paused by the user: a request in the database that the run obeys.

use std::collections::BTreeSet;

use serde_json::json;
use wire::WalkId;

use super::logs::insert_operation;
use super::protocols::set_campaign_value;
use crate::Store;
use crate::database::{Transaction, query};
use crate::error::{Result, StoreError};

/// The campaign key of the list.
const KEY: &str = "paused_walks";

const SELECT: &str = "SELECT value FROM campaign WHERE key = $1";

impl Store {
    /// Walks that get no assignments until they are resumed.
    pub async fn paused_walks(&self) -> Result<BTreeSet<WalkId>> {
        let found: Option<String> = query(SELECT).bind(KEY).fetch_optional(&self.database).await?;
        decode(found)
    }

    /// Walks that have more steps to make.
    pub async fn active_walks(&self) -> Result<Vec<WalkId>> {
        let sql = "SELECT walk FROM walk WHERE state IN ('waiting', 'running') ORDER BY walk";
        let walks: Vec<u32> = query(sql).fetch_all(&self.database).await?;
        Ok(walks.into_iter().map(WalkId).collect())
    }

    /// Pauses or resumes walks: paused walks get no assignments. Adds a line to the operations log for each change;
    /// walks already in that state do not change. Returns the changed walks.
    ///
    /// # Errors
    /// [`StoreError::UnknownWalk`], or [`StoreError::EndedWalk`] when pausing. Nothing is changed then.
    pub async fn pause_walks(&self, walks: &[WalkId], paused: bool, now: i64) -> Result<Vec<WalkId>> {
        let mut transaction = self.database.begin().await?;
        // Ensures that there is a row to lock.
        let sql = "INSERT INTO campaign (key, value) VALUES ($1, '[]') ON CONFLICT (key) DO NOTHING";
        query(sql).bind(KEY).execute(&mut transaction).await?;
        let found = query(SELECT).bind(KEY).locked().fetch_optional(&mut transaction).await?;
        let mut list = decode(found)?;
        let mut changed = Vec::new();
        for walk in walks {
            check(&mut transaction, *walk, paused).await?;
            if if paused { list.insert(*walk) } else { list.remove(walk) } {
                let kind = if paused { "pause" } else { "resume" };
                insert_operation(&mut transaction, now, kind, &json!({ "walk": walk })).await?;
                changed.push(*walk);
            }
        }
        set_campaign_value(&mut transaction, KEY, &json!(list).to_string()).await?;
        transaction.commit().await?;
        Ok(changed)
    }
}

/// Checks that the walk exists and may be paused.
async fn check(transaction: &mut Transaction, walk: WalkId, paused: bool) -> Result<()> {
    let state = query("SELECT state FROM walk WHERE walk = $1").bind(walk.0);
    let state: Option<String> = state.fetch_optional(&mut *transaction).await?;
    match state.as_deref() {
        None => {
            let walks = query("SELECT count(*) FROM walk").fetch_one(transaction).await?;
            Err(StoreError::UnknownWalk { walk, walks })
        }
        Some("waiting" | "running") => Ok(()),
        Some(state) if paused => Err(StoreError::EndedWalk { walk, state: state.replace('_', " ") }),
        Some(_) => Ok(()),
    }
}

/// [`Store::paused_walks`] in a transaction.
pub(super) async fn read(transaction: &mut Transaction) -> Result<BTreeSet<WalkId>> {
    decode(query(SELECT).bind(KEY).fetch_optional(transaction).await?)
}

fn decode(list: Option<String>) -> Result<BTreeSet<WalkId>> {
    let Some(list) = list else { return Ok(BTreeSet::new()) };
    serde_json::from_str(&list).map_err(|error| StoreError::damaged("the list of paused walks", error))
}
