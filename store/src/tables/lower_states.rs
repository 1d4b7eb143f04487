//! Lower states of labelled structures: lists them, and makes them the labels by hand or when a result arrives.
//!
//! A lower state is a check or a superseded label by the same protocol as the label in force, with an energy that is
//! lower by more than the rule's difference. Results that were excluded are none, and neither are those of dropped
//! structures.

use serde_json::json;

use super::exclude::{self, NamedStructure};
use super::label_row::LabelRow;
use super::logs::insert_operation;
use super::protocols::set_campaign_value;
use super::structures;
use crate::Store;
use crate::database::{Transaction, from_columns, query};
use crate::error::{Result, StoreError};
use crate::jobs::{LabelRecord, LabelStatus};
use crate::lower_states::{
    LowerState, LowerStateChange, LowerStateRule, OnLowerState, StateResult, reason_of,
};

/// The campaign's value with the rule, JSON.
const RULE: &str = "lower_states";

/// The query for [`StatePair`]s; its end selects the structures.
macro_rules! pairs {
    ($columns:literal, $end:literal) => {
        concat!(
            "SELECT ",
            $columns,
            " FROM label AS other
            CROSS JOIN label AS own ON own.structure = other.structure AND own.protocol = other.protocol AND own.status = 'label'
            CROSS JOIN structure ON structure.number = own.structure
            WHERE other.status IN ('check', 'superseded') AND other.excluded IS NULL
            AND other.energy < own.energy - CAST($1 AS DOUBLE PRECISION) * structure.atoms
            AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = own.structure AND job.protocol = own.protocol
                AND job.state = 'dropped')",
            $end
        )
    };
}

/// By structure and protocol, the lowest first.
pub(crate) const ALL: &str = pairs!(
    "own.structure AS structure, own.protocol AS protocol, own.number AS own, other.number AS other",
    " ORDER BY other.structure, other.protocol, other.energy, other.number"
);

pub(crate) const OF_STRUCTURE: &str = pairs!(
    "own.structure AS structure, own.protocol AS protocol, own.number AS own, other.number AS other",
    " AND other.structure = $2 ORDER BY other.structure, other.protocol, other.energy, other.number"
);

pub(crate) const COUNT: &str = pairs!("count(DISTINCT other.structure)", "");

const LABEL: &str = "SELECT * FROM label WHERE number = $1";

const SUPERSEDE: &str =
    "UPDATE label SET status = 'superseded', superseded = $2, reason = $3 WHERE number = $1";

const KEEP_AS_CHECK: &str = "UPDATE label SET status = 'check' WHERE number = $1";

const MAKE_LABEL: &str =
    "UPDATE label SET status = 'label', superseded = NULL, reason = NULL WHERE number = $1";

/// Numbers of a label in force and of a lower result.
struct StatePair {
    structure: i64,
    protocol: i64,
    own: i64,
    other: i64,
}

from_columns!(StatePair { structure, protocol, own, other });

/// What becomes of the higher state.
enum Higher<'a> {
    /// It was the label.
    Superseded { reason: &'a str },
    /// It has just arrived: the lower one stays or returns.
    Check,
}

impl Store {
    /// Sets when a result is another state than the label and what happens then, for every process that stores
    /// results from now on.
    pub async fn set_lower_state_rule(&self, rule: &LowerStateRule) -> Result<()> {
        let text = serde_json::to_string(rule).expect("plain data becomes JSON");
        let mut transaction = self.database.begin_as_leader().await?;
        set_campaign_value(&mut transaction, RULE, &text).await?;
        transaction.commit().await
    }

    /// See [`Self::set_lower_state_rule`].
    pub async fn lower_state_rule(&self) -> Result<LowerStateRule> {
        read_rule(&mut self.database.begin_read().await?).await
    }

    /// Every structure whose label is not the lowest known state, in the order in which structures were stored.
    pub async fn lower_states(&self) -> Result<Vec<LowerState>> {
        let mut transaction = self.database.begin_read().await?;
        let mut found = Vec::new();
        for pair in pairs(&mut transaction, None).await? {
            found.push(describe(&mut transaction, &pair).await?.0);
        }
        Ok(found)
    }

