//! Packed work directories of calculations.

use crate::Store;
use crate::checksum::{ARCHIVE, Names};
use crate::database::{FromRow, SqlRow, from_columns, query};
use crate::error::Result;
use crate::jobs::{CalculationArchive, PastCalculation};

impl Store {
    /// Stores the packed directory of an attempt's calculation, replacing an earlier one. `left_out` names the
    /// files that are not in it.
    pub async fn keep_archive(&self, job: i64, attempt: u32, bytes: &[u8], left_out: &str) -> Result<()> {
        let mut transaction = self.database.begin().await?;
        let sql = "INSERT INTO archive (job, attempt, bytes, left_out, checksum) VALUES ($1, $2, $3, $4, $5)
                   ON CONFLICT (job, attempt) DO UPDATE SET bytes = excluded.bytes, left_out = excluded.left_out,
                       checksum = excluded.checksum";
        let row = vec![job.into(), attempt.into(), bytes.into(), left_out.into()];
        query(sql).bind_all(ARCHIVE.with_checksum(row)).execute(&mut transaction).await?;
        transaction.commit().await
    }

    /// Packed directories of a job's calculations, by attempt.
    pub async fn archives(&self, job: i64) -> Result<Vec<CalculationArchive>> {
        let sql = "SELECT * FROM archive WHERE job = $1 ORDER BY attempt";
        query(sql).bind(job).fetch_all(&self.database).await
    }

    /// The state of an attempt and its calculation; `None` if there was no such attempt.
    pub async fn past_calculation(&self, job: i64, attempt: u32) -> Result<Option<PastCalculation>> {
        let sql = "SELECT calculation,
                   CAST(CASE WHEN outcome = 'failed' THEN 1 ELSE 0 END AS BIGINT) AS failed,
                   CAST(CASE WHEN state IN ('queued', 'leased')
                       AND (outcome IS NULL OR outcome IN ('expired', 'lost', 'released')) THEN 1 ELSE 0 END AS BIGINT)
                       AS wanted
                   FROM attempt JOIN job ON job.number = attempt.job WHERE job = $1 AND attempt = $2";
        let row: Option<CalculationRow> =
            query(sql).bind(job).bind(attempt).fetch_optional(&self.database).await?;
        Ok(row.map(|CalculationRow { calculation, failed, wanted }| PastCalculation {
            calculation,
            failed: failed != 0,
            wanted: wanted != 0,
        }))
    }
}

struct CalculationRow {
    calculation: Option<String>,
    failed: i64,
    wanted: i64,
}

from_columns!(CalculationRow { calculation, failed, wanted });

impl FromRow for CalculationArchive {
    fn from_row(row: &SqlRow) -> Result<Self> {
        ARCHIVE.verify(row, Names::Plain)?;
        Ok(Self { attempt: row.get("attempt")?, bytes: row.get("bytes")?, left_out: row.get("left_out")? })
    }
}
