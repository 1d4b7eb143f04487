//! Labels in the order in which they came.

use wire::ContentHash;

use super::labelled::{labelled_columns, labelled_joins};
use crate::Store;
use crate::checksum::joined;
use crate::database::{FromRow, SqlRow, query};
use crate::error::{Result, StoreError};
use crate::labelled::{ArrivalSum, LabelArrival, LabelledCandidate};

pub(crate) const PAGE: &str = concat!(
    "SELECT label.number AS label_number, ",
    labelled_columns!(),
    " FROM label CROSS JOIN candidate ON candidate.structure = label.structure",
    labelled_joins!(),
    " WHERE label.number >= $2 AND (label.number > $2 OR candidate.decision > $3)
    AND label.protocol = $1 AND status = 'label' AND coalesce(job.state, '') <> 'dropped'
    ORDER BY label.number, candidate.decision LIMIT $4"
);

/// [`ArrivalSum`] of the rows of [`PAGE`] up to a label and a decision. The sign keeps SQLite from reading whole rows of labels.
pub(crate) const SUM: &str = "SELECT count(*) AS arrivals,
        CAST(coalesce(sum(x * x % 2147483647 * x % 2147483647), 0) AS BIGINT) AS arrival_sum
    FROM (SELECT (label.number * 48271 + candidate.decision * 69621) % 2147483647 AS x
        FROM label
        CROSS JOIN candidate ON candidate.structure = label.structure
        WHERE +label.number <= $2 AND (label.number < $2 OR candidate.decision <= $3)
        AND label.protocol = $1 AND status = 'label'
        AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = label.structure AND job.protocol = $1
                        AND state = 'dropped')) AS arrived";

impl Store {
    /// At most `limit` labelled candidates after the label and the decision of `after` (`None`: from the first), in the order in
    /// which their labels came. Leaves out what [`Store::labelled`] does, and imported structures. An empty page is the end.
    ///
    /// # Errors
    /// [`StoreError::UnknownProtocol`].
    pub async fn label_arrivals(
        &self,
        protocol: ContentHash,
        after: Option<(i64, i64)>,
        limit: u32,
    ) -> Result<Vec<LabelArrival>> {
        let number = self.protocol_number(protocol).await?;
        let (label, decision) = after.unwrap_or((0, 0));
        query(PAGE).bind(number).bind(label).bind(decision).bind(limit).fetch_all(&self.database).await
    }

    /// The sum over all labelled candidates up to the label and the decision of `until` (`None`: over none). A reader that has
    /// added what it read gets another sum if any of it has changed: a label was superseded or excluded, a job dropped, or another
    /// walk has found a structure that has a label already. Reads no structures and no labels.
    ///
    /// # Errors
    /// [`StoreError::UnknownProtocol`].
    pub async fn label_arrivals_until(
        &self,
        protocol: ContentHash,
        until: Option<(i64, i64)>,
    ) -> Result<ArrivalSum> {
        let number = self.protocol_number(protocol).await?;
        let Some((label, decision)) = until else { return Ok(ArrivalSum::default()) };
        let sum = query(SUM).bind(number).bind(label).bind(decision);
        let (rows, sum) = sum.fetch_one(&self.database).await?;
        Ok(ArrivalSum { rows, sum })
    }

    async fn protocol_number(&self, protocol: ContentHash) -> Result<i64> {
        let found = query("SELECT number FROM protocol WHERE hash = $1").bind(protocol.0.to_vec());
        let found = found.fetch_optional(&self.database).await?;
        found.ok_or_else(|| StoreError::UnknownProtocol(protocol.to_string()))
    }
}

impl FromRow for LabelArrival {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self { number: row.get("label_number")?, candidate: LabelledCandidate::from_row(row)? })
    }
}
