//! Labels in the order in which they came.

use wire::ContentHash;

use super::export;
use crate::Store;
use crate::checksum::joined;
use crate::database::{SqlRow, query};
use crate::error::{Result, StoreError};
use crate::export::LabelArrival;

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
        let unknown = || StoreError::UnknownProtocol(protocol.to_string());
        let name = query("SELECT name FROM protocol WHERE hash = $1").bind(protocol.0.to_vec());
        let name: Option<String> = name.fetch_optional(&self.database).await?;
        let name = name.ok_or_else(unknown)?;
        let number = query("SELECT number FROM protocol WHERE hash = $1").bind(protocol.0.to_vec());
        let number: i64 = number.fetch_one(&self.database).await?;
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
}
