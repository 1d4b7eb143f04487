//! The state from which a selector continues, and complete candidates.

use wire::messages::{DeclineReason, WalkProgress};
use wire::{CandidateBlock, ContentHash, Origin, WalkConditions, WalkFrame, WalkId};

use super::{assignments, trajectory, walk_conditions};
use crate::Store;
use crate::checksum::{
    CANDIDATE, CHECKPOINT, COMPONENT, DECISION, LONG_COLUMNS, Names, STRUCTURE, VALUE, WALK, joined,
};
use crate::database::{FromRow, SqlRow, Target, from_columns, query};
use crate::encoding::decode_hash;
use crate::error::{Result, StoreError};
use crate::numbers::decode_numbers;
use crate::records::{
    AssignmentRecord, AtomGrades, ComponentRecord, Fate, NewestMixture, StoredCandidate, WalkRecord,
};

macro_rules! candidates {
    ($rest:literal) => {
        concat!(
            "SELECT candidate.*, block, features, selector_grades, original_grades
            FROM candidate CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision ",
            $rest
        )
    };
}

const CANDIDATES: &str = candidates!(
    "WHERE candidate.decision > $1 AND (origin = 'biased' OR $2 = 1) ORDER BY candidate.decision LIMIT $3"
);
/// Number of rows without their long columns read at a time.
const PAGE: u32 = 1000;

const ACCEPTED: &str =
    "SELECT * FROM candidate WHERE decision > $1 AND origin = 'biased' AND fate = 'accepted'
    ORDER BY decision LIMIT $2";

const IMPORTED: &str = concat!(
    "SELECT import.number AS place, ",
    joined!(structure),
    " FROM import CROSS JOIN structure ON structure.number = import.structure
    WHERE import.number > $1 ORDER BY import.number LIMIT $2"
);

const CANDIDATE_OF_NAME: &str = candidates!("WHERE id = $1");

struct WalkRow {
    walk: u32,
    origin: String,
    partner: Option<u32>,
    seed_structure: u32,
    state: String,
    reason: String,
    assignments: u64,
    accepted: u32,
    step: u64,
    segment: u32,
    tau: Option<f64>,
    temperature: Option<f64>,
    relative_volume: Option<f64>,
    gamma_max: Option<f64>,
    rejected: u64,
    rollbacks: u32,
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
    assignments,
    accepted,
    step,
    segment,
    tau,
    temperature,
    relative_volume,
    gamma_max,
    rejected,
    rollbacks,
    selector_state,
    checkpoint
});

impl Store {
    /// Every walk, in order.
    pub async fn load_walks(&self) -> Result<Vec<WalkRecord>> {
        let mut transaction = self.database.begin_read().await?;
        let mut conditions = walk_conditions::read(&mut transaction).await?;
        let walks = query("SELECT * FROM walk ORDER BY walk");
        let mut walks: Vec<WalkRecord> = walks.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        for walk in &mut walks {
            walk.conditions = conditions.remove(&walk.walk).unwrap_or_default();
        }
        Ok(walks)
    }

    /// One walk, `None` if there is none.
    pub async fn load_walk(&self, walk: WalkId) -> Result<Option<WalkRecord>> {
        let mut transaction = self.database.begin_read().await?;
        let found = query("SELECT * FROM walk WHERE walk = $1").bind(walk.0);
        let mut found: Option<WalkRecord> = found.fetch_optional(&mut transaction).await?;
        if let Some(found) = &mut found {
            let mut conditions = walk_conditions::read(&mut transaction).await?;
            found.conditions = conditions.remove(&walk).unwrap_or_default();
        }
        transaction.commit().await?;
        Ok(found)
    }

    /// The assignments of a walk, in order. Empty for walks that began under earlier versions.
    pub async fn assignments(&self, walk: WalkId) -> Result<Vec<AssignmentRecord>> {
        let mut transaction = self.database.begin_read().await?;
        let mut found = Vec::new();
        if transaction.has_table(assignments::TABLE).await? {
            let rows = query("SELECT * FROM assignment WHERE walk = $1 ORDER BY part").bind(walk.0);
            found = rows.fetch_all(&mut transaction).await?;
        }
        transaction.commit().await?;
        Ok(found)
    }

