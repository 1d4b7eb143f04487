//! Traces of walks: one row each, which commits make longer until it has as many points as are kept.

use std::collections::BTreeMap;

use wire::{TracePoint, WalkId, thin};

use crate::Store;
use crate::checksum::{Names, WALK_TRACE};
use crate::database::{FromRow, SqlRow, Transaction, execute_rows, query};
use crate::error::Result;
use crate::walk_trace::{POINT_BYTES, decode, encode};

const TABLE: &str = "walk_trace";
const COLUMNS: [&str; 4] = ["walk", "points", "data", "checksum"];

const UPSERT: &str = "INSERT INTO walk_trace ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (walk) DO UPDATE SET {excluded}";

/// The last number of each trace. The last quantity of the newest points is γ_max under the original mixture; traces of earlier versions are
/// shorter. Reads no more of a trace than that, and so cannot verify its checksum.
const LAST_NUMBERS: &str = "SELECT walk, substr(data, length(data) - 7, 8) AS last FROM walk_trace WHERE length(data) = 8 + $1 * points AND points > 0";

impl Store {
    /// The trace of a walk in the order of its points. Empty for walks of earlier versions and without a trace.
    pub async fn walk_trace(&self, walk: WalkId) -> Result<Vec<TracePoint>> {
        let mut transaction = self.database.begin_read().await?;
        let trace = read(&mut transaction, walk).await?;
        transaction.commit().await?;
        Ok(trace)
    }
}

async fn read(transaction: &mut Transaction, walk: WalkId) -> Result<Vec<TracePoint>> {
    if !transaction.has_table(TABLE).await? {
        return Ok(Vec::new());
    }
    stored(transaction, walk).await
}

async fn stored(transaction: &mut Transaction, walk: WalkId) -> Result<Vec<TracePoint>> {
    let row = query("SELECT * FROM walk_trace WHERE walk = $1").bind(walk.0);
    let trace: Option<StoredTrace> = row.fetch_optional(transaction).await?;
    Ok(trace.map(|trace| trace.0).unwrap_or_default())
}

/// γ_max under the original mixture at the last point of each trace, by walk, within a transaction.
pub(super) async fn last_original_grades(transaction: &mut Transaction) -> Result<BTreeMap<u32, f64>> {
    if !transaction.has_table(TABLE).await? {
        return Ok(BTreeMap::new());
    }
    let rows: Vec<(u32, Vec<u8>)> = query(LAST_NUMBERS).bind(POINT_BYTES).fetch_all(transaction).await?;
    let grade = |(walk, last): (u32, Vec<u8>)| Some((walk, f64::from_le_bytes(last.try_into().ok()?)));
    Ok(rows.into_iter().filter_map(grade).filter(|(_, gamma)| gamma.is_finite()).collect())
}

/// Adds new points to the traces of their walks, and thins these.
pub(super) async fn append(transaction: &mut Transaction, new: &[(WalkId, Vec<TracePoint>)]) -> Result<()> {
    let mut walks = BTreeMap::<WalkId, Vec<&TracePoint>>::new();
    for (walk, points) in new.iter().filter(|(_, points)| !points.is_empty()) {
        walks.entry(*walk).or_default().extend(points);
    }
    let mut rows = Vec::new();
    for (walk, points) in walks {
        let mut trace = stored(transaction, walk).await?;
        for point in points {
            // An assignment that was interrupted on a walker that seemed lost is repeated from its start.
            while trace.last().is_some_and(|last| last.number >= point.number) {
                trace.pop();
            }
            trace.push(point.clone());
        }
        thin(&mut trace);
        let row = vec![walk.0.into(), (trace.len() as i64).into(), encode(&trace).into()];
        rows.push(WALK_TRACE.with_checksum(row));
    }
    execute_rows(transaction, UPSERT, &COLUMNS, rows).await?;
    Ok(())
}

struct StoredTrace(Vec<TracePoint>);

impl FromRow for StoredTrace {
    fn from_row(row: &SqlRow) -> Result<Self> {
        WALK_TRACE.verify(row, Names::Plain)?;
        let (walk, points, data): (u32, u32, Vec<u8>) =
            (row.get("walk")?, row.get("points")?, row.get("data")?);
        Ok(Self(decode(walk, points as usize, &data)?))
    }
}