    /// Makes the lowest known state the label of these structures, by every protocol that they have a label of; the
    /// labels before are superseded, with this time and the difference as the reason, followed by `remark`. Without
    /// `ids`, of every structure that has a lower state. Applies to all of the structures or to none. Adds a line
    /// `lower_state` to the operations log for each label. Structures are named as for [`Store::exclude`].
    ///
    /// # Errors
    /// [`StoreError::NoLabel`] for a structure without a label that counts, and errors for names that fit none or
    /// several.
    pub async fn take_lower_states(
        &self,
        ids: Option<&[String]>,
        remark: Option<&str>,
        now: i64,
    ) -> Result<Vec<LowerStateChange>> {
        let named = self.named_or_with_lower_states(ids).await?;
        let mut transaction = self.database.begin().await?;
        let now = transaction.time(now).await?;
        structures::lock(&mut transaction, named.iter().map(|named| named.structure)).await?;
        let mut changes = Vec::new();
        for NamedStructure { structure, id } in named {
            if ids.is_some() {
                exclude::check_has_label(&mut transaction, structure, &id).await?;
            }
            let mut taken = Vec::new();
            for pair in pairs(&mut transaction, Some(structure)).await? {
                taken.push(take(&mut transaction, &pair, remark, now).await?);
            }
            changes.push(LowerStateChange { id, taken });
        }
        transaction.commit().await?;
        Ok(changes)
    }

    /// What [`Self::take_lower_states`] would change. Changes nothing.
    ///
    /// # Errors
    /// As for that.
    pub async fn lower_state_changes(&self, ids: Option<&[String]>) -> Result<Vec<LowerStateChange>> {
        let named = self.named_or_with_lower_states(ids).await?;
        let mut transaction = self.database.begin_read().await?;
        let mut changes = Vec::new();
        for NamedStructure { structure, id } in named {
            if ids.is_some() {
                exclude::check_has_label(&mut transaction, structure, &id).await?;
            }
            let mut taken = Vec::new();
            for pair in pairs(&mut transaction, Some(structure)).await? {
                taken.push(describe(&mut transaction, &pair).await?.0);
            }
            changes.push(LowerStateChange { id, taken });
        }
        Ok(changes)
    }

    /// The named structures, or without names those with a lower state.
    async fn named_or_with_lower_states(&self, ids: Option<&[String]>) -> Result<Vec<NamedStructure>> {
        match ids {
            Some(ids) => self.named_structures(ids).await,
            None => self.with_lower_states().await,
        }
    }

    async fn with_lower_states(&self) -> Result<Vec<NamedStructure>> {
        let mut transaction = self.database.begin_read().await?;
        let mut numbers: Vec<_> =
            pairs(&mut transaction, None).await?.iter().map(|pair| pair.structure).collect();
        numbers.dedup();
        let mut named = Vec::new();
        for structure in numbers {
            let id = structures::name(&mut transaction, structure).await?;
            named.push(NamedStructure { structure, id });
        }
        Ok(named)
    }
}

/// Number of structures with a lower state. Tables of an earlier version have none.
pub(super) async fn count(transaction: &mut Transaction) -> Result<u64> {
    if !exclude::has_exclusion_columns(transaction).await? {
        return Ok(0);
    }
    let rule = read_rule(transaction).await?;
    query(COUNT).bind(rule.min_difference).fetch_one(transaction).await
}

/// Applies the rule after the result `new` was stored. If a lower state becomes the label, or stays it although
/// `new` was requested, this returns the status of `new`. The structure must be locked.
pub(super) async fn apply_rule(
    transaction: &mut Transaction,
    structure: i64,
    protocol: i64,
    new: i64,
    now: i64,
) -> Result<Option<LabelStatus>> {
    if read_rule(transaction).await?.on_lower_state == OnLowerState::Propose {
        return Ok(None);
    }
    let found = pairs(transaction, Some(structure)).await?;
    let Some(pair) = found.into_iter().find(|pair| pair.protocol == protocol) else { return Ok(None) };
    let (state, before) = describe(transaction, &pair).await?;
    let reason = reason_of(state.difference_per_atom);
    let is_late = pair.own == new;
    let higher = if is_late { Higher::Check } else { Higher::Superseded { reason: &reason } };
    swap(transaction, &pair, higher, now).await?;
    log(transaction, &pair, &state, &before, "label.on_lower_state", None, now).await?;
    let status = if pair.other == new { Some(LabelStatus::Label) } else { None };
    Ok(if is_late { Some(LabelStatus::Check) } else { status })
}

