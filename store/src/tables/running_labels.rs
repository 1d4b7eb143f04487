//! Attempts at labels that are under way, for those who watch.

use crate::Store;
use crate::database::query;
use crate::error::Result;
use crate::running_labels::RunningLabel;

/// Reads the index of attempts without an end. `decision` of the job of an imported structure is 2^40 + the number of the import.
const RUNNING: &str = "SELECT attempt.job AS job, attempt.attempt AS attempt, attempt.holder AS holder, attempt.started AS started,
        attempt.cores AS cores, coalesce(candidate.id, 'import-' || CAST(job.decision - 1099511627776 AS TEXT)) AS candidate,
        coalesce(candidate.seed_structure, 4294967295) AS seed_structure, structure.formula AS formula,
        structure.atoms AS atoms, protocol.name AS protocol
    FROM attempt CROSS JOIN job ON job.number = attempt.job
    CROSS JOIN structure ON structure.number = job.structure
    CROSS JOIN protocol ON protocol.number = job.protocol
    LEFT JOIN candidate ON candidate.decision = job.decision
    WHERE attempt.outcome IS NULL ORDER BY attempt.started, attempt.job LIMIT $1";

impl Store {
    /// At most `limit` labels that are being made, the longest first.
    pub async fn running_labels(&self, limit: u32) -> Result<Vec<RunningLabel>> {
        let mut transaction = self.database.begin_read().await?;
        let found = match transaction.has_column("attempt", "cores").await? {
            true => query(RUNNING).bind(limit).fetch_all(&mut transaction).await?,
            false => Vec::new(),
        };
        transaction.commit().await?;
        Ok(found)
    }
}