    /// The frames of a part of a walk, see [`AssignmentRecord::part`]. Empty without a trajectory.
    pub async fn trajectory_part(&self, walk: WalkId, part: u64) -> Result<Vec<WalkFrame>> {
        let mut transaction = self.database.begin_read().await?;
        let frames = trajectory::read(&mut transaction, walk, part).await?;
        transaction.commit().await?;
        Ok(frames)
    }

    /// Every component that has changed since the mixture was last restarted, by element and slot.
    pub async fn load_components(&self) -> Result<Vec<ComponentRecord>> {
        components(&self.database).await
    }

    /// The selector's values, by name.
    pub async fn values(&self) -> Result<Vec<(String, String)>> {
        let rows = query("SELECT * FROM value ORDER BY name").rows(&self.database).await?;
        let value = |row: &SqlRow| {
            VALUE.verify(row, Names::Plain)?;
            Ok((row.get("name")?, row.get("value")?))
        };
        rows.iter().map(value).collect()
    }

    /// Hashes of structures that a new candidate must not repeat: accepted candidates of biased walks in decision
    /// order, then imported structures.
    pub async fn known_hashes(&self) -> Result<Vec<ContentHash>> {
        let (mut hashes, mut after) = (Vec::new(), 0);
        loop {
            let page = query(ACCEPTED).bind(after).bind(PAGE).rows(&self.database).await?;
            let Some(last) = page.last() else { break };
            after = last.get("decision")?;
            for row in &page {
                CANDIDATE.verify(row, Names::Plain)?;
                hashes.push(decode_hash(&row.get::<Vec<u8>>("content")?)?);
            }
        }
        hashes.extend(self.imported_hashes().await?);
        Ok(hashes)
    }

    /// Hashes of imported structures, in import order.
    pub async fn imported_hashes(&self) -> Result<Vec<ContentHash>> {
        let (mut hashes, mut after) = (Vec::new(), 0);
        loop {
            let page = query(IMPORTED).bind(after).bind(PAGE).rows(&self.database).await?;
            let Some(last) = page.last() else { return Ok(hashes) };
            after = last.get("place")?;
            for row in &page {
                STRUCTURE.verify(row, Names::Joined)?;
                hashes.push(decode_hash(&row.get::<Vec<u8>>("structure__hash")?)?);
            }
        }
    }

    /// The last decision and the mixture after it, read as a snapshot.
    pub async fn newest_mixture(&self) -> Result<NewestMixture> {
        let mut transaction = self.database.begin_read().await?;
        let last =
            query("SELECT * FROM decision ORDER BY sequence DESC LIMIT 1").rows(&mut transaction).await?;
        let (decision, version) = match last.first() {
            None => (0, 0),
            Some(row) => {
                DECISION.verify(row, Names::Plain)?;
                (row.get("sequence")?, row.get("mixture_version")?)
            }
        };
        let components = components(&mut transaction).await?;
        transaction.commit().await?;
        Ok(NewestMixture { decision, version, components })
    }

    /// The first decision with this version of the mixture after it, `None` if there is none.
    pub async fn first_decision_of(&self, version: u64) -> Result<Option<i64>> {
        let sql = "SELECT * FROM decision WHERE mixture_version = $1 ORDER BY sequence LIMIT 1";
        let rows = query(sql).bind(version as i64).rows(&self.database).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        DECISION.verify(row, Names::Plain)?;
        Ok(Some(row.get("sequence")?))
    }

    /// At most `limit` complete candidates after decision `after`, in decision order; those of control walks only
    /// if `control` is set.
    pub async fn candidates(&self, after: i64, control: bool, limit: u32) -> Result<Vec<StoredCandidate>> {
        let query = query(CANDIDATES).bind(after).bind(control).bind(limit);
        query.fetch_all(&self.database).await
    }

    /// The candidate with that name, `None` if there is none.
    pub async fn candidate(&self, id: &str) -> Result<Option<StoredCandidate>> {
        query(CANDIDATE_OF_NAME).bind(id).fetch_optional(&self.database).await
    }
}

