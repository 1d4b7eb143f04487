//! Labels in the order in which they came.

use wire::ContentHash;

use super::export;
use crate::Store;
use crate::checksum::joined;
use crate::database::{SqlRow, query};
use crate::error::{Result, StoreError};
use crate::export::{ArrivalSum, LabelArrival};

pub(crate) const PAGE: &str = concat!(
    "SELECT candidate.decision AS decision, label.number AS label_number, original_checksum, block, original_grades,
    seed_structure.seed AS seed, ",
    joined!(candidate),
    ", ",
    joined!(decision),
    ", ",
    joined!(seed_structure),
    ", ",
    joined!(structure),
    ", label.*
    FROM label
    CROSS JOIN candidate ON candidate.structure = label.structure
    CROSS JOIN structure ON structure.number = candidate.structure
    CROSS JOIN decision ON decision.sequence = candidate.decision
    CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
    LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure
    WHERE label.number >= $2 AND (label.number > $2 OR candidate.decision > $3)
    AND label.protocol = $1 AND status = 'label'
    AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = label.structure AND job.protocol = $1
                    AND state = 'dropped')
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
        let (number, name) = self.protocol_of_arrivals(protocol).await?;
        let (label, decision) = after.unwrap_or((0, 0));
        let page = query(PAGE).bind(number).bind(label).bind(decision).bind(limit);
        let rows = page.rows(&self.database).await?;
        let arrival = |row: &SqlRow| {
            Ok(LabelArrival {
                number: row.get("label_number")?,
                decision: row.get("decision")?,
                row: export::candidate(row, &name, protocol)?,
            })
        };
        rows.iter().map(arrival).collect()
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
        let (number, _) = self.protocol_of_arrivals(protocol).await?;
        let Some((label, decision)) = until else { return Ok(ArrivalSum::default()) };
        let sum = query(SUM).bind(number).bind(label).bind(decision);
        let (rows, sum) = sum.fetch_one(&self.database).await?;
        Ok(ArrivalSum { rows, sum })
    }

    /// Number and name of a protocol.
    async fn protocol_of_arrivals(&self, protocol: ContentHash) -> Result<(i64, String)> {
        let found = query("SELECT number, name FROM protocol WHERE hash = $1").bind(protocol.0.to_vec());
        let found: Option<(i64, String)> = found.fetch_optional(&self.database).await?;
        found.ok_or_else(|| StoreError::UnknownProtocol(protocol.to_string()))
    }
}