/// Makes the lower state the label, by hand.
async fn take(
    transaction: &mut Transaction,
    pair: &StatePair,
    remark: Option<&str>,
    now: i64,
) -> Result<LowerState> {
    let (state, before) = describe(transaction, pair).await?;
    let mut reason = reason_of(state.difference_per_atom);
    if let Some(remark) = remark {
        reason += &format!(" ({remark})");
    }
    swap(transaction, pair, Higher::Superseded { reason: &reason }, now).await?;
    log(transaction, pair, &state, &before, "user", remark, now).await?;
    Ok(state)
}

/// The higher one first: a structure has one label.
async fn swap(transaction: &mut Transaction, pair: &StatePair, higher: Higher<'_>, now: i64) -> Result<()> {
    let higher = match higher {
        Higher::Superseded { reason } => query(SUPERSEDE).bind(pair.own).bind(now).bind(reason),
        Higher::Check => query(KEEP_AS_CHECK).bind(pair.own),
    };
    higher.execute(&mut *transaction).await?;
    query(MAKE_LABEL).bind(pair.other).execute(&mut *transaction).await?;
    Ok(())
}

/// `before` is the lower result as it was: what the label forgets by becoming one again stands in the log.
async fn log(
    transaction: &mut Transaction,
    pair: &StatePair,
    state: &LowerState,
    before: &LabelRecord,
    by: &str,
    reason: Option<&str>,
    now: i64,
) -> Result<()> {
    let sql = "SELECT number FROM job WHERE structure = $1 AND protocol = $2";
    let job = query(sql).bind(pair.structure).bind(pair.protocol);
    let job: Option<i64> = job.fetch_optional(&mut *transaction).await?;
    let detail = json!({
        "candidate": state.id, "job": job, "protocol": state.protocol, "by": by, "reason": reason,
        "difference_per_atom": state.difference_per_atom, "label": state.lower, "higher": state.label,
        "superseded_before": before.superseded,
    });
    insert_operation(transaction, now, "lower_state", &detail).await
}

/// The lowest result of each structure, or of one, by each of its protocols.
async fn pairs(transaction: &mut Transaction, structure: Option<i64>) -> Result<Vec<StatePair>> {
    if !exclude::has_exclusion_columns(transaction).await? {
        return Ok(Vec::new());
    }
    let difference = read_rule(transaction).await?.min_difference;
    let found = match structure {
        Some(structure) => query(OF_STRUCTURE).bind(difference).bind(structure),
        None => query(ALL).bind(difference),
    };
    let mut found: Vec<StatePair> = found.fetch_all(&mut *transaction).await?;
    found.dedup_by_key(|pair| pair.own);
    Ok(found)
}

/// The pair in words, and the record of its lower result.
async fn describe(transaction: &mut Transaction, pair: &StatePair) -> Result<(LowerState, LabelRecord)> {
    let own: LabelRow = query(LABEL).bind(pair.own).fetch_one(&mut *transaction).await?;
    let other: LabelRow = query(LABEL).bind(pair.other).fetch_one(&mut *transaction).await?;
    let (own, other) = (own.into_record()?, other.into_record()?);
    let protocol = query("SELECT name FROM protocol WHERE number = $1").bind(pair.protocol);
    let (label, lower) = (StateResult::new(&own), StateResult::new(&other));
    let state = LowerState {
        id: structures::name(transaction, pair.structure).await?,
        protocol: protocol.fetch_one(&mut *transaction).await?,
        atoms: u32::try_from(own.label.forces.len()).unwrap_or(u32::MAX),
        difference_per_atom: lower.energy_per_atom - label.energy_per_atom,
        label,
        lower,
    };
    Ok((state, other))
}

async fn read_rule(transaction: &mut Transaction) -> Result<LowerStateRule> {
    let rule = query("SELECT value FROM campaign WHERE key = $1").bind(RULE);
    let rule: Option<String> = rule.fetch_optional(&mut *transaction).await?;
    let rule = rule.map(|text| serde_json::from_str(&text)).transpose();
    Ok(rule.map_err(|error| StoreError::damaged("the rule for lower states", error))?.unwrap_or_default())
}