async fn components(from: impl Into<Target<'_>>) -> Result<Vec<ComponentRecord>> {
    query("SELECT * FROM component ORDER BY element, slot").fetch_all(from).await
}

impl FromRow for ComponentRecord {
    fn from_row(row: &SqlRow) -> Result<Self> {
        COMPONENT.verify(row, Names::Plain)?;
        Ok(Self { element: row.get("element")?, slot: row.get("slot")?, bytes: row.get("bytes")? })
    }
}

impl FromRow for WalkRecord {
    fn from_row(row: &SqlRow) -> Result<Self> {
        WALK.verify(row, Names::Plain)?;
        CHECKPOINT.verify(row)?;
        WalkRow::from_row(row)?.into_record()
    }
}

impl WalkRow {
    fn into_record(self) -> Result<WalkRecord> {
        // Columns hold NULL for numbers that are not finite.
        let number = |column: Option<f64>| column.unwrap_or(f64::NAN);
        Ok(WalkRecord {
            walk: WalkId(self.walk),
            origin: origin(&self.origin)?,
            partner: self.partner.map(WalkId),
            seed_structure: self.seed_structure,
            // Another table has them.
            conditions: WalkConditions::default(),
            state: self.state,
            reason: self.reason,
            assignments: self.assignments,
            accepted: self.accepted,
            progress: WalkProgress {
                step: self.step,
                segment: self.segment,
                tau: number(self.tau),
                temperature: number(self.temperature),
                relative_volume: number(self.relative_volume),
                gamma_max: number(self.gamma_max),
                rejected: self.rejected,
                rollbacks: self.rollbacks,
                last_rollback: None,
                reference_step: None,
                reference_volume: None,
            },
            selector_state: self.selector_state,
            checkpoint: self.checkpoint,
        })
    }
}

impl FromRow for StoredCandidate {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Plain)?;
        LONG_COLUMNS.iter().try_for_each(|column| column.verify(row))?;
        let (fate, reason): (String, Option<String>) = (row.get("fate")?, row.get("reason")?);
        let fate = match (fate.as_str(), reason.as_deref()) {
            ("accepted", None) => Some(Fate::Accepted),
            (_, reason) => {
                DeclineReason::ALL.into_iter().find(|d| Some(d.name()) == reason).map(Fate::Declined)
            }
        };
        let [features, selector, original]: [Option<Vec<u8>>; 3] =
            [row.get("features")?, row.get("selector_grades")?, row.get("original_grades")?];
        Ok(Self {
            decision: row.get("decision")?,
            block: block(row, &row.get::<String>("id")?)?,
            fate: fate.ok_or_else(|| StoreError::damaged("a candidate", "unknown fate"))?,
            seed_structure: row.get("seed_structure")?,
            selector: grades(selector.as_deref())?,
            original: grades(original.as_deref())?,
            features: features.map(|bytes| decode_numbers(&bytes)).transpose()?,
        })
    }
}

/// The block of a row. It must belong to the candidate of this name.
pub(super) fn block(row: &SqlRow, id: &str) -> Result<CandidateBlock> {
    let missing = || StoreError::damaged(format!("candidate {id}"), "its block is missing");
    let block = CandidateBlock::from_bytes(row.bytes("block")?.ok_or_else(missing)?)?;
    let found = block.view().id().to_string();
    match found == id {
        true => Ok(block),
        false => Err(StoreError::damaged(format!("candidate {id}"), format!("its block is that of {found}"))),
    }
}

pub(super) fn origin(name: &str) -> Result<Origin> {
    let known = [Origin::Biased, Origin::Control].into_iter().find(|origin| origin.name() == name);
    known.ok_or_else(|| StoreError::damaged("an origin", name))
}

/// γ and γ_nbr, one after the other in the column.
pub(super) fn grades(column: Option<&[u8]>) -> Result<AtomGrades> {
    let Some(bytes) = column else { return Ok(AtomGrades::default()) };
    let mut gamma = decode_numbers(bytes)?;
    let gamma_nbr = gamma.split_off(gamma.len() / 2);
    Ok(AtomGrades { gamma, gamma_nbr })
}
