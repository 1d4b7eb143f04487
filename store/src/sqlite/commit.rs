//! Accept is one transaction: what the selector decided is written as a whole or not at all.

use std::collections::HashMap;
use std::ops::Range;

use atoms::Structure;
use wire::{CandidateView, ContentHash};

use super::{Store, Transaction, protocols};
use crate::encoding::{encode_structure, integer};
use crate::error::{Result, StoreError};
use crate::numbers::encode_numbers;
use crate::records::{AtomGrades, CandidateRecord, Commit, ComponentRecord, Decision, Fate, WalkRecord};

impl Store {
    /// Writes everything that was decided in one transaction, on the disk when this returns. Decisions get
    /// consecutive numbers, which are returned. An accepted candidate gets a label job under the protocol in force,
    /// if there is one.
    ///
    /// # Errors
    /// [`StoreError::DuplicateCandidate`] and [`StoreError::Inconsistent`] are errors of the caller. Nothing is
    /// written after any error.
    pub async fn commit(&self, commit: &Commit) -> Result<Range<i64>> {
        // Everything is copied before anyone has to wait for the transaction.
        let prepared = commit.candidates.iter().map(Prepared::new).collect::<Result<Vec<_>>>()?;
        let mut transaction = self.begin().await?;
        let first = next_sequence(&mut transaction).await?;
        let mut sequence = first;
        let mut decided = HashMap::new();
        for decision in &commit.decisions {
            insert_decision(&mut transaction, sequence, decision).await?;
            let candidate = decision.candidate.map(|id| id.to_string());
            if let Some(twice) = candidate.filter(|id| decided.insert(id.clone(), sequence).is_some()) {
                return Err(StoreError::Inconsistent(format!("two decisions about candidate {twice}")));
            }
            sequence += 1;
        }
        let protocol = protocols::in_force(&mut transaction).await?;
        for candidate in prepared {
            let decision = decided.remove(&candidate.id).ok_or_else(|| {
                StoreError::Inconsistent(format!("candidate {} without a decision", candidate.id))
            })?;
            insert_candidate(&mut transaction, decision, candidate, protocol).await?;
        }
        if let Some(id) = decided.into_keys().min() {
            return Err(StoreError::Inconsistent(format!(
                "a decision about candidate {id}, which is missing"
            )));
        }
        if commit.restart_mixture {
            sqlx::query("DELETE FROM component").execute(&mut *transaction).await?;
        }
        for component in &commit.components {
            upsert_component(&mut transaction, component).await?;
        }
        for walk in &commit.walks {
            upsert_walk(&mut transaction, walk).await?;
        }
        for (name, value) in &commit.values {
            let sql = "INSERT INTO value (name, value) VALUES (?, ?)
                       ON CONFLICT (name) DO UPDATE SET value = excluded.value";
            sqlx::query(sql).bind(name).bind(value).execute(&mut *transaction).await?;
        }
        transaction.commit().await?;
        Ok(first..sequence)
    }
}

/// A candidate in the form in which it is written.
struct Prepared<'a> {
    record: &'a CandidateRecord,
    view: CandidateView<'a>,
    id: String,
    structure: Structure,
    block: Vec<u8>,
    features: Option<Vec<u8>>,
    selector_grades: Option<Vec<u8>>,
    original_grades: Option<Vec<u8>>,
}

impl<'a> Prepared<'a> {
    fn new(record: &'a CandidateRecord) -> Result<Self> {
        let view = record.block.view();
        let id = view.id().to_string();
        let grades = |grades: &AtomGrades| {
            let n = view.numbers.len();
            match (grades.gamma.len(), grades.gamma_nbr.len()) {
                (0, 0) => Ok(None),
                (a, b) if (a, b) == (n, n) => {
                    Ok(Some(encode_numbers(&[grades.gamma.as_slice(), &grades.gamma_nbr].concat())))
                }
                (a, b) => Err(StoreError::Inconsistent(format!(
                    "{a} and {b} grades for the {n} atoms of candidate {id}"
                ))),
            }
        };
        Ok(Self {
            record,
            structure: view.structure(),
            block: record.block.without_features().as_bytes().to_vec(),
            features: record.keep_features.then(|| encode_numbers(view.features)),
            selector_grades: grades(&record.selector)?,
            original_grades: grades(&record.original)?,
            id,
            view,
        })
    }
}

async fn next_sequence(transaction: &mut Transaction) -> Result<i64> {
    let sql = "SELECT coalesce(max(sequence), 0) + 1 FROM decision";
    Ok(sqlx::query_scalar(sql).fetch_one(&mut **transaction).await?)
}

async fn insert_decision(transaction: &mut Transaction, sequence: i64, decision: &Decision) -> Result<()> {
    let sql = "INSERT INTO decision (sequence, round, kind, walk, candidate, mixture_version, detail)
               VALUES (?, ?, ?, ?, ?, ?, ?)";
    sqlx::query(sql)
        .bind(sequence)
        .bind(integer("round", decision.round)?)
        .bind(decision.kind)
        .bind(decision.walk.map(|walk| walk.0))
        .bind(decision.candidate.map(|id| id.to_string()))
        .bind(integer("mixture version", decision.mixture_version)?)
        .bind(decision.detail.to_string())
        .execute(&mut **transaction)
        .await?;
    Ok(())
}

