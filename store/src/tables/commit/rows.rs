//! The rows that a commit writes.

use std::collections::{BTreeMap, HashMap, HashSet};

use wire::CandidateView;

use crate::checksum::{
    CANDIDATE as CANDIDATES, COMPONENT as COMPONENTS, CheckedColumn, DECISION as DECISIONS,
    STRUCTURE as STRUCTURES, VALUE as VALUES, WALK as WALKS, WALK_CONDITIONS as CONDITIONS,
};
use crate::database::SqlValue;
use crate::encoding::{encode_structure, integer};
use crate::error::{Result, StoreError};
use crate::numbers::encode_numbers;
use crate::records::{AtomGrades, CandidateRecord, Commit, Decision, Fate, WalkRecord};
use crate::tables::trajectory;

/// The values of a row, in the order of the columns.
type RowValues = Vec<SqlValue>;

pub(super) const DECISION: [&str; 8] =
    ["sequence", "round", "kind", "walk", "candidate", "mixture_version", "detail", "checksum"];
pub(super) const STRUCTURE: [&str; 5] = ["hash", "atoms", "formula", "data", "checksum"];
pub(super) const COMPONENT: [&str; 4] = ["element", "slot", "bytes", "checksum"];
pub(super) const VALUE: [&str; 3] = ["name", "value", "checksum"];
pub(super) const CANDIDATE: [&str; 29] = [
    "decision",
    "id",
    "content",
    "walk",
    "segment",
    "step",
    "seed_structure",
    "origin",
    "fate",
    "reason",
    "mixture_version",
    "atoms",
    "formula",
    "temperature",
    "relative_volume",
    "energy",
    "walker_gamma",
    "walker_gamma_nbr",
    "walker_above",
    "selector_gamma",
    "selector_gamma_nbr",
    "selector_above",
    "original_gamma",
    "original_gamma_nbr",
    "original_above",
    "checksum",
    "features_checksum",
    "selector_checksum",
    "original_checksum",
];
pub(super) const CANDIDATE_COUNT: [&str; 3] = ["origin", "fate", "number"];
pub(super) const CANDIDATE_DATA: [&str; 5] =
    ["decision", "block", "features", "selector_grades", "original_grades"];
pub(super) const WALK_CONDITIONS: [&str; 3] = ["walk", "conditions", "checksum"];
pub(super) const WALK: [&str; 20] = [
    "walk",
    "origin",
    "partner",
    "seed_structure",
    "state",
    "reason",
    "assignments",
    "accepted",
    "step",
    "segment",
    "tau",
    "temperature",
    "relative_volume",
    "gamma_max",
    "rejected",
    "rollbacks",
    "selector_state",
    "checksum",
    "checkpoint",
    "checkpoint_checksum",
];

/// Rows of each table. Decisions are numbered from 1 until the number of earlier decisions is known.
pub(super) struct CommitRows {
    pub decisions: Vec<RowValues>,
    pub structures: Vec<RowValues>,
    pub candidates: Vec<RowValues>,
    /// Number of candidates of each kind.
    pub candidate_counts: Vec<RowValues>,
    pub candidate_data: Vec<RowValues>,
    /// For every accepted candidate.
    pub jobs: Vec<RowValues>,
    pub components: Vec<RowValues>,
    pub walks: Vec<RowValues>,
    /// For every walk that has no assignment behind it.
    pub walk_conditions: Vec<RowValues>,
    pub values: Vec<RowValues>,
    pub trajectories: Vec<RowValues>,
}

impl CommitRows {
    pub fn from_commit(commit: &Commit) -> Result<Self> {
        let mut rows = Self {
            decisions: commit.decisions.iter().zip(1..).map(decision).collect::<Result<_>>()?,
            structures: Vec::new(),
            candidates: Vec::new(),
            candidate_counts: candidate_counts(commit),
            candidate_data: Vec::new(),
            jobs: Vec::new(),
            components: newest(&commit.components, |component| (component.element, component.slot))
                .map(|component| {
                    let row =
                        vec![component.element.into(), component.slot.into(), component.bytes.clone().into()];
                    COMPONENTS.with_checksum(row)
                })
                .collect(),
            walks: newest(&commit.walks, |walk| walk.walk).map(walk).collect::<Result<_>>()?,
            walk_conditions: newest(&commit.walks, |walk| walk.walk)
                .filter(|walk| walk.assignments == 0)
                .map(walk_conditions)
                .collect(),
            values: newest(&commit.values, |(name, _)| name)
                .map(|(name, value)| VALUES.with_checksum(vec![name.into(), value.into()]))
                .collect(),
            trajectories: trajectory::rows(&commit.trajectories)?,
        };
        let (mut decided, mut structures) = (decided(commit)?, HashSet::new());
        for record in &commit.candidates {
            let id = record.block.view().id().to_string();
            let decision = decided
                .remove(&id)
                .ok_or_else(|| StoreError::Inconsistent(format!("candidate {id} without a decision")))?;
            rows.candidate(decision, id, record, &mut structures)?;
        }
        if let Some(id) = decided.into_keys().min() {
            return Err(StoreError::Inconsistent(format!(
                "a decision about candidate {id}, which is missing"
            )));
        }
        Ok(rows)
    }

