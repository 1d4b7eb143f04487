//! What a selector needs to go on, and candidates as a whole.

use wire::messages::{Decline, Progress};
use wire::{CandidateBlock, ContentHash, Origin, WalkId};

use crate::Store;
use crate::database::{Target, from_columns, query};
use crate::encoding::decode_hash;
use crate::error::{Result, StoreError};
use crate::numbers::decode_numbers;
use crate::records::{AtomGrades, ComponentRecord, Fate, NewestMixture, StoredCandidate, WalkRecord};

const CANDIDATES: &str = "SELECT candidate.decision, seed_structure, fate, reason, block, features,
        selector_grades, original_grades
    FROM candidate CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
    WHERE candidate.decision > $1 AND (origin = 'biased' OR $2 = 1) ORDER BY candidate.decision LIMIT $3";

struct WalkRow {
    walk: u32,
    origin: String,
    partner: Option<u32>,
    seed_structure: u32,
    state: String,
    reason: String,
    turn: u64,
    accepted: u32,
    step: u64,
    segment: u32,
    tau: Option<f64>,
    temperature: Option<f64>,
    relative_volume: Option<f64>,
    gamma_max: Option<f64>,
    refused: u64,
    returns: u32,
    selector_state: String,
    checkpoint: Option<Vec<u8>>,
}

from_columns!(WalkRow {
    walk,
    origin,
    partner,
    seed_structure,
    state,
    reason,
    turn,
    accepted,
    step,
    segment,
    tau,
    temperature,
    relative_volume,
    gamma_max,
    refused,
    returns,
    selector_state,
    checkpoint
});

struct CandidateRow {
    decision: i64,
    seed_structure: u32,
    fate: String,
    reason: Option<String>,
    block: Vec<u8>,
    features: Option<Vec<u8>>,
    selector_grades: Option<Vec<u8>>,
    original_grades: Option<Vec<u8>>,
}

from_columns!(CandidateRow {
    decision,
    seed_structure,
    fate,
    reason,
    block,
    features,
    selector_grades,
    original_grades
});

impl Store {
    /// Every walk, in order.
    pub async fn load_walks(&self) -> Result<Vec<WalkRecord>> {
        let rows: Vec<WalkRow> = query("SELECT * FROM walk ORDER BY walk").fetch_all(&self.database).await?;
        rows.into_iter().map(WalkRow::into_record).collect()
    }

    /// Every component that ever changed (since the mixture last began anew), by element and slot.
    pub async fn load_components(&self) -> Result<Vec<ComponentRecord>> {
        components(&self.database).await
    }

    /// The selector's values, by name.
    pub async fn values(&self) -> Result<Vec<(String, String)>> {
        query("SELECT name, value FROM value ORDER BY name").fetch_all(&self.database).await
    }

    /// Hashes of the structures that a new candidate must not repeat: accepted candidates of biased walks, in decision
    /// order, then imported structures.
    pub async fn known_hashes(&self) -> Result<Vec<ContentHash>> {
        let sql =
            "SELECT content FROM candidate WHERE origin = 'biased' AND fate = 'accepted' ORDER BY decision";
        let hashes: Vec<Vec<u8>> = query(sql).fetch_all(&self.database).await?;
        let mut hashes: Vec<_> = hashes.iter().map(|hash| decode_hash(hash)).collect::<Result<_>>()?;
        hashes.extend(self.imported_hashes().await?);
        Ok(hashes)
    }

    /// Hashes of imported structures, in the order in which they came.
    pub async fn imported_hashes(&self) -> Result<Vec<ContentHash>> {
        let sql = "SELECT hash FROM import JOIN structure ON structure.number = import.structure
                   ORDER BY import.number";
        let hashes: Vec<Vec<u8>> = query(sql).fetch_all(&self.database).await?;
        hashes.iter().map(|hash| decode_hash(hash)).collect()
    }

    /// How far the decisions have come, and the mixture at that instant.
    pub async fn newest_mixture(&self) -> Result<NewestMixture> {
        let mut transaction = self.database.begin_to_read().await?;
        let sql = "SELECT sequence, mixture_version FROM decision ORDER BY sequence DESC LIMIT 1";
        let last: Option<(i64, u64)> = query(sql).fetch_optional(&mut transaction).await?;
        let (decision, version) = last.unwrap_or_default();
        let components = components(&mut transaction).await?;
        transaction.commit().await?;
        Ok(NewestMixture { decision, version, components })
    }

