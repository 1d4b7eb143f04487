//! The recorded stream of candidates and ends of walks once more before the judge, by the same rules or by others.
//!
//! What walkers said is taken from the log: which structures they offered and when, where they went back to a checkpoint,
//! how their walks ended. What the judge said is decided anew. By the same rules every decision must come out the same.

use std::collections::HashSet;
use std::sync::Arc;

use calm::Mixture;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use store::records::{CandidateRecord, Commit, ComponentRecord, Decision, LoggedDecision};
use wire::messages::WalkEnd;
use wire::{ContentHash, WalkId};

use super::decision_state::{DecisionState, restored_mixture};
use super::rules::CONFIGURATION;
use super::{
    RegradedCandidate, Regrader, SeedStructure, SelectorError, SelectorSnapshot, Settings, TrainingFrames,
};
use crate::grader::Grader;

/// Why a log cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The judge gave up.
    #[error("decision {sequence}: {source}")]
    Selector {
        /// Number of the decision.
        sequence: i64,
        /// Why.
        source: Box<SelectorError>,
    },
    /// A log that no selector wrote.
    #[error("decision {sequence} ({kind}): {problem}: the database is damaged; restore it from a copy")]
    Damaged {
        /// Number of the decision.
        sequence: i64,
        /// Its kind.
        kind: String,
        /// What is wrong.
        problem: String,
    },
    /// The settings do not go with the campaign.
    #[error(transparent)]
    Settings(Box<SelectorError>),
}

/// What comes of a place of the log now.
#[derive(Debug)]
pub struct ReplayedDecision {
    /// The decision.
    pub decision: Decision,
    /// The candidate that it is about, if it is about one.
    pub candidate: Option<CandidateRecord>,
}

/// A campaign that is replayed.
pub struct Replay {
    decisions: DecisionState,
    seeds: Vec<SeedStructure>,
    /// Imported structures in the order in which they came.
    imported: Vec<ContentHash>,
    /// Keys of the configuration that are not those of the campaign.
    set: HashSet<String>,
    /// The end of a walk that came with the last candidate.
    ended: Option<Decision>,
    cut_short: u64,
}

impl Replay {
    /// A campaign before its first decision: `settings` are those of its begin, but for the keys in `set`, which the log
    /// cannot change.
    pub fn new(
        settings: Settings,
        set: HashSet<String>,
        seeds: Vec<SeedStructure>,
        grader: Grader,
        original: Arc<Mixture>,
        training: Option<TrainingFrames>,
        imported: Vec<ContentHash>,
    ) -> Result<Self, ReplayError> {
        let decisions =
            DecisionState::restore(settings, &seeds, grader, original, training, SelectorSnapshot::default());
        let decisions = decisions.map_err(|source| ReplayError::Settings(Box::new(source)))?;
        Ok(Self { decisions, seeds, imported, set, ended: None, cut_short: 0 })
    }

    /// Whether everything is as it was: then control walks and their frames are replayed too. They decide nothing, and
    /// other rules would give others.
    pub fn is_exact(&self) -> bool {
        self.set.is_empty()
    }

    /// To examine candidates ahead of [`Self::apply`].
    pub fn regrader(&self) -> &Regrader {
        &self.decisions.regrader
    }

    /// The mixture in force.
    pub fn mixture(&self) -> &Arc<Mixture> {
        &self.decisions.mixture
    }

    /// Walks that a budget or their seed structure's limit ended, and that these rules would have let go on.
    pub fn cut_short(&self) -> u64 {
        self.cut_short
    }

    /// Whether by these rules it would come to a decision about a candidate at all.
    pub fn is_reached(&self, recorded: &LoggedDecision) -> Result<bool, ReplayError> {
        Ok(self.walk_under_way(recorded)?.is_some())
    }

    /// Goes on by one decision of the log, which have to come in order; a decision about a candidate comes with it. Nothing
    /// comes of it if by these rules it would not have come to it: the walk was over.
    pub fn apply(
        &mut self,
        recorded: &LoggedDecision,
        candidate: Option<RegradedCandidate>,
    ) -> Result<Option<ReplayedDecision>, ReplayError> {
        self.decisions.round = recorded.round;
        let ended = self.ended.take();
        let decision = match recorded.kind.as_str() {
            "accepted" | "declined" | "control" => return self.candidate(recorded, candidate),
            "imported" => Some(self.import(recorded)?),
            CONFIGURATION => Some(self.change_rules(recorded)?),
            "begun" => self.begin(recorded)?,
            "resumed" => self.resume(recorded)?,
            "segment" => self.segment(recorded)?,
            "ended" => match ended {
                Some(ended) if ended.walk.map(|walk| walk.0) == recorded.walk => Some(ended),
                _ => self.end(recorded)?,
            },
            _ => return Err(damaged(recorded, "a kind that this version does not know")),
        };
        Ok(decision.map(|decision| ReplayedDecision { decision, candidate: None }))
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
        let walk = self.decisions.walk_mut(id);
        walk.record.progress.step = step;
        let (mut commit, biased) = (Commit::default(), walk.is_biased());
        let decided = match biased {
            true => self.decisions.decide_candidate(id, regraded, &mut commit),
            false => self.decisions.keep_control_frame(id, regraded, &mut commit),
        };
        decided.map_err(|source| ReplayError::Selector {
            sequence: recorded.sequence,
            source: Box::new(source),
        })?;
        let mut decisions = commit.decisions.into_iter();
        let decision = decisions.next();
        self.ended = decisions.next();
        let candidate = commit.candidates.pop();
        Ok(decision.map(|decision| ReplayedDecision { decision, candidate }))
    }

