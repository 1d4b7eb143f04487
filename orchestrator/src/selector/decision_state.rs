//! The state that decisions depend on, and its restoration from the store.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use atoms::MinDistances;
use calm::{Mixture, MixtureError, Staleness};
use serde::de::DeserializeOwned;
use serde_json::json;
use store::records::{Commit, ComponentRecord, Decision, STALENESS, WalkRecord};
use wire::{ContentHash, WalkId};

use super::backlog::Backlog;
use super::completion::CompletionRule;
use super::error::SelectorError;
use super::forgetting::Forgetting;
use super::regrade::Regrader;
use super::rules::{ChangeableRules, RULES};
use super::settings::{SeedStructurePlan, SelectorSettings, SelectorSnapshot};
use super::training_frames::TrainingFrames;
use super::walk::Walk;
use super::walk_table::WalkTable;
use crate::grader::Grader;

/// Name of the value that tells that updates have become additive.
pub const ADDITIVE: &str = "additive_updates";
/// Kind of the decision that switches to a version of the potential, and the value with its number.
pub const VERSION: &str = "version";

/// Name of the value with the steps that biased walks made since the last accepted structure.
const STEPS_WITHOUT_STRUCTURE: &str = "steps_without_structure";

/// Decides on candidates and walks.
pub(super) struct DecisionState {
    pub settings: SelectorSettings,
    /// How close atoms may come in candidates of each seed structure.
    pub min_distances: Vec<MinDistances>,
    pub regrader: Regrader,
    pub mixture: Arc<Mixture>,
    /// Number of the version of the potential that the log has switched to.
    pub version: u32,
    pub forgetting: Forgetting,
    /// Updates are additive from here on: the mixture had forgotten too much.
    pub switched_to_additive: bool,
    pub walks: WalkTable,
    pub known: HashSet<ContentHash>,
    /// Number of started rounds; always 0 in live mode.
    pub round: u64,
    pub accepted: u32,
    /// Number of steps of biased walks with the version in force since the last accepted structure. Goes on once it has reached
    /// the limit. A replay does not count them: the log has the ends that follow.
    pub steps_without_structure: u64,
    /// Number of structures accepted from the biased walks of each seed structure with the version in force.
    pub accepted_by_seed_structure: HashMap<u32, u32>,
    /// Seed structures that have their maximum number of structures, but walks that have not ended.
    pub full_seed_structures: BTreeSet<u32>,
    pub declined_feature_bytes: u64,
    /// Number of candidates that could not be graded, and of control frames with atoms too close.
    pub left_out: u64,
    pub staleness: Staleness,
    /// Number of imported structures: now, and when the log last recorded it.
    pub imported: (u64, u64),
    /// The changeable rules when the log last recorded them.
    pub rules: Option<ChangeableRules>,
    pub backlog: Option<Backlog>,
    /// Factor on the threshold of the collection rule.
    pub threshold_factor: f64,
    /// The rule that declines candidates whose labels would probably fail.
    pub completion: Option<CompletionRule>,
}

impl DecisionState {
    /// Restores the state from a store.
    pub fn restore(
        settings: SelectorSettings,
        seed_structures: &[SeedStructurePlan],
        grader: Grader,
        original: Arc<Mixture>,
        training: Option<TrainingFrames>,
        snapshot: SelectorSnapshot,
    ) -> Result<Self, SelectorError> {
        let min_distances = min_distances(&settings, seed_structures, &grader)?;
        let value = |name: &str| -> Result<u64, SelectorError> {
            let stored = snapshot.values.iter().find(|(key, _)| key == name);
            let Some((_, text)) = stored else { return Ok(0) };
            text.parse().map_err(|_| SelectorError::Snapshot(format!("{name} is '{text}', not a number")))
        };
        let (round, version) = (value("round")?, value("mixture_version")?);
        let (declined_feature_bytes, imported) = (value("declined_feature_bytes")?, value("imported")?);
        let left_out = value(store::records::LEFT_OUT)?;
        let steps_without_structure = value(STEPS_WITHOUT_STRUCTURE)?;
        let staleness = restored(STALENESS, &snapshot.values)?.unwrap_or_default();
        let taken_up = u32::try_from(value(VERSION)?).unwrap_or(u32::MAX);
        let in_force = settings.version.version;
        if taken_up > in_force {
            let problem = format!("version {taken_up} of the potential, expected at most version {in_force}");
            return Err(SelectorError::Snapshot(problem));
        }
        // Components of another version do not fit the mixture of this one.
        let stored = if taken_up == in_force { &snapshot.components[..] } else { &[] };
        let mixture = Arc::new(restored_mixture(&original, version, stored)?);
        let mut forgetting = Forgetting::new(grader.symbols(), training);
        let changed = stored.iter().map(|record| (record.element as usize, record.slot as usize));
        forgetting.update(&original, &mixture, &changed.collect())?;
        let walks = restored_walks(snapshot.walks, seed_structures.len())?;
        let (mut accepted, mut accepted_by_seed_structure) = (0, HashMap::new());
        for Walk { record, .. } in walks.iter().filter(|walk| walk.is_biased()) {
            accepted += record.accepted;
            if record.conditions.version == taken_up {
                *accepted_by_seed_structure.entry(record.seed_structure).or_default() += record.accepted;
            }
        }
        let is_full = |accepted: u32| settings.max_per_seed_structure.is_some_and(|most| accepted >= most);
        let full = accepted_by_seed_structure.iter().filter(|(_, accepted)| is_full(**accepted));
        let full_seed_structures = full.map(|(seed, _)| *seed).collect();
        Ok(Self {
            settings,
            min_distances,
            regrader: Regrader { grader: Arc::new(grader), original },
            mixture,
            version: taken_up,
            forgetting,
            switched_to_additive: value(ADDITIVE)? > 0,
            walks,
            known: snapshot.known.into_iter().collect(),
            round,
            accepted,
            steps_without_structure,
            accepted_by_seed_structure,
            full_seed_structures,
            declined_feature_bytes,
            left_out,
            staleness,
            imported: (snapshot.imported, imported),
            rules: restored(RULES, &snapshot.values)?,
            backlog: None,
            threshold_factor: 1.0,
            completion: None,
        })
    }

