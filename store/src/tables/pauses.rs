//! Walks that people have paused: a request that stands in the database, and that whoever runs the campaign obeys.

use std::collections::BTreeSet;

use serde_json::json;
use wire::WalkId;

use super::logs::insert_operation;
use super::protocols::set_campaign_value;
use crate::Store;
use crate::database::{Transaction, query};
use crate::error::{Result, StoreError};

/// Under which name the campaign has the list of them.
const KEY: &str = "paused_walks";

const SELECT: &str = "SELECT value FROM campaign WHERE key = $1";

impl Store {
    /// Walks that get no turn until somebody resumes them.
    pub async fn paused_walks(&self) -> Result<BTreeSet<WalkId>> {
        let found: Option<String> = query(SELECT).bind(KEY).fetch_optional(&self.database).await?;
        decode(found)
    }

    /// Walks that have more steps to make.
    pub async fn walks_under_way(&self) -> Result<Vec<WalkId>> {
        let sql = "SELECT walk FROM walk WHERE state IN ('waiting', 'running') ORDER BY walk";
        let walks: Vec<u32> = query(sql).fetch_all(&self.database).await?;
        Ok(walks.into_iter().map(WalkId).collect())
    }

    /// Asks that these walks get no turn until they are resumed, or that they get turns again. Each change leaves a line in the
    /// operations log; what is so already is none. Returns the walks that were changed.
    ///
    /// # Errors
    /// [`StoreError::UnknownWalk`]; [`StoreError::EndedWalk`] if it is to be paused. Nothing is changed then.
    pub async fn pause_walks(&self, walks: &[WalkId], paused: bool, now: i64) -> Result<Vec<WalkId>> {
        let mut transaction = self.database.begin().await?;
        // So that there is a row to lock.
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

/// Whether it is there, and may be paused.
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

/// The same as [`Store::paused_walks`], in a transaction.
pub(super) async fn read(transaction: &mut Transaction) -> Result<BTreeSet<WalkId>> {
    decode(query(SELECT).bind(KEY).fetch_optional(transaction).await?)
}

fn decode(list: Option<String>) -> Result<BTreeSet<WalkId>> {
    let Some(list) = list else { return Ok(BTreeSet::new()) };
    serde_json::from_str(&list).map_err(|error| StoreError::damaged("the list of paused walks", error))
}