    fn import(&mut self, recorded: &LoggedDecision) -> Result<Decision, ReplayError> {
        #[derive(Deserialize)]
        struct Detail {
            structures: usize,
        }
        let Detail { structures } = read(recorded)?;
        let known = self.imported.get(..structures);
        let known = known.ok_or_else(|| {
            damaged(
                recorded,
                &format!("{structures} imported structures, but {} are there", self.imported.len()),
            )
        })?;
        self.decisions.known.extend(known);
        Ok(self.decisions.campaign_decision("imported", recorded.detail.clone()))
    }

    /// Takes the rules that the campaign went on by, but for those that are set.
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
        enum Detail {
            Biased { seed_structure: String },
            Control { control_of: WalkId },
        }
        // Control walks are left out where rules are others, but the numbers stay those of the log.
        let id = if self.is_exact() { self.decisions.next_walk_id() } else { walk(recorded)? };
        match read(recorded)? {
            Detail::Biased { seed_structure: name } => {
                let seed = self.seeds.iter().position(|seed| seed.name == name);
                let seed =
                    seed.ok_or_else(|| damaged(recorded, &format!("there is no seed structure '{name}'")))?;
                Ok(Some(self.decisions.start_walk(id, seed, &name)))
            }
            Detail::Control { control_of } if self.is_exact() => {
                let is_there = self.decisions.walks.contains_key(&control_of);
                Ok(is_there.then(|| self.decisions.start_control(id, control_of)))
            }
            Detail::Control { .. } => Ok(None),
        }
    }

    /// A walk that has ended for good by these rules stays ended.
    fn resume(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        let id = walk(recorded)?;
        let goes_on = self.decisions.walks.contains_key(&id) && self.decisions.can_resume(id);
        Ok(goes_on.then(|| self.decisions.resume(id)))
    }

    /// A return to a checkpoint is what the walker said.
    fn segment(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        let id = self.walk_under_way(recorded)?;
        Ok(id.map(|id| self.decisions.decision("segment", id, recorded.detail.clone())))
    }

    fn end(&mut self, recorded: &LoggedDecision) -> Result<Option<Decision>, ReplayError> {
        #[derive(Deserialize)]
        struct Detail {
            end: String,
            reason: String,
            step: u64,
        }
        let Some(id) = self.walk_under_way(recorded)? else { return Ok(None) };
        let Detail { end, reason, step } = read(recorded)?;
        let collected = end == WalkEnd::Collected.name();
        if collected && self.is_exact() {
            // That would have been the judge's own word.
            return Ok(None);
        }
        let budget = end == WalkEnd::Budget.name() && !self.decisions.is_budget_exhausted();
        self.cut_short += u64::from(collected || budget);
        self.decisions.walk_mut(id).record.progress.step = step;
        let mut commit = Commit::default();
        self.decisions.end_walk_as(id, &end, reason, &mut commit);
        Ok(commit.decisions.pop())
    }

    /// The walk of a decision, if it is there and not over.
    fn walk_under_way(&self, recorded: &LoggedDecision) -> Result<Option<WalkId>, ReplayError> {
        let id = walk(recorded)?;
        Ok(self.decisions.walks.get(&id).filter(|walk| !walk.has_ended()).map(|_| id))
    }

    /// The first place (element index, slot) at which the mixture is not, byte for byte, what the store has of it.
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

fn damaged(recorded: &LoggedDecision, problem: &str) -> ReplayError {
    let LoggedDecision { sequence, kind, .. } = recorded;
    ReplayError::Damaged { sequence: *sequence, kind: kind.clone(), problem: problem.to_owned() }
}

fn walk(recorded: &LoggedDecision) -> Result<WalkId, ReplayError> {
    recorded.walk.map(WalkId).ok_or_else(|| damaged(recorded, "it is about no walk"))
}

fn read<T: DeserializeOwned>(recorded: &LoggedDecision) -> Result<T, ReplayError> {
    T::deserialize(&recorded.detail).map_err(|error| damaged(recorded, &error.to_string()))
}
