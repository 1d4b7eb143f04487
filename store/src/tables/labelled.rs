//! Labelled candidates, and candidates whose label failed.

use wire::ContentHash;

use super::decision_list::{decision_list, lists};
use super::label_row::LabelRow;
use super::protocols::protocol_id;
use super::restore::{block, grades, origin};
use crate::Store;
use crate::checksum::{CANDIDATE, Names, ORIGINAL_GRADES, joined};
use crate::database::{FromRow, SqlRow, query};
use crate::encoding::decode_hash;
use crate::error::{Result, StoreError};
use crate::labelled::{FailedCandidate, LabelledCandidate};
use crate::records::JobState;

/// The columns of a [`LabelledCandidate`].
macro_rules! labelled_columns {
    () => {
        concat!(
            "candidate.decision AS decision, original_checksum, block, original_grades, structure.hash AS structure_hash,
            job.state AS job_state, ",
            joined!(candidate),
            ", label.*"
        )
    };
}
pub(super) use labelled_columns;

/// What else belongs to a candidate and its label under the protocol `$1`.
macro_rules! labelled_joins {
    () => {
        " CROSS JOIN structure ON structure.number = candidate.structure
        CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
        LEFT JOIN job ON job.structure = candidate.structure AND job.protocol = $1"
    };
}
pub(super) use labelled_joins;

/// Labelled candidates that were not dropped, in decision order. `columns`: further ones, with what joins them.
macro_rules! labelled_candidates {
    ($which:expr, $limit:literal) => {
        labelled_candidates!("", "", $which, $limit)
    };
    ($columns:expr, $joins:literal, $which:expr, $limit:literal) => {
        concat!(
            "SELECT ",
            labelled_columns!(),
            $columns,
            " FROM candidate
            CROSS JOIN label ON label.structure = candidate.structure AND label.protocol = $1 AND status = 'label'",
            labelled_joins!(),
            $joins,
            " WHERE candidate.decision ",
            $which,
            " AND coalesce(job.state, '') <> 'dropped' ORDER BY candidate.decision",
            $limit
        )
    };
}
pub(super) use labelled_candidates;

pub(crate) const AFTER: &str = labelled_candidates!("> $2", " LIMIT $3");
pub(crate) const OF_DECISIONS: &str = labelled_candidates!(concat!("IN ", decision_list!()), "");

/// The index gives the failed jobs: each page reads all of them, but only its own candidates.
pub(crate) const FAILED: &str = concat!(
    "SELECT candidate.decision AS decision, original_checksum, original_grades, ",
    joined!(candidate),
    " FROM (SELECT candidate.decision AS found
        FROM job CROSS JOIN candidate ON candidate.structure = job.structure
        WHERE job.state = 'failed' AND job.protocol = $1 AND candidate.decision > $2
        AND NOT EXISTS (SELECT 1 FROM label WHERE label.structure = job.structure
            AND label.protocol = job.protocol AND status = 'excluded')
        ORDER BY candidate.decision LIMIT $3) AS page
    CROSS JOIN candidate ON candidate.decision = page.found
    CROSS JOIN candidate_data ON candidate_data.decision = page.found
    ORDER BY candidate.decision"
);

impl Store {
    /// At most `limit` labelled candidates and frames of control walks after decision `after` (0: from the first), in decision
    /// order. Leaves out structures dropped by hand. An empty page is the end.
    pub async fn labelled_after(
        &self,
        protocol: ContentHash,
        after: i64,
        limit: u32,
    ) -> Result<Vec<LabelledCandidate>> {
        let mut transaction = self.database.begin_read().await?;
        let number = protocol_id(&mut transaction, protocol).await?;
        let page = query(AFTER).bind(number).bind(after).bind(limit);
        let page = page.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(page)
    }

    /// The same, those of these decisions.
    pub async fn labelled_of_decisions(
        &self,
        protocol: ContentHash,
        decisions: &[i64],
    ) -> Result<Vec<LabelledCandidate>> {
        let mut transaction = self.database.begin_read().await?;
        let number = protocol_id(&mut transaction, protocol).await?;
        let mut found = Vec::new();
        for list in lists(decisions) {
            let page = query(OF_DECISIONS).bind(number).bind_all(list);
            found.extend(page.fetch_all::<LabelledCandidate>(&mut transaction).await?);
        }
        transaction.commit().await?;
        Ok(found)
    }

    /// At most `limit` candidates whose label job failed under this protocol, after decision `after` (0: from the first). An empty
    /// page is the end.
    pub async fn failed_after(
        &self,
        protocol: ContentHash,
        after: i64,
        limit: u32,
    ) -> Result<Vec<FailedCandidate>> {
        let mut transaction = self.database.begin_read().await?;
        let number = protocol_id(&mut transaction, protocol).await?;
        let page = query(FAILED).bind(number).bind(after).bind(limit);
        let page = page.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(page)
    }
}

impl FromRow for LabelledCandidate {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        ORIGINAL_GRADES.verify(row)?;
        let id: String = row.get("candidate__id")?;
        let block = block(row, &id)?;
        let view = block.view();
        let (structure, content) = (view.structure(), view.id().content);
        if row.bytes("structure_hash")? != Some(&content.0[..]) {
            return Err(StoreError::damaged(format!("candidate {id}"), "its structure is a different one"));
        }
        Ok(Self {
            decision: row.get("decision")?,
            seed_structure: row.get("candidate__seed_structure")?,
            gamma: row.get("candidate__original_gamma")?,
            relative_volume: row.get("candidate__relative_volume")?,
            structure,
            block,
            original: grades(row.bytes("original_grades")?)?,
            label: LabelRow::from_row(row)?.into_record()?.label,
            job: row.text("job_state")?.and_then(JobState::named),
        })
    }
}

impl FromRow for FailedCandidate {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        ORIGINAL_GRADES.verify(row)?;
        Ok(Self {
            decision: row.get("decision")?,
            candidate: row.get("candidate__id")?,
            walk: row.get("candidate__walk")?,
            step: row.get("candidate__step")?,
            content: decode_hash(&row.get::<Vec<u8>>("candidate__content")?)?,
            origin: origin(&row.get::<String>("candidate__origin")?)?,
            gamma: row.get("candidate__original_gamma")?,
            relative_volume: row.get("candidate__relative_volume")?,
            original: grades(row.bytes("original_grades")?)?,
        })
    }
}
