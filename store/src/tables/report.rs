//! Pages of collected structures, and the fates of candidates, for reports.

use atoms::Vec3;
use wire::ContentHash;

use super::label_row::LabelRow;
use super::protocols::protocol_id;
use super::restore::{block, grades, origin};
use crate::Store;
use crate::checksum::{CANDIDATE, Names, ORIGINAL_GRADES, joined};
use crate::database::{FromRow, SqlRow, Transaction, query};
use crate::error::Result;
use crate::records::JobState;
use crate::report::{CollectedStructure, FateCount};

/// Candidates with their data, and with job and label under the protocol `$1`, in decision order.
macro_rules! collected {
    ($columns:literal, $which:expr) => {
        concat!(
            "SELECT candidate.decision AS decision, original_checksum, block, original_grades, state AS job_state, ",
            $columns,
            joined!(candidate),
            ", label.*
            FROM candidate
            CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
            LEFT JOIN job ON job.structure = candidate.structure AND job.protocol = $1
            LEFT JOIN label ON label.structure = candidate.structure AND label.protocol = $1 AND status = 'label'
            WHERE candidate.decision ",
            $which
        )
    };
}
pub(super) use collected;

const COLLECTED: &str = collected!("", "> $2 AND fate = 'accepted' ORDER BY candidate.decision LIMIT $3");

const BY_DECISION: &str =
    "SELECT (decision - 1) / $1 AS part, coalesce(reason, fate) AS fate, count(*) AS number
    FROM candidate WHERE origin = 'biased' GROUP BY 1, 2 ORDER BY 1, 2";

const BY_SEED_STRUCTURE: &str =
    "SELECT seed_structure AS part, coalesce(reason, fate) AS fate, count(*) AS number
    FROM candidate WHERE origin = 'biased' GROUP BY 1, 2 ORDER BY 1, 2";

const BY_WALK: &str = "SELECT walk AS part, coalesce(reason, fate) AS fate, count(*) AS number
    FROM candidate WHERE origin = 'biased' GROUP BY 1, 2 ORDER BY 1, 2";

/// No protocol has it.
const NO_PROTOCOL: i64 = -1;

impl Store {
    /// At most `limit` accepted candidates and frames of control walks after decision `after` (0: from the first),
    /// in decision order, with their labels under `protocol`. An empty page is the end.
    pub async fn collected(
        &self,
        protocol: Option<ContentHash>,
        after: i64,
        limit: u32,
    ) -> Result<Vec<CollectedStructure>> {
        let mut transaction = self.database.begin_read().await?;
        let number = protocol_number(&mut transaction, protocol).await?;
        let page = query(COLLECTED).bind(number).bind(after).bind(limit);
        let page = page.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(page)
    }

    /// Fates of candidates of biased walks, by intervals of the decision log: decisions 1 to `length` are part 0.
    pub async fn fates_by_decision(&self, length: u32) -> Result<Vec<FateCount>> {
        query(BY_DECISION).bind(i64::from(length.max(1))).fetch_all(&self.database).await
    }

    /// The same by seed structure.
    pub async fn fates_by_seed_structure(&self) -> Result<Vec<FateCount>> {
        query(BY_SEED_STRUCTURE).fetch_all(&self.database).await
    }

    /// The same by walk.
    pub async fn fates_by_walk(&self) -> Result<Vec<FateCount>> {
        query(BY_WALK).fetch_all(&self.database).await
    }
}

impl FromRow for CollectedStructure {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        ORIGINAL_GRADES.verify(row)?;
        let (job, label_forces) = job_and_forces(row)?;
        Ok(Self {
            decision: row.get("decision")?,
            origin: origin(&row.get::<String>("candidate__origin")?)?,
            seed_structure: row.get("candidate__seed_structure")?,
            block: block(row, &row.get::<String>("candidate__id")?)?,
            original: grades(row.bytes("original_grades")?)?,
            job,
            label_forces,
        })
    }
}

/// The number of a protocol, for queries that also serve campaigns without one.
pub(super) async fn protocol_number(
    transaction: &mut Transaction,
    protocol: Option<ContentHash>,
) -> Result<i64> {
    match protocol {
        Some(protocol) => protocol_id(transaction, protocol).await,
        None => Ok(NO_PROTOCOL),
    }
}

/// The state of the job and the forces of the label in a row of a query of collected structures; those of dropped jobs do not count.
pub(super) fn job_and_forces(row: &SqlRow) -> Result<(Option<JobState>, Option<Vec<Vec3>>)> {
    let job = row.text("job_state")?.and_then(JobState::named);
    let has_label = row.get::<Option<i64>>("number")?.is_some();
    let label = (has_label && job != Some(JobState::Dropped)).then(|| LabelRow::from_row(row));
    Ok((job, label.transpose()?.map(LabelRow::forces).transpose()?))
}

impl FromRow for FateCount {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self { part: row.get("part")?, fate: row.get("fate")?, number: row.get("number")? })
    }
}
