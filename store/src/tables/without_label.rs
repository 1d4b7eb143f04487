//! Pages of accepted candidates that an export leaves out because they have no label.

use wire::ContentHash;

use super::protocols::protocol_id;
use crate::Store;
use crate::database::query;
use crate::error::Result;
use crate::records::StoredCandidate;

/// The opposite of the conditions of an export. An accepted candidate has no reason; with that, the index of fates has the
/// order of the decisions.
pub(crate) const ACCEPTED: &str = "SELECT candidate.*, block, features, selector_grades, original_grades
    FROM candidate CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
    WHERE candidate.decision > $1 AND origin = 'biased' AND fate = 'accepted' AND candidate.reason IS NULL
    AND (NOT EXISTS (SELECT 1 FROM label WHERE label.structure = candidate.structure
                     AND label.protocol = $2 AND status = 'label')
         OR EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure
                    AND job.protocol = $2 AND state = 'dropped'))
    ORDER BY candidate.decision LIMIT $3";

impl Store {
    /// At most `limit` accepted candidates of biased walks after decision `after`, in decision order, that
    /// [`Self::labelled`] does not find under `protocol`: their label is pending, failed, excluded or dropped. `None`: all
    /// accepted candidates. An empty page is the end.
    ///
    /// # Errors
    /// An unknown protocol, a damaged row.
    pub async fn candidates_without_label(
        &self,
        protocol: Option<ContentHash>,
        after: i64,
        limit: u32,
    ) -> Result<Vec<StoredCandidate>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = match protocol {
            Some(hash) => Some(protocol_id(&mut transaction, hash).await?),
            None => None,
        };
        let page = query(ACCEPTED).bind(after).bind(protocol).bind(limit);
        let page = page.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(page)
    }
}
