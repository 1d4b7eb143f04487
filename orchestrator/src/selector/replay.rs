//! Replays the decision log of a campaign, with the same rules or with others.
//!
//! The actions of walkers are taken from the log: which structures they offered and when, rollbacks, and ends of walks.
//! The decisions are made again. With the same rules, every decision must be the same.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;

use calm::Mixture;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use store::records::{CandidateRecord, Commit, ComponentRecord, Decision, LoggedDecision};
use wire::messages::WalkEnd;
use wire::{ContentHash, WalkConditions, WalkId};

use super::completion::CompletionRule;
use super::decide::{FORGETTING, LEFT_OUT};
use super::decision_state::{DecisionState, restored_mixture};
use super::forgetting::Forgetting;
use super::rules::CONFIGURATION;
use super::{
    RegradedCandidate, Regrader, SeedStructurePlan, SelectorError, SelectorSettings, SelectorSnapshot,
    TrainingFrames,
};
use crate::grader::Grader;

/// Why a log cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The selector failed.
    #[error("decision {sequence}: {source}")]
    Selector {
        /// Number of the decision.
        sequence: i64,
        /// The error.
        source: Box<SelectorError>,
    },
    /// The log is damaged.
    #[error("decision {sequence} ({kind}): {problem}: the database is damaged; restore it from a backup")]
    Damaged {
        /// Number of the decision.
        sequence: i64,
        /// Its kind.
        kind: String,
        /// What is wrong.
        problem: String,
    },
    /// The settings do not match the campaign.
    #[error(transparent)]
    Settings(Box<SelectorError>),
}

/// The result of replaying a decision.
#[derive(Debug)]
pub struct ReplayedDecision {
    /// The new decision.
    pub decision: Decision,
    /// Its candidate, if it has one.
    pub candidate: Option<CandidateRecord>,
}

/// A replay.
pub struct Replay {
    decisions: DecisionState,
    /// Index of each seed structure by its name.
    seed_structures: HashMap<String, usize>,
    /// Imported structures in order of import.
    imported: Vec<ContentHash>,
    /// Configuration keys that differ from the campaign's.
    set: HashSet<String>,
    /// Decisions that followed from the last candidate: a switch to additive updates, the end of the walk.
    following: VecDeque<Decision>,
    cut_short: u64,
}

impl Replay {
    /// A replay before the first decision. `settings` are those at the start of the campaign, except for the keys in
    /// `set`, which the log does not change.
    pub fn new(
        settings: SelectorSettings,
        set: HashSet<String>,
        seed_structures: Vec<SeedStructurePlan>,
        grader: Grader,
        original: Arc<Mixture>,
        training: Option<TrainingFrames>,
        imported: Vec<ContentHash>,
    ) -> Result<Self, ReplayError> {
        let decisions = DecisionState::restore(
            settings,
            &seed_structures,
            grader,
            original,
            training,
            SelectorSnapshot::default(),
        );
        let decisions = decisions.map_err(|source| ReplayError::Settings(Box::new(source)))?;
        let seed_structures =
            seed_structures.into_iter().enumerate().map(|(index, seed)| (seed.name, index)).collect();
        Ok(Self { decisions, seed_structures, imported, set, following: VecDeque::new(), cut_short: 0 })
    }

    /// Whether all rules are the same. Only then are control walks and their frames replayed: they do not affect
    /// decisions, and would be different with other rules.
    pub fn is_exact(&self) -> bool {
        self.set.is_empty()
    }

    /// Regrades candidates ahead of [`Self::apply`].
    pub fn regrader(&self) -> &Regrader {
        &self.decisions.regrader
    }

    /// The current mixture.
    pub fn mixture(&self) -> &Arc<Mixture> {
        &self.decisions.mixture
    }

    /// Number of walks that ended because of a limit in the log, but would have continued with these rules.
    pub fn cut_short(&self) -> u64 {
        self.cut_short
    }

    /// Whether a decision about the candidate is made with these rules.
    pub fn is_reached(&self, recorded: &LoggedDecision) -> Result<bool, ReplayError> {
        Ok(self.walk_under_way(recorded)?.is_some())
    }

    /// Replays the next decision of the log, with its candidate if it has one. Returns `None` if this decision is not
    /// made with these rules, since the walk has ended.
    pub fn apply(
        &mut self,
        recorded: &LoggedDecision,
        candidate: Option<RegradedCandidate>,
    ) -> Result<Option<ReplayedDecision>, ReplayError> {
        self.decisions.round = recorded.round;
        let expected = self.expected(recorded);
        let decision = match recorded.kind.as_str() {
            "accepted" | "declined" | "control" => return self.candidate(recorded, candidate),
            "imported" => Some(self.import(recorded)?),
            CONFIGURATION => Some(self.change_rules(recorded)?),
            "begun" => self.begin(recorded)?,
            "resumed" => self.resume(recorded)?,
            "segment" => self.segment(recorded)?,
            LEFT_OUT => self.left_out(recorded)?,
            // With other rules it may not come to that, or earlier.
            FORGETTING => expected,
            "ended" => match expected {
                Some(ended) => Some(ended),
                None => self.end(recorded)?,
            },
            _ => return Err(damaged(recorded, "its kind is unknown to this version")),
        };
        Ok(decision.map(|decision| ReplayedDecision { decision, candidate: None }))
    }