    /// A walk that exists.
    pub fn walk_mut(&mut self, id: WalkId) -> &mut Walk {
        self.walks.get_mut(id)
    }

    /// Adds the current values to a commit.
    pub fn add_values(&self, commit: &mut Commit) {
        let values = [
            ("round", self.round),
            ("mixture_version", self.mixture.version()),
            ("declined_feature_bytes", self.declined_feature_bytes),
            ("imported", self.imported.0),
            (STEPS_WITHOUT_STRUCTURE, self.steps_without_structure),
        ];
        commit.values.extend(values.map(|(name, value)| (name.to_owned(), value.to_string())));
        if !commit.candidates.is_empty() {
            commit.values.push((STALENESS.to_owned(), json!(self.staleness).to_string()));
        }
        if self.switched_to_additive {
            commit.values.push((ADDITIVE.to_owned(), "1".to_owned()));
        }
        if self.version > 0 {
            commit.values.push((VERSION.to_owned(), self.version.to_string()));
        }
        if self.left_out > 0 {
            commit.values.push((store::records::LEFT_OUT.to_owned(), self.left_out.to_string()));
        }
    }

    pub fn decision(&self, kind: &'static str, walk: WalkId, detail: serde_json::Value) -> Decision {
        let (round, mixture_version) = (self.round, self.mixture.version());
        Decision { round, kind, walk: Some(walk), candidate: None, mixture_version, detail }
    }
}

/// How close atoms may come in walks from each seed structure.
fn min_distances(
    settings: &SelectorSettings,
    seed_structures: &[SeedStructurePlan],
    grader: &Grader,
) -> Result<Vec<MinDistances>, SelectorError> {
    let of = |seed: &SeedStructurePlan| match grader.bonds(&seed.structure) {
        Ok(bonds) => Ok(settings.min_distances.limits(&bonds.shortest)),
        Err(source) => Err(SelectorError::SeedStructure { name: seed.name.clone(), source }),
    };
    seed_structures.iter().map(of).collect()
}

/// The stored walks, which must be numbered from 0 and start from existing seed structures.
fn restored_walks(records: Vec<WalkRecord>, seed_structures: usize) -> Result<WalkTable, SelectorError> {
    let mut walks = WalkTable::default();
    for (number, record) in records.into_iter().enumerate() {
        let (id, seed) = (record.walk, record.seed_structure);
        if id.0 as usize != number {
            return Err(SelectorError::Snapshot(format!("found walk {id} in place of walk {number}")));
        }
        if seed as usize >= seed_structures {
            let problem =
                format!("walk {id} starts from seed structure {seed}, but there are only {seed_structures}");
            return Err(SelectorError::Snapshot(problem));
        }
        walks.insert(Walk::restore(record)?);
    }
    Ok(walks)
}

/// A value that databases of earlier versions do not have.
fn restored<T: DeserializeOwned>(
    name: &str,
    values: &[(String, String)],
) -> Result<Option<T>, SelectorError> {
    let Some((_, text)) = values.iter().find(|(key, _)| key == name) else { return Ok(None) };
    let read = serde_json::from_str(text);
    read.map(Some).map_err(|error| SelectorError::Snapshot(format!("{name} is damaged: {error}")))
}

/// The mixture of a version, from the original mixture and the stored components.
///
/// # Errors
/// Components that are damaged or do not match the original mixture.
pub(super) fn restored_mixture(
    original: &Mixture,
    version: u64,
    components: &[ComponentRecord],
) -> Result<Mixture, SelectorError> {
    let stored =
        components.iter().map(|record| (record.element as usize, record.slot as usize, &record.bytes[..]));
    original.restored(version, stored).map_err(|error| match error {
        MixtureError::Bytes { .. } => SelectorError::Snapshot(error.to_string()),
        other => other.into(),
    })
}
