//! The newest decisions, for monitoring.

use super::restore::origin;
use crate::Store;
use crate::checksum::{CANDIDATE, DECISION, Names, joined};
use crate::database::{FromRow, SqlRow, query};
use crate::error::{Result, StoreError};
use crate::recent::{DecidedCandidate, RecentDecision};

/// Uses the primary key of the decision log. The details of decisions on candidates are read only to verify their
/// checksums.
pub(crate) const NEWEST: &str = concat!(
    "SELECT ",
    joined!(decision),
    ", ",
    joined!(candidate),
    ", coalesce(name, '') AS seed_name
    FROM (SELECT sequence AS place FROM decision WHERE sequence > $1 ORDER BY sequence DESC LIMIT $2) AS page
    CROSS JOIN decision ON sequence = place
    LEFT JOIN candidate ON candidate.decision = place
    LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure
    ORDER BY place DESC"
);

impl Store {
    /// At most `limit` decisions after number `after`, newest first.
    pub async fn newest_decisions(&self, after: i64, limit: u32) -> Result<Vec<RecentDecision>> {
        query(NEWEST).bind(after).bind(limit).fetch_all(&self.database).await
    }
}

impl FromRow for RecentDecision {
    fn from_row(row: &SqlRow) -> Result<Self> {
        DECISION.verify(row, Names::Joined)?;
        let candidate = candidate(row)?;
        let detail = match candidate {
            Some(_) => serde_json::Value::Null,
            None => serde_json::from_str(&row.get::<String>("decision__detail")?)
                .map_err(|error| StoreError::damaged("the decision log", error))?,
        };
        Ok(Self {
            sequence: row.get("decision__sequence")?,
            kind: row.get("decision__kind")?,
            walk: row.get("decision__walk")?,
            mixture_version: row.get("decision__mixture_version")?,
            detail,
            candidate,
        })
    }
}

fn candidate(row: &SqlRow) -> Result<Option<DecidedCandidate>> {
    let Some(candidate) = row.get("candidate__id")? else { return Ok(None) };
    CANDIDATE.verify(row, Names::Joined)?;
    Ok(Some(DecidedCandidate {
        candidate,
        origin: origin(&row.get::<String>("candidate__origin")?)?,
        reason: row.get("candidate__reason")?,
        step: row.get("candidate__step")?,
        seed_structure: row.get("seed_name")?,
        atoms: row.get("candidate__atoms")?,
        formula: row.get("candidate__formula")?,
        temperature: row.get("candidate__temperature")?,
        relative_volume: row.get("candidate__relative_volume")?,
        selector_gamma: row.get("candidate__selector_gamma")?,
        original_gamma: row.get("candidate__original_gamma")?,
        original_gamma_nbr: row.get("candidate__original_gamma_nbr")?,
    }))
}