    fn candidate(
        &mut self,
        decision: i64,
        id: String,
        record: &CandidateRecord,
        structures: &mut HashSet<[u8; 32]>,
    ) -> Result<()> {
        let view = record.block.view();
        let data = vec![
            decision.into(),
            record.block.without_features().as_bytes().to_vec().into(),
            record.keep_features.then(|| encode_numbers(view.features)).into(),
            grades(&id, &view, &record.selector)?.into(),
            grades(&id, &view, &record.original)?.into(),
        ];
        self.candidate_data.push(data);
        let (structure, hash) = (view.structure(), view.id().content.0);
        if record.fate == Fate::Accepted {
            if structures.insert(hash) {
                let row = vec![
                    hash[..].into(),
                    count(structure.len())?.into(),
                    structure.formula().into(),
                    encode_structure(&structure).into(),
                ];
                self.structures.push(STRUCTURES.with_checksum(row));
            }
            // The protocol is filled in with the decision's number.
            self.jobs.push(vec![
                hash[..].into(),
                SqlValue::Integer(None),
                decision.into(),
                record.priority.into(),
            ]);
        }
        self.candidates.push(summary(decision, id, record, &view, structure.formula())?);
        Ok(())
    }

    /// Numbers the decisions from `first`. Without a protocol there are no jobs.
    pub fn number_from(&mut self, first: i64, protocol: Option<i64>) {
        let shift = |value: &mut SqlValue| {
            if let SqlValue::Integer(Some(number)) = value {
                *number += first - 1;
            }
        };
        for rows in [&mut self.decisions, &mut self.candidates, &mut self.candidate_data] {
            rows.iter_mut().filter_map(|row| row.first_mut()).for_each(shift);
        }
        self.jobs.retain(|_| protocol.is_some());
        for row in &mut self.jobs {
            row[1] = protocol.into();
            shift(&mut row[2]);
        }
        self.add_checksums();
    }

    /// The checksums cover the numbers of the decisions.
    fn add_checksums(&mut self) {
        for row in &mut self.decisions {
            *row = DECISIONS.with_checksum(std::mem::take(row));
        }
        for (row, data) in self.candidates.iter_mut().zip(&self.candidate_data) {
            *row = CANDIDATES.with_checksum(std::mem::take(row));
            if let [SqlValue::Integer(Some(decision)), _, long @ ..] = data.as_slice() {
                row.extend(long.iter().map(|column| long_checksum(*decision, column)));
            }
        }
    }
}

/// Features and grades, in the order of their columns.
fn long_checksum(decision: i64, column: &SqlValue) -> SqlValue {
    let SqlValue::Bytes(bytes) = column else { return SqlValue::Integer(None) };
    CheckedColumn::checksum(decision, bytes.as_deref()).into()
}

fn candidate_counts(commit: &Commit) -> Vec<RowValues> {
    let mut counts = BTreeMap::<_, i64>::new();
    for record in &commit.candidates {
        *counts.entry((record.block.view().origin().name(), record.fate.name())).or_default() += 1;
    }
    counts
        .into_iter()
        .map(|((origin, fate), number)| vec![origin.into(), fate.into(), number.into()])
        .collect()
}

/// Candidates with the index of their decision, from 1.
fn decided(commit: &Commit) -> Result<HashMap<String, i64>> {
    let mut decided = HashMap::new();
    for (decision, number) in commit.decisions.iter().zip(1..) {
        let id = decision.candidate.map(|id| id.to_string());
        if let Some(twice) = id.filter(|id| decided.insert(id.clone(), number).is_some()) {
            return Err(StoreError::Inconsistent(format!("two decisions about candidate {twice}")));
        }
    }
    Ok(decided)
}

