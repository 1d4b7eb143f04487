//! Everything that was collected, page by page, and what became of candidates, for reports.

use wire::{CandidateBlock, ContentHash};

use super::restore::{grades, origin};
use crate::Store;
use crate::collected::{Collected, FateCount};
use crate::database::{FromRow, Row, query};
use crate::encoding::decode_vectors;
use crate::error::{Result, StoreError};
use crate::records::JobState;

const COLLECTED: &str =
    "SELECT candidate.decision AS decision, candidate.seed_structure AS seed_structure, origin,
        block, original_grades, state, CASE WHEN state = 'dropped' THEN NULL ELSE label.forces END AS forces
    FROM candidate
    CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
    LEFT JOIN job ON job.structure = candidate.structure AND job.protocol = $1
    LEFT JOIN label ON label.structure = candidate.structure AND label.protocol = $1 AND standing = 'label'
    WHERE candidate.decision > $2 AND fate = 'accepted'
    ORDER BY candidate.decision LIMIT $3";

const BY_DECISION: &str =
    "SELECT (decision - 1) / $1 AS part, coalesce(reason, fate) AS fate, count(*) AS number
    FROM candidate WHERE origin = 'biased' GROUP BY 1, 2 ORDER BY 1, 2";

const BY_SEED_STRUCTURE: &str =
    "SELECT seed_structure AS part, coalesce(reason, fate) AS fate, count(*) AS number
    FROM candidate WHERE origin = 'biased' GROUP BY 1, 2 ORDER BY 1, 2";

/// No protocol has it.
const NO_PROTOCOL: i64 = -1;

impl Store {
    /// At most `limit` accepted candidates and frames of control walks behind decision number `after` (0: from the first on),
    /// in decision order, with their labels of `protocol`. An empty page is the end.
    pub async fn collected(
        &self,
        protocol: Option<ContentHash>,
        after: i64,
        limit: u32,
    ) -> Result<Vec<Collected>> {
        let mut transaction = self.database.begin_to_read().await?;
        let number = match protocol {
            Some(protocol) => super::protocols::number(&mut transaction, protocol).await?,
            None => NO_PROTOCOL,
        };
        let page = query(COLLECTED).bind(number).bind(after).bind(limit);
        let page = page.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(page)
    }

    /// What became of candidates of biased walks, by parts of the decision log: decisions 1 to `length` are part 0.
    pub async fn fates_by_decision(&self, length: u32) -> Result<Vec<FateCount>> {
        query(BY_DECISION).bind(i64::from(length.max(1))).fetch_all(&self.database).await
    }

    /// The same by seed structure.
    pub async fn fates_by_seed_structure(&self) -> Result<Vec<FateCount>> {
        query(BY_SEED_STRUCTURE).fetch_all(&self.database).await
    }
}

impl FromRow for Collected {
    fn from_row(row: &Row) -> Result<Self> {
        let (block, grades_of): (Vec<u8>, Option<Vec<u8>>) = (row.get("block")?, row.get("original_grades")?);
        let forces: Option<Vec<u8>> = row.get("forces")?;
        let damaged = || StoreError::damaged("a label", "its forces have a wrong length");
        let forces = forces.map(|bytes| decode_vectors(&bytes).ok_or_else(damaged)).transpose()?;
        let state: Option<String> = row.get("state")?;
        Ok(Self {
            decision: row.get("decision")?,
            origin: origin(&row.get::<String>("origin")?)?,
            seed_structure: row.get("seed_structure")?,
            block: CandidateBlock::from_bytes(&block)?,
            original: grades(grades_of.as_deref())?,
            job: state.and_then(|state| JobState::named(&state)),
            label_forces: forces,
        })
    }
}

impl FromRow for FateCount {
    fn from_row(row: &Row) -> Result<Self> {
        Ok(Self { part: row.get("part")?, fate: row.get("fate")?, number: row.get("number")? })
    }
}