async fn insert_candidate(
    transaction: &mut Transaction,
    decision: i64,
    candidate: Prepared<'_>,
    protocol: Option<i64>,
) -> Result<()> {
    let Prepared { record, view, id, structure: atoms, .. } = candidate;
    let content = view.id().content;
    let (fate, reason) = match record.fate {
        Fate::Accepted => ("accepted", None),
        Fate::Declined(reason) => ("declined", Some(reason.name())),
    };
    let structure = match record.fate {
        Fate::Accepted => Some(structure_number(transaction, &atoms, content).await?),
        Fate::Declined(_) => None,
    };
    let sql = "INSERT INTO candidate VALUES
               (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
               ON CONFLICT (id) DO NOTHING";
    let mut query = sqlx::query(sql)
        .bind(decision)
        .bind(&id)
        .bind(&content.0[..])
        .bind(structure)
        .bind(view.id().walk.0)
        .bind(view.id().segment)
        .bind(integer("step", view.id().step)?)
        .bind(record.seed_structure)
        .bind(view.origin().name())
        .bind(fate)
        .bind(reason)
        .bind(integer("mixture version", view.mixture_version())?)
        .bind(count(atoms.len())?)
        .bind(atoms.formula())
        .bind(view.temperature())
        .bind(view.relative_volume())
        .bind(view.energy());
    let (selector, original) = (&record.selector, &record.original);
    for (gamma, gamma_nbr) in [
        (view.gamma, view.gamma_nbr),
        (&selector.gamma, &selector.gamma_nbr),
        (&original.gamma, &original.gamma_nbr),
    ] {
        let above = (!gamma.is_empty()).then(|| gamma.iter().filter(|g| **g > 1.0).count());
        query = query
            .bind(gamma.iter().copied().reduce(f64::max))
            .bind(gamma_nbr.iter().copied().reduce(f64::max))
            .bind(above.map(count).transpose()?);
    }
    if query.execute(&mut **transaction).await?.rows_affected() == 0 {
        return Err(StoreError::DuplicateCandidate(id));
    }
    let sql = "INSERT INTO candidate_data (decision, block, features, selector_grades, original_grades)
               VALUES (?, ?, ?, ?, ?)";
    sqlx::query(sql)
        .bind(decision)
        .bind(candidate.block)
        .bind(candidate.features)
        .bind(candidate.selector_grades)
        .bind(candidate.original_grades)
        .execute(&mut **transaction)
        .await?;
    if let (Some(structure), Some(protocol)) = (structure, protocol) {
        enqueue(transaction, structure, protocol, decision, record.priority).await?;
    }
    Ok(())
}

/// Number of the structure's row, which is made if there is none.
pub(super) async fn structure_number(
    transaction: &mut Transaction,
    structure: &Structure,
    hash: ContentHash,
) -> Result<i64> {
    let sql = "INSERT INTO structure (hash, atoms, formula, data) VALUES (?, ?, ?, ?)
               ON CONFLICT (hash) DO NOTHING";
    sqlx::query(sql)
        .bind(&hash.0[..])
        .bind(count(structure.len())?)
        .bind(structure.formula())
        .bind(encode_structure(structure))
        .execute(&mut **transaction)
        .await?;
    let number = sqlx::query_scalar("SELECT number FROM structure WHERE hash = ?").bind(&hash.0[..]);
    Ok(number.fetch_one(&mut **transaction).await?)
}

/// A job for the structure, unless it has one; done already if the label is there.
pub(super) async fn enqueue(
    transaction: &mut Transaction,
    structure: i64,
    protocol: i64,
    decision: i64,
    priority: i32,
) -> Result<()> {
    let sql = "INSERT INTO job (structure, protocol, decision, priority, state)
               VALUES (?1, ?2, ?3, ?4, CASE WHEN EXISTS (
                   SELECT 1 FROM label WHERE structure = ?1 AND protocol = ?2 AND standing = 'label'
               ) THEN 'labelled' ELSE 'queued' END)
               ON CONFLICT (structure, protocol) DO NOTHING";
    let query = sqlx::query(sql).bind(structure).bind(protocol).bind(decision).bind(priority);
    query.execute(&mut **transaction).await?;
    Ok(())
}

async fn upsert_component(transaction: &mut Transaction, component: &ComponentRecord) -> Result<()> {
    let sql = "INSERT INTO component (element, slot, bytes) VALUES (?, ?, ?)
               ON CONFLICT (element, slot) DO UPDATE SET bytes = excluded.bytes";
    let query = sqlx::query(sql).bind(component.element).bind(component.slot).bind(&component.bytes);
    query.execute(&mut **transaction).await?;
    Ok(())
}

async fn upsert_walk(transaction: &mut Transaction, walk: &WalkRecord) -> Result<()> {
    let sql = "INSERT OR REPLACE INTO walk VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)";
    let WalkRecord { progress, .. } = walk;
    sqlx::query(sql)
        .bind(walk.walk.0)
        .bind(walk.origin.name())
        .bind(walk.partner.map(|partner| partner.0))
        .bind(walk.seed_structure)
        .bind(&walk.state)
        .bind(&walk.reason)
        .bind(integer("turn", walk.turn)?)
        .bind(walk.accepted)
        .bind(integer("step", progress.step)?)
        .bind(progress.segment)
        .bind(progress.tau)
        .bind(progress.temperature)
        .bind(progress.relative_volume)
        .bind(progress.gamma_max)
        .bind(integer("number of refusals", progress.refused)?)
        .bind(progress.returns)
        .bind(&walk.selector_state)
        .bind(walk.checkpoint.as_deref())
        .execute(&mut **transaction)
        .await?;
    Ok(())
}

fn count(number: usize) -> Result<i64> {
    integer("count", number as u64)
}
