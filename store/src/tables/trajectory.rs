//! Trajectories of walks: a row for each record of an assignment that has frames, written with it.

use wire::{WalkFrame, WalkId};

use crate::checksum::{Names, TRAJECTORY};
use crate::database::{FromRow, SqlRow, SqlValue, Transaction, execute_rows, query};
use crate::encoding::integer;
use crate::error::Result;
use crate::records::TrajectoryPart;
use crate::trajectory::{decode, encode};

/// Rows verified at a time: a row has the positions of many frames.
const PAGE: u32 = 16;

const TABLE: &str = "trajectory";
const COLUMNS: [&str; 5] = ["walk", "part", "frames", "data", "checksum"];
const INSERT: &str = "INSERT INTO trajectory ({columns}) SELECT * FROM {rows}";

/// The frames of a part of a walk, within a transaction. Tables of earlier versions have none.
pub(super) async fn read(transaction: &mut Transaction, walk: WalkId, part: u64) -> Result<Vec<WalkFrame>> {
    if !transaction.has_table(TABLE).await? {
        return Ok(Vec::new());
    }
    let row = query("SELECT * FROM trajectory WHERE walk = $1 AND part = $2").bind(walk.0);
    let row = row.bind(integer("number of a record", part)?);
    let found: Option<StoredFrames> = row.fetch_optional(transaction).await?;
    Ok(found.map(|StoredFrames(frames)| frames).unwrap_or_default())
}

/// The rows of parts.
pub(super) fn rows(parts: &[TrajectoryPart]) -> Result<Vec<Vec<SqlValue>>> {
    let row = |TrajectoryPart { walk, part, frames }: &TrajectoryPart| {
        let (part, count) = (integer("number of a record", *part)?, frames.len() as i64);
        Ok(TRAJECTORY.with_checksum(vec![walk.0.into(), part.into(), count.into(), encode(frames).into()]))
    };
    parts.iter().filter(|part| !part.frames.is_empty()).map(row).collect()
}

/// Adds rows.
pub(super) async fn append(transaction: &mut Transaction, rows: Vec<Vec<SqlValue>>) -> Result<()> {
    execute_rows(transaction, INSERT, &COLUMNS, rows).await?;
    Ok(())
}

/// Verifies every row, its frames, and that it belongs to a record. Returns the faults.
pub(super) async fn verify(transaction: &mut Transaction) -> Result<Vec<String>> {
    let mut faults = Vec::new();
    if !transaction.has_table(TABLE).await? {
        return Ok(faults);
    }
    let sql = "SELECT trajectory.*, assignment.number AS record FROM trajectory
        LEFT JOIN assignment ON assignment.walk = trajectory.walk AND assignment.part = trajectory.part
        WHERE (trajectory.walk, trajectory.part) > ($1, $2) ORDER BY trajectory.walk, trajectory.part LIMIT $3";
    let mut after = (-1_i64, -1_i64);
    loop {
        let page = query(sql).bind(after.0).bind(after.1).bind(PAGE).rows(&mut *transaction).await?;
        let Some(last) = page.last() else { return Ok(faults) };
        after = (last.get("walk")?, last.get("part")?);
        for row in &page {
            faults.extend(StoredFrames::from_row(row).err().map(|error| error.to_string()));
            if row.get::<Option<i64>>("record")?.is_none() {
                let (walk, part): (i64, i64) = (row.get("walk")?, row.get("part")?);
                faults.push(format!("trajectory of walk {walk}: part {part} belongs to no assignment"));
            }
        }
    }
}

struct StoredFrames(Vec<WalkFrame>);

impl FromRow for StoredFrames {
    fn from_row(row: &SqlRow) -> Result<Self> {
        TRAJECTORY.verify(row, Names::Plain)?;
        let (walk, frames, data): (u32, u32, Vec<u8>) =
            (row.get("walk")?, row.get("frames")?, row.get("data")?);
        Ok(Self(decode(walk, frames as usize, &data)?))
    }
}
