//! Assignments of walks, with which these can be run again, and V₀ of walks at constant pressure.

use std::collections::BTreeMap;

use wire::WalkId;
use wire::messages::{AssignmentStart, PathPosition, Verdict};

use crate::checksum::{ASSIGNMENT, Names, REFERENCE_VOLUME};
use crate::database::{FromRow, SqlRow, SqlValue, Transaction, execute_rows, query};
use crate::encoding::integer;
use crate::error::{Result, StoreError};
use crate::records::{AssignmentRecord, Commit};

/// Rows verified at a time.
const PAGE: u32 = 500;

pub(super) const TABLE: &str = "assignment";
const COLUMNS: [&str; 13] = [
    "walk",
    "part",
    "number",
    "mixture_version",
    "threshold_factor",
    "verdict",
    "start_segment",
    "start_step",
    "start_reference_step",
    "segment",
    "step",
    "reference_step",
    "checksum",
];
const INSERT: &str = "INSERT INTO assignment ({columns}) SELECT * FROM {rows}";

const VOLUMES: &str = "reference_volume";
const VOLUME_COLUMNS: [&str; 3] = ["walk", "volume", "checksum"];
const INSERT_VOLUMES: &str = "INSERT INTO reference_volume ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (walk) DO NOTHING";

/// V₀ of the walks that have one, within a transaction.
pub(super) async fn reference_volumes(transaction: &mut Transaction) -> Result<BTreeMap<u32, f64>> {
    if !transaction.has_table(VOLUMES).await? {
        return Ok(BTreeMap::new());
    }
    let rows = query("SELECT * FROM reference_volume ORDER BY walk");
    let rows: Vec<ReferenceVolume> = rows.fetch_all(transaction).await?;
    Ok(rows.into_iter().map(|row| (row.walk, row.volume)).collect())
}

/// Adds the assignments and the reference volumes of a commit. The latter never change.
pub(super) async fn append(transaction: &mut Transaction, commit: &Commit) -> Result<()> {
    let rows = commit.assignments.iter().map(row).collect::<Result<_>>()?;
    execute_rows(transaction, INSERT, &COLUMNS, rows).await?;
    let of = |walk: &crate::WalkRecord| Some((walk.walk.0, walk.progress.reference_volume?));
    let volumes: BTreeMap<u32, f64> = commit.walks.iter().filter_map(of).collect();
    let rows = volumes
        .into_iter()
        .map(|(walk, volume)| REFERENCE_VOLUME.with_checksum(vec![walk.into(), volume.into()]));
    execute_rows(transaction, INSERT_VOLUMES, &VOLUME_COLUMNS, rows.collect()).await?;
    Ok(())
}

/// Verifies every row. Returns the faults.
pub(super) async fn verify(transaction: &mut Transaction) -> Result<Vec<String>> {
    let mut faults = Vec::new();
    if !transaction.has_table(TABLE).await? {
        return Ok(faults);
    }
    let sql = "SELECT * FROM assignment WHERE (walk, part) > ($1, $2) ORDER BY walk, part LIMIT $3";
    let mut after = (-1_i64, -1_i64);
    loop {
        let page = query(sql).bind(after.0).bind(after.1).bind(PAGE).rows(&mut *transaction).await?;
        let Some(last) = page.last() else { break };
        after = (last.get("walk")?, last.get("part")?);
        let verified = page.iter().map(|row| ASSIGNMENT.verify(row, Names::Plain));
        faults.extend(verified.filter_map(|found| Some(found.err()?.to_string())));
    }
    for row in query("SELECT * FROM reference_volume ORDER BY walk").rows(transaction).await? {
        faults.extend(REFERENCE_VOLUME.verify(&row, Names::Plain).err().map(|error| error.to_string()));
    }
    Ok(faults)
}

fn row(record: &AssignmentRecord) -> Result<Vec<SqlValue>> {
    let AssignmentRecord { walk, part, number, start, end } = record;
    let step = |step: u64| integer("step", step);
    let reference = |at: &PathPosition| at.reference_step.map(step).transpose();
    Ok(ASSIGNMENT.with_checksum(vec![
        walk.0.into(),
        integer("number of a record", *part)?.into(),
        integer("number of an assignment", *number)?.into(),
        integer("mixture version", start.mixture_version)?.into(),
        start.threshold_factor.into(),
        start.verdict.as_ref().map(Verdict::name).into(),
        start.position.segment.into(),
        step(start.position.step)?.into(),
        reference(&start.position)?.into(),
        end.segment.into(),
        step(end.step)?.into(),
        reference(end)?.into(),
    ]))
}

impl FromRow for AssignmentRecord {
    fn from_row(row: &SqlRow) -> Result<Self> {
        ASSIGNMENT.verify(row, Names::Plain)?;
        let verdict: Option<String> = row.get("verdict")?;
        let known = |name: String| {
            let unknown = || StoreError::damaged("an assignment", format!("unknown verdict {name}"));
            Verdict::named(&name).ok_or_else(unknown)
        };
        let position = |segment, step, reference_step| -> Result<PathPosition> {
            Ok(PathPosition {
                segment: row.get(segment)?,
                step: row.get(step)?,
                reference_step: row.get(reference_step)?,
            })
        };
        Ok(Self {
            walk: WalkId(row.get("walk")?),
            part: row.get("part")?,
            number: row.get("number")?,
            start: AssignmentStart {
                position: position("start_segment", "start_step", "start_reference_step")?,
                mixture_version: row.get("mixture_version")?,
                threshold_factor: row.get("threshold_factor")?,
                verdict: verdict.map(known).transpose()?,
            },
            end: position("segment", "step", "reference_step")?,
        })
    }
}

struct ReferenceVolume {
    walk: u32,
    volume: f64,
}

impl FromRow for ReferenceVolume {
    fn from_row(row: &SqlRow) -> Result<Self> {
        REFERENCE_VOLUME.verify(row, Names::Plain)?;
        Ok(Self { walk: row.get("walk")?, volume: row.get("volume")? })
    }
}
