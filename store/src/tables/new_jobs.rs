//! Adds label jobs.

use crate::database::{SqlValue, Transaction, execute_rows};
use crate::error::Result;

/// Columns of a new job.
const JOB: [&str; 4] = ["hash", "protocol", "decision", "priority"];

/// Adds a job for each structure that has none. It is done at once if the label exists.
const INSERT_JOBS: &str = "INSERT INTO job (structure, protocol, decision, priority, state)
    SELECT structure.number, new.protocol, new.decision, new.priority, CASE WHEN EXISTS (
        SELECT 1 FROM label WHERE label.structure = structure.number AND label.protocol = new.protocol
        AND status IN ('label', 'excluded')) THEN 'labelled' ELSE 'queued' END
    FROM {rows} CROSS JOIN structure ON structure.hash = new.hash WHERE TRUE
    ON CONFLICT (structure, protocol) DO NOTHING";

/// Adds jobs with these hashes, protocols, decisions and priorities.
pub(super) async fn insert_jobs(transaction: &mut Transaction, jobs: Vec<Vec<SqlValue>>) -> Result<u64> {
    execute_rows(transaction, INSERT_JOBS, &JOB, jobs).await
}

/// Adds jobs for existing candidates, given as (structure, decision).
pub(super) async fn enqueue(
    transaction: &mut Transaction,
    candidates: &[(Vec<u8>, i64)],
    protocol: i64,
    priority: i32,
) -> Result<()> {
    let row = |(hash, decision): &(Vec<u8>, i64)| {
        vec![hash.clone().into(), protocol.into(), (*decision).into(), priority.into()]
    };
    insert_jobs(transaction, candidates.iter().map(row).collect()).await?;
    Ok(())
}
