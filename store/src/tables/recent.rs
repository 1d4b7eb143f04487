//! The newest decisions, for those who watch.

use super::restore::origin;
use crate::Store;
use crate::database::{FromRow, Row, query};
use crate::error::{Result, StoreError};
use crate::recent::{DecidedCandidate, RecentDecision};

/// Through the decision log's own order. The numbers behind decisions about candidates are long, and not looked at.
pub(crate) const NEWEST: &str = "SELECT sequence, kind, decision.walk AS of_walk, decision.mixture_version AS version,
        CASE WHEN candidate.decision IS NULL THEN detail END AS detail,
        id, origin, reason, step, coalesce(name, '') AS seed_structure, atoms, formula, temperature, relative_volume,
        selector_gamma, original_gamma, original_gamma_nbr
    FROM (SELECT sequence AS place FROM decision WHERE sequence > $1 ORDER BY sequence DESC LIMIT $2) AS page
    CROSS JOIN decision ON sequence = place
    LEFT JOIN candidate ON candidate.decision = place
    LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure
    ORDER BY place DESC";

impl Store {
    /// At most `limit` decisions with numbers above `after`: the newest, newest first.
    pub async fn newest_decisions(&self, after: i64, limit: u32) -> Result<Vec<RecentDecision>> {
        query(NEWEST).bind(after).bind(limit).fetch_all(&self.database).await
    }
}

impl FromRow for RecentDecision {
    fn from_row(row: &Row) -> Result<Self> {
        let detail: Option<String> = row.get("detail")?;
        let detail = detail.map(|detail| serde_json::from_str(&detail)).transpose();
        Ok(Self {
            sequence: row.get("sequence")?,
            kind: row.get("kind")?,
            walk: row.get("of_walk")?,
            mixture_version: row.get("version")?,
            detail: detail
                .map_err(|error| StoreError::damaged("the decision log", error))?
                .unwrap_or_default(),
            candidate: candidate(row)?,
        })
    }
}

fn candidate(row: &Row) -> Result<Option<DecidedCandidate>> {
    let Some(candidate) = row.get("id")? else { return Ok(None) };
    Ok(Some(DecidedCandidate {
        candidate,
        origin: origin(&row.get::<String>("origin")?)?,
        reason: row.get("reason")?,
        step: row.get("step")?,
        seed_structure: row.get("seed_structure")?,
        atoms: row.get("atoms")?,
        formula: row.get("formula")?,
        temperature: row.get("temperature")?,
        relative_volume: row.get("relative_volume")?,
        selector_gamma: row.get("selector_gamma")?,
        original_gamma: row.get("original_gamma")?,
        original_gamma_nbr: row.get("original_gamma_nbr")?,
    }))
}