    /// The decision that followed from the last candidate and is recorded here.
    fn expected(&mut self, recorded: &LoggedDecision) -> Option<Decision> {
        let same =
            |next: &Decision| next.kind == recorded.kind && next.walk.map(|walk| walk.0) == recorded.walk;
        let place = self.following.iter().position(same);
        match place {
            Some(place) => self.following.drain(..=place).next_back(),
            None if recorded.kind == FORGETTING => None,
            None => {
                self.following.clear();
                None
            }
        }
    }

    fn candidate(
        &mut self,
        recorded: &LoggedDecision,
        candidate: Option<RegradedCandidate>,
    ) -> Result<Option<ReplayedDecision>, ReplayError> {
        let Some(id) = self.walk_under_way(recorded)? else { return Ok(None) };
        let regraded = candidate.ok_or_else(|| damaged(recorded, "its candidate is missing"))?;
        let step = regraded.block.view().id().step;
        self.decisions.threshold_factor = recorded.detail["raised_by"].as_f64().unwrap_or(1.0);
        self.decisions.completion = CompletionRule::from_decision(&recorded.detail);
        let walk = self.decisions.walk_mut(id);
        walk.record.progress.step = step;
        let (mut commit, biased) = (Commit::default(), walk.is_biased());
        let decided = match biased {
            true => self.decisions.decide_candidate(id, regraded, &mut commit),
            false => self.decisions.keep_control_frame(id, regraded, &mut commit),
        };
        match decided {
            Err(error) if error.is_of_candidate() => {
                self.decisions.leave_out(id, step, &error.to_string(), &mut commit);
            }
            decided => decided.map_err(|source| ReplayError::Selector {
                sequence: recorded.sequence,
                source: Box::new(source),
            })?,
        }
        let mut decisions = commit.decisions.into_iter();
        let decision = decisions.next();
        self.following = decisions.collect();
        let candidate = commit.candidates.pop();
        Ok(decision.map(|decision| ReplayedDecision { decision, candidate }))
    }

    /// Replays the decision to switch to a version of the potential, with what grades depend on: the model's `grader`, its `original`
    /// mixture and, if they are monitored, the features of the `training` frames by that model. The decision is of kind
    /// [`super::VERSION`].
    pub fn take_up_version(
        &mut self,
        recorded: &LoggedDecision,
        grader: Grader,
        original: Arc<Mixture>,
        training: Option<TrainingFrames>,
    ) -> Result<Option<ReplayedDecision>, ReplayError> {
        let decisions = &mut self.decisions;
        decisions.round = recorded.round;
        decisions.settings.version = read(recorded)?;
        decisions.forgetting = Forgetting::new(grader.symbols(), training);
        decisions.regrader = Regrader { grader: Arc::new(grader), original };
        let mut commit = Commit::default();
        decisions.take_up_version(&mut commit);
        let decision = commit.decisions.pop();
        Ok(decision.map(|decision| ReplayedDecision { decision, candidate: None }))
    }

    fn import(&mut self, recorded: &LoggedDecision) -> Result<Decision, ReplayError> {
        #[derive(Deserialize)]
        struct ImportDetail {
            structures: usize,
        }
        let ImportDetail { structures } = read(recorded)?;
        let known = self.imported.get(..structures);
        let known = known.ok_or_else(|| {
            damaged(
                recorded,
                &format!("{structures} imported structures, but only {} exist", self.imported.len()),
            )
        })?;
        self.decisions.known.extend(known);
        Ok(self.decisions.campaign_decision("imported", recorded.detail.clone()))
    }

    /// Applies the changed rules, except for the keys in `set`.
    fn change_rules(&mut self, recorded: &LoggedDecision) -> Result<Decision, ReplayError> {
        let mut rules = self.decisions.settings.changeable_rules().to_map();
        for (key, value) in read::<Map<String, Value>>(recorded)? {
            if !self.set.contains(&key) {
                rules.insert(key, value);
            }
        }
        let rules = serde_json::from_value(Value::Object(rules));
        self.decisions.settings.apply_rules(&rules.map_err(|error| damaged(recorded, &error.to_string()))?);
        Ok(self.decisions.campaign_decision(CONFIGURATION, recorded.detail.clone()))
    }

