//! The decision log, which is identical for two runs of a reproducible campaign, and the operations log, which is
//! not.

use std::fmt::Write;
use std::ops::RangeInclusive;

use serde_json::Value;

use crate::Store;
use crate::checksum::{DECISION, Names};
use crate::database::{FromRow, SqlRow, Transaction, query};
use crate::error::{Result, StoreError};
use crate::records::{LoggedDecision, LoggedOperation};

/// Decisions read at a time.
const PAGE: usize = 1000;

struct DecisionRow {
    sequence: i64,
    round: u64,
    kind: String,
    walk: Option<u32>,
    candidate: Option<String>,
    mixture_version: u64,
    detail: String,
}

impl FromRow for DecisionRow {
    fn from_row(row: &SqlRow) -> Result<Self> {
        DECISION.verify(row, Names::Plain)?;
        Ok(Self {
            sequence: row.get("sequence")?,
            round: row.get("round")?,
            kind: row.get("kind")?,
            walk: row.get("walk")?,
            candidate: row.get("candidate")?,
            mixture_version: row.get("mixture_version")?,
            detail: row.get("detail")?,
        })
    }
}

impl DecisionRow {
    fn decode(self) -> Result<LoggedDecision> {
        let detail = serde_json::from_str(&self.detail);
        let detail = detail.map_err(|error| StoreError::damaged("the decision log", error))?;
        let Self { sequence, round, kind, walk, candidate, mixture_version, .. } = self;
        Ok(LoggedDecision { sequence, round, kind, walk, candidate, mixture_version, detail })
    }
}

impl Store {
    /// Decisions with sequence numbers (from 1) in `range`, in order.
    pub async fn decisions(&self, range: RangeInclusive<i64>) -> Result<Vec<LoggedDecision>> {
        self.decision_rows(range).await?.into_iter().map(DecisionRow::decode).collect()
    }

    /// All decisions of a kind, in order. Reads the whole log.
    pub async fn decisions_of_kind(&self, kind: &str) -> Result<Vec<LoggedDecision>> {
        let query = query("SELECT * FROM decision WHERE kind = $1 ORDER BY sequence").bind(kind);
        let rows: Vec<DecisionRow> = query.fetch_all(&self.database).await?;
        rows.into_iter().map(DecisionRow::decode).collect()
    }

    async fn decision_rows(&self, range: RangeInclusive<i64>) -> Result<Vec<DecisionRow>> {
        let sql = "SELECT * FROM decision WHERE sequence BETWEEN $1 AND $2 ORDER BY sequence";
        let query = query(sql).bind(*range.start()).bind(*range.end());
        query.fetch_all(&self.database).await
    }

    /// The whole decision log, one JSON object per line with keys in a fixed order. Byte-identical for two runs of
    /// a campaign in reproducible mode.
    pub async fn decision_log_text(&self) -> Result<String> {
        let mut text = String::new();
        for first in (1..).step_by(PAGE) {
            let rows = self.decision_rows(first..=first + PAGE as i64 - 1).await?;
            if rows.is_empty() {
                break;
            }
            rows.iter().for_each(|row| write_line(&mut text, row));
        }
        Ok(text)
    }

    /// Adds a line to the operations log. The caller chooses `kind`; `detail` is a JSON object.
    pub async fn log_operation(&self, now: i64, kind: &str, detail: &Value) -> Result<()> {
        let mut transaction = self.database.begin().await?;
        insert_operation(&mut transaction, now, kind, detail).await?;
        transaction.commit().await
    }

    /// At most `limit` lines of the operations log after line `after`, in order.
    pub async fn operations(&self, after: i64, limit: u32) -> Result<Vec<LoggedOperation>> {
        let sql =
            "SELECT number, time, kind, detail FROM operation WHERE number > $1 ORDER BY number LIMIT $2";
        let rows: Vec<(i64, i64, String, String)> =
            query(sql).bind(after).bind(limit).fetch_all(&self.database).await?;
        rows.into_iter()
            .map(|(number, time, kind, detail)| {
                let detail = serde_json::from_str(&detail);
                let detail = detail.map_err(|error| StoreError::damaged("the operations log", error))?;
                Ok(LoggedOperation { number, time, kind, detail })
            })
            .collect()
    }
}

fn write_line(text: &mut String, row: &DecisionRow) {
    let DecisionRow { sequence, round, mixture_version, detail, .. } = row;
    let (kind, candidate) = (Value::from(row.kind.as_str()), Value::from(row.candidate.clone()));
    let walk = Value::from(row.walk);
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        r#"{{"sequence":{sequence},"round":{round},"kind":{kind},"walk":{walk},"candidate":{candidate},"mixture_version":{mixture_version},"detail":{detail}}}"#
    );
}

pub(crate) async fn insert_operation(
    transaction: &mut Transaction,
    now: i64,
    kind: &str,
    detail: &Value,
) -> Result<()> {
    let sql = "INSERT INTO operation (time, kind, detail) VALUES ($1, $2, $3)";
    let detail = detail.to_string();
    tracing::info!(kind, detail, "operation");
    query(sql).bind(now).bind(kind).bind(detail).execute(&mut *transaction).await?;
    Ok(())
}