fn decision((decision, number): (&Decision, i64)) -> Result<RowValues> {
    Ok(vec![
        number.into(),
        integer("round", decision.round)?.into(),
        decision.kind.into(),
        decision.walk.map(|walk| walk.0).into(),
        decision.candidate.map(|id| id.to_string()).into(),
        integer("mixture version", decision.mixture_version)?.into(),
        decision.detail.to_string().into(),
    ])
}

/// The summary columns of a candidate.
fn summary(
    decision: i64,
    id: String,
    record: &CandidateRecord,
    view: &CandidateView<'_>,
    formula: String,
) -> Result<RowValues> {
    let (fate, reason) = match record.fate {
        Fate::Accepted => ("accepted", None),
        Fate::Declined(reason) => ("declined", Some(reason.name())),
    };
    let mut row = vec![
        decision.into(),
        id.into(),
        view.id().content.0[..].into(),
        view.id().walk.0.into(),
        view.id().segment.into(),
        integer("step", view.id().step)?.into(),
        record.seed_structure.into(),
        view.origin().name().into(),
        fate.into(),
        reason.into(),
        integer("mixture version", view.mixture_version())?.into(),
        count(view.numbers.len())?.into(),
        formula.into(),
        view.temperature().into(),
        view.relative_volume().into(),
        view.energy().into(),
    ];
    let (selector, original) = (&record.selector, &record.original);
    for (gamma, gamma_nbr) in [
        (view.gamma, view.gamma_nbr),
        (&selector.gamma, &selector.gamma_nbr),
        (&original.gamma, &original.gamma_nbr),
    ] {
        let above = (!gamma.is_empty()).then(|| gamma.iter().filter(|g| **g > 1.0).count());
        row.extend([
            gamma.iter().copied().reduce(f64::max).into(),
            gamma_nbr.iter().copied().reduce(f64::max).into(),
            above.map(count).transpose()?.into(),
        ]);
    }
    Ok(row)
}

/// γ and γ_nbr, one after the other; `None` without grades.
fn grades(id: &str, view: &CandidateView<'_>, grades: &AtomGrades) -> Result<Option<Vec<u8>>> {
    let n = view.numbers.len();
    match (grades.gamma.len(), grades.gamma_nbr.len()) {
        (0, 0) => Ok(None),
        (a, b) if (a, b) == (n, n) => {
            Ok(Some(encode_numbers(&[grades.gamma.as_slice(), &grades.gamma_nbr].concat())))
        }
        (a, b) => {
            Err(StoreError::Inconsistent(format!("{a} and {b} grades for the {n} atoms of candidate {id}")))
        }
    }
}

fn walk(walk: &WalkRecord) -> Result<RowValues> {
    let WalkRecord { progress, .. } = walk;
    let row = vec![
        walk.walk.0.into(),
        walk.origin.name().into(),
        walk.partner.map(|partner| partner.0).into(),
        walk.seed_structure.into(),
        (&walk.state).into(),
        (&walk.reason).into(),
        integer("number of assignments", walk.assignments)?.into(),
        walk.accepted.into(),
        integer("step", progress.step)?.into(),
        progress.segment.into(),
        progress.tau.into(),
        progress.temperature.into(),
        progress.relative_volume.into(),
        progress.gamma_max.into(),
        integer("number of rejections", progress.rejected)?.into(),
        progress.rollbacks.into(),
        (&walk.selector_state).into(),
    ];
    let mut row = WALKS.with_checksum(row);
    let checkpoint = CheckedColumn::checksum(walk.walk.0.into(), walk.checkpoint.as_deref());
    row.extend([walk.checkpoint.clone().into(), checkpoint.into()]);
    Ok(row)
}

fn walk_conditions(walk: &WalkRecord) -> RowValues {
    let conditions = serde_json::to_string(&walk.conditions).expect("plain data becomes JSON");
    CONDITIONS.with_checksum(vec![walk.walk.0.into(), conditions.into()])
}

/// Only the newest record for each key, in order: a statement may write a row only once.
fn newest<'a, T, K: Eq + std::hash::Hash>(
    records: &'a [T],
    key: impl Fn(&'a T) -> K,
) -> impl Iterator<Item = &'a T> {
    let mut seen = HashSet::new();
    let mut newest: Vec<_> = records.iter().rev().filter(|record| seen.insert(key(record))).collect();
    newest.reverse();
    newest.into_iter()
}

fn count(number: usize) -> Result<i64> {
    integer("count", number as u64)
}