    fn begin(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum StartDetail {
            Biased {
                seed_structure: String,
                /// Campaigns of early versions have the same conditions in all walks.
                #[serde(default)]
                conditions: WalkConditions,
                /// The selectors of earlier versions had no bound.
                #[serde(default)]
                max_grade: Option<f64>,
            },
            Control {
                control_of: WalkId,
            },
        }
        // With other rules there are no control walks, but walks keep their numbers from the log.
        let id = if self.is_exact() { self.decisions.next_walk_id() } else { walk(recorded)? };
        match read(recorded)? {
            StartDetail::Biased { seed_structure: name, conditions, max_grade } => {
                self.decisions.settings.max_grade = max_grade;
                let seed = self.seed_structures.get(&name).copied();
                let seed =
                    seed.ok_or_else(|| damaged(recorded, &format!("there is no seed structure '{name}'")))?;
                Ok(Some(self.decisions.start_walk(id, seed, &name, conditions)))
            }
            StartDetail::Control { control_of } if self.is_exact() => {
                let is_there = self.decisions.walks.get(control_of).is_some();
                Ok(is_there.then(|| self.decisions.start_control(id, control_of)))
            }
            StartDetail::Control { .. } => Ok(None),
        }
    }

    /// A walk that has reached a limit of these rules is not resumed.
    fn resume(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        let id = walk(recorded)?;
        let goes_on = self.decisions.walks.get(id).is_some() && self.decisions.can_resume(id);
        Ok(goes_on.then(|| self.decisions.resume(id)))
    }

    /// Rollbacks are actions of the walker.
    fn segment(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        let id = self.walk_under_way(recorded)?;
        Ok(id.map(|id| self.decisions.decision("segment", id, recorded.detail.clone())))
    }

    fn left_out(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        #[derive(Deserialize)]
        struct LeftOutDetail {
            step: u64,
            error: String,
        }
        let Some(id) = self.walk_under_way(recorded)? else { return Ok(None) };
        let LeftOutDetail { step, error } = read(recorded)?;
        let mut commit = Commit::default();
        self.decisions.walk_mut(id).record.progress.step = step;
        self.decisions.leave_out(id, step, &error, &mut commit);
        let mut decisions = commit.decisions.into_iter();
        let decision = decisions.next();
        self.following = decisions.collect();
        Ok(decision)
    }

    fn end(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        #[derive(Deserialize)]
        struct EndDetail {
            end: String,
            reason: String,
            step: u64,
        }
        let Some(id) = self.walk_under_way(recorded)? else { return Ok(None) };
        let EndDetail { end, reason, step } = read(recorded)?;
        // Other walks of its seed structure may have collected enough.
        let enough = self.decisions.has_collected_enough(&self.decisions.walks[id]);
        let collected = end == WalkEnd::QuotaReached.name() && !enough;
        if collected && self.is_exact() {
            // The selector itself would have ended the walk.
            return Ok(None);
        }
        let budget = end == WalkEnd::Budget.name() && !self.decisions.is_budget_exhausted();
        self.cut_short += u64::from(collected || budget);
        self.decisions.walk_mut(id).record.progress.step = step;
        let mut commit = Commit::default();
        self.decisions.end_walk_as(id, &end, reason, &mut commit);
        Ok(commit.decisions.pop())
    }

    /// The walk of a decision, if it exists and has not ended.
    fn walk_under_way(&self, recorded: &LoggedDecision) -> Result<Option<WalkId>, ReplayError> {
        let id = walk(recorded)?;
        Ok(self.decisions.walks.get(id).filter(|walk| !walk.has_ended()).map(|_| id))
    }

    /// The first component (element index, slot) in which the mixture differs from the stored one, compared byte by
    /// byte.
    pub fn first_different_component(
        &self,
        version: u64,
        stored: &[ComponentRecord],
    ) -> Result<Option<(usize, usize)>, ReplayError> {
        let stored = restored_mixture(&self.decisions.regrader.original, version, stored);
        let stored = stored.map_err(|source| ReplayError::Settings(Box::new(source)))?;
        let mut places = self.decisions.mixture.iter().zip(stored.iter());
        let other = places.find(|((.., now), (.., stored))| now.to_bytes() != stored.to_bytes());
        Ok(other.map(|((element, slot, _), _)| (element, slot)))
    }
}

pub(super) fn damaged(recorded: &LoggedDecision, problem: &str) -> ReplayError {
    let LoggedDecision { sequence, kind, .. } = recorded;
    ReplayError::Damaged { sequence: *sequence, kind: kind.clone(), problem: problem.to_owned() }
}

fn walk(recorded: &LoggedDecision) -> Result<WalkId, ReplayError> {
    recorded.walk.map(WalkId).ok_or_else(|| damaged(recorded, "it is about no walk"))
}

fn read<T: DeserializeOwned>(recorded: &LoggedDecision) -> Result<T, ReplayError> {
    T::deserialize(&recorded.detail).map_err(|error| damaged(recorded, &error.to_string()))
}
