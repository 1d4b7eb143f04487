//! Budgets: use is computed from what is stored, and no label starts once a limit is reached.

use super::protocols::set_campaign_value;
use crate::Store;
use crate::budget::{Budget, BudgetUse};
use crate::database::{Database, Transaction, query};
use crate::error::{Result, StoreError};

const MILLISECONDS_PER_HOUR: f64 = 3.6e6;

/// The totals of finished attempts that triggers keep (`migrations`): labels made, and core-milliseconds.
const TOTALS: &str = "SELECT CAST((SELECT value FROM campaign WHERE key = 'labels_made') AS BIGINT),
        CAST((SELECT value FROM campaign WHERE key = 'core_milliseconds') AS BIGINT)";

/// Running attempts, and their core-milliseconds so far.
pub(crate) const UNDER_WAY: &str = "SELECT count(*),
        CAST(coalesce(sum(CASE WHEN $1 > started THEN ($1 - started) * coalesce(cores, 1) ELSE 0 END), 0) AS BIGINT)
    FROM attempt WHERE outcome IS NULL";

/// All attempts, for tables of an earlier version that are opened read-only.
const ATTEMPTS: &str = "SELECT CAST(coalesce(sum(CASE WHEN outcome IN ('labelled', 'check') THEN 1 ELSE 0 END), 0) AS BIGINT),
        CAST(coalesce(sum(CASE WHEN outcome IS NULL THEN 1 ELSE 0 END), 0) AS BIGINT),
        CAST(coalesce(sum(CASE WHEN coalesce(ended, $1) > started THEN coalesce(ended, $1) - started ELSE 0 END), 0) AS BIGINT)
    FROM attempt";

/// The values that the totals must have, by name.
pub(crate) const SUMS: [(&str, &str); 3] = [
    ("labels_made", "SELECT CAST(count(*) AS TEXT) FROM attempt WHERE outcome IN ('labelled', 'check')"),
    (
        "core_milliseconds",
        "SELECT CAST(coalesce(sum(coalesce(CAST(round(1000 * core_seconds) AS BIGINT),
            CASE WHEN ended > started THEN (ended - started) * coalesce(cores, 1) ELSE 0 END)), 0) AS TEXT)
        FROM attempt WHERE outcome IS NOT NULL",
    ),
    (
        "label_core_milliseconds",
        "SELECT CAST(coalesce(sum(coalesce(CAST(round(1000 * core_seconds) AS BIGINT),
            CASE WHEN ended > started THEN (ended - started) * coalesce(cores, 1) ELSE 0 END)), 0) AS TEXT)
        FROM attempt WHERE outcome IN ('labelled', 'check')",
    ),
];

/// Recomputes the totals after attempts were copied.
pub(crate) async fn rebuild_totals(database: &Database) -> Result<()> {
    let mut transaction = database.begin().await?;
    for (name, sum) in SUMS {
        let sum: String = query(sum).fetch_one(&mut transaction).await?;
        set_campaign_value(&mut transaction, name, &sum).await?;
    }
    transaction.commit().await
}

impl Store {
    /// Sets the limits for every labeller from now on.
    pub async fn set_budget(&self, budget: &Budget) -> Result<()> {
        let text = serde_json::to_string(budget).expect("plain data becomes JSON");
        let mut transaction = self.database.begin_as_leader().await?;
        set_campaign_value(&mut transaction, "budget", &text).await?;
        transaction.commit().await
    }

    /// The limits, and their use until `now`.
    pub async fn budget(&self, now: i64) -> Result<(Budget, BudgetUse)> {
        let mut transaction = self.database.begin_read().await?;
        let read = read(&mut transaction, now).await?;
        transaction.commit().await?;
        Ok(read)
    }