    /// At most `limit` candidates behind decision number `after`, in decision order and whole; those of control walks only
    /// if `control` says so.
    pub async fn candidates(&self, after: i64, control: bool, limit: u32) -> Result<Vec<StoredCandidate>> {
        let query = query(CANDIDATES).bind(after).bind(control).bind(limit);
        let rows: Vec<CandidateRow> = query.fetch_all(&self.database).await?;
        rows.into_iter().map(CandidateRow::into_candidate).collect()
    }

    /// The candidate of that name, `None` if there is none.
    pub async fn candidate(&self, id: &str) -> Result<Option<StoredCandidate>> {
        let sql = "SELECT candidate.decision, seed_structure, fate, reason, block, features, selector_grades,
                          original_grades
                   FROM candidate JOIN candidate_data ON candidate_data.decision = candidate.decision
                   WHERE id = $1";
        let row: Option<CandidateRow> = query(sql).bind(id).fetch_optional(&self.database).await?;
        row.map(CandidateRow::into_candidate).transpose()
    }

    /// Names of all candidates in decision order, at most `limit` after decision number `after`.
    pub async fn candidate_ids(&self, after: i64, limit: u32) -> Result<Vec<(i64, String)>> {
        let sql = "SELECT decision, id FROM candidate WHERE decision > $1 ORDER BY decision LIMIT $2";
        query(sql).bind(after).bind(limit).fetch_all(&self.database).await
    }
}

async fn components(from: impl Into<Target<'_>>) -> Result<Vec<ComponentRecord>> {
    let sql = "SELECT element, slot, bytes FROM component ORDER BY element, slot";
    let rows: Vec<(u32, u32, Vec<u8>)> = query(sql).fetch_all(from).await?;
    Ok(rows.into_iter().map(|(element, slot, bytes)| ComponentRecord { element, slot, bytes }).collect())
}

impl WalkRow {
    fn into_record(self) -> Result<WalkRecord> {
        // What is not finite has no other form in a column.
        let number = |column: Option<f64>| column.unwrap_or(f64::NAN);
        Ok(WalkRecord {
            walk: WalkId(self.walk),
            origin: origin(&self.origin)?,
            partner: self.partner.map(WalkId),
            seed_structure: self.seed_structure,
            state: self.state,
            reason: self.reason,
            turn: self.turn,
            accepted: self.accepted,
            progress: Progress {
                step: self.step,
                segment: self.segment,
                tau: number(self.tau),
                temperature: number(self.temperature),
                relative_volume: number(self.relative_volume),
                gamma_max: number(self.gamma_max),
                refused: self.refused,
                returns: self.returns,
                last_return: None,
            },
            selector_state: self.selector_state,
            checkpoint: self.checkpoint,
        })
    }
}

impl CandidateRow {
    fn into_candidate(self) -> Result<StoredCandidate> {
        let fate = match (self.fate.as_str(), self.reason.as_deref()) {
            ("accepted", None) => Some(Fate::Accepted),
            (_, reason) => Decline::ALL.into_iter().find(|d| Some(d.name()) == reason).map(Fate::Declined),
        };
        Ok(StoredCandidate {
            decision: self.decision,
            block: CandidateBlock::from_bytes(&self.block)?,
            fate: fate.ok_or_else(|| StoreError::damaged("a candidate", "unknown fate"))?,
            seed_structure: self.seed_structure,
            selector: grades(self.selector_grades.as_deref())?,
            original: grades(self.original_grades.as_deref())?,
            features: self.features.map(|bytes| decode_numbers(&bytes)).transpose()?,
        })
    }
}

pub(super) fn origin(name: &str) -> Result<Origin> {
    let known = [Origin::Biased, Origin::Control].into_iter().find(|origin| origin.name() == name);
    known.ok_or_else(|| StoreError::damaged("an origin", name))
}

/// γ and γ_nbr, one behind the other in the column.
pub(super) fn grades(column: Option<&[u8]>) -> Result<AtomGrades> {
    let Some(bytes) = column else { return Ok(AtomGrades::default()) };
    let mut gamma = decode_numbers(bytes)?;
    let gamma_nbr = gamma.split_off(gamma.len() / 2);
    Ok(AtomGrades { gamma, gamma_nbr })
}