    /// Adds to the running time of the campaign.
    pub async fn add_running_time(&self, milliseconds: u64) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        let before = time_under_way(&mut transaction).await?;
        let now = before.saturating_add(milliseconds).to_string();
        set_campaign_value(&mut transaction, "time_under_way", &now).await?;
        transaction.commit().await
    }

    /// Whether a label is in progress, or waits and may be started.
    pub async fn has_pending_labels(&self, now: i64) -> Result<bool> {
        let mut transaction = self.database.begin_read().await?;
        let some = |state: &'static str| {
            query("SELECT count(*) FROM (SELECT 1 FROM job WHERE state = $1 LIMIT 1) AS one").bind(state)
        };
        let leased: u64 = some("leased").fetch_one(&mut transaction).await?;
        let queued: u64 = some("queued").fetch_one(&mut transaction).await?;
        let awaits = leased > 0 || (queued > 0 && !forbids_attempts(&mut transaction, now).await?);
        transaction.commit().await?;
        Ok(awaits)
    }
}

/// Limits and use. On a server, its clock counts.
pub(super) async fn read(transaction: &mut Transaction, now: i64) -> Result<(Budget, BudgetUse)> {
    let limits = limits(transaction).await?;
    let now = transaction.time(now).await?;
    let (labels, attempts_in_progress, milliseconds) = attempts(transaction, now).await?;
    let used = BudgetUse {
        labels,
        attempts_in_progress,
        core_hours: milliseconds as f64 / MILLISECONDS_PER_HOUR,
        wall_hours: time_under_way(transaction).await? as f64 / MILLISECONDS_PER_HOUR,
    };
    Ok((limits, used))
}

/// Labels made, running attempts, and core-milliseconds of all attempts until `now`.
async fn attempts(transaction: &mut Transaction, now: i64) -> Result<(u64, u64, u64)> {
    let kept: (Option<u64>, Option<u64>) = query(TOTALS).fetch_one(&mut *transaction).await?;
    let (Some(labels), Some(ended)) = kept else {
        return query(ATTEMPTS).bind(now).fetch_one(&mut *transaction).await;
    };
    let (under_way, so_far): (u64, u64) = query(UNDER_WAY).bind(now).fetch_one(&mut *transaction).await?;
    Ok((labels, under_way, ended + so_far))
}

/// Whether no further attempt may start. Attempts are counted only if there is a limit.
pub(super) async fn forbids_attempts(transaction: &mut Transaction, now: i64) -> Result<bool> {
    if limits(transaction).await?.is_none() {
        return Ok(false);
    }
    let (limits, used) = read(transaction, now).await?;
    Ok(limits.forbids_attempts(&used))
}

async fn limits(transaction: &mut Transaction) -> Result<Budget> {
    let limits = query("SELECT value FROM campaign WHERE key = 'budget'");
    let limits: Option<String> = limits.fetch_optional(&mut *transaction).await?;
    let limits = limits.map(|text| serde_json::from_str(&text)).transpose();
    Ok(limits.map_err(|error| StoreError::damaged("the budget", error))?.unwrap_or_default())
}

async fn time_under_way(transaction: &mut Transaction) -> Result<u64> {
    let time = query("SELECT value FROM campaign WHERE key = 'time_under_way'");
    let time: Option<String> = time.fetch_optional(&mut *transaction).await?;
    let time = time.map(|text| text.parse()).transpose();
    Ok(time.map_err(|error| StoreError::damaged("the time under way", error))?.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use wire::CampaignId;

    use super::*;
    use crate::records::CampaignRecord;

    #[tokio::test]
    async fn totals_are_recomputed_from_the_attempts() {
        let home = tempfile::tempdir().unwrap();
        let campaign = CampaignRecord {
            id: CampaignId([1; 16]),
            program_version: String::new(),
            mode: "live".to_owned(),
            configuration: String::new(),
            resolved_configuration: "{}".to_owned(),
            configuration_in_force: "{}".to_owned(),
        };
        let store = Store::create(home.path(), &campaign, &[], 0).await.unwrap();
        let mut transaction = store.database.begin().await.unwrap();
        for name in ["labels_made", "core_milliseconds"] {
            set_campaign_value(&mut transaction, name, "7200000").await.unwrap();
        }
        transaction.commit().await.unwrap();
        let used = async || {
            let (_, used) = store.budget(0).await.unwrap();
            (used.labels, used.core_hours)
        };
        assert_eq!(used().await, (7_200_000, 2.0));
        rebuild_totals(&store.database).await.unwrap();
        assert_eq!(used().await, (0, 0.0));
    }
}
