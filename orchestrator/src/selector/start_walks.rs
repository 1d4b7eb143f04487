//! What the selector records at the start of each run: changes since the last run, and new walks.

use std::sync::Arc;

use serde_json::json;
use store::records::{Commit, Decision, TRAINING_FRAMES};
use wire::messages::WalkEnd;
use wire::{WalkConditions, WalkId};

use super::SeedStructurePlan;
use super::decision_state::{ADDITIVE, DecisionState, VERSION};
use super::rules::{CONFIGURATION, RULES};
use super::walk::Walk;

impl DecisionState {
    /// See [`super::Selector::start_walks`].
    pub fn start_walks(&mut self, seed_structures: &[SeedStructurePlan]) -> Commit {
        let mut commit = Commit::default();
        if self.imported.0 != self.imported.1 {
            // From here on, candidates can be duplicates of them.
            commit
                .decisions
                .push(self.campaign_decision("imported", json!({ "structures": self.imported.0 })));
            self.imported.1 = self.imported.0;
        }
        self.log_rule_changes(&mut commit);
        self.take_up_version(&mut commit);
        self.resume_walks(&mut commit);
        // Walks that would end at once wait until the limit is raised, or for the next version.
        if self.end_of_all_walks().is_none() {
            self.start_planned_walks(seed_structures, &mut commit);
        }
        self.add_values(&mut commit);
        commit
    }

    /// Starts the walks of the plan that have not begun with the version in force.
    fn start_planned_walks(&mut self, seed_structures: &[SeedStructurePlan], commit: &mut Commit) {
        let version = self.version;
        let is_of_version = |walk: &&Walk| walk.is_biased() && walk.record.conditions.version == version;
        let begun = self.walks.iter().filter(is_of_version).count();
        for (seed, SeedStructurePlan { name, .. }, conditions) in planned_walks(seed_structures).skip(begun) {
            let id = self.next_walk_id();
            let conditions = WalkConditions { version, ..conditions.clone() };
            commit.decisions.push(self.start_walk(id, seed, name, conditions));
            commit.walks.push(self.walks[id].to_record());
        }
    }

    /// Takes up the version of the potential in force, unless the log has it already: walks of earlier versions end, and the
    /// mixture is that of the version.
    pub fn take_up_version(&mut self, commit: &mut Commit) {
        let next = self.settings.version.clone();
        if self.version == next.version {
            return;
        }
        let left: Vec<_> =
            [true, false].into_iter().flat_map(|biased| self.walks.unfinished(biased)).collect();
        for id in left {
            self.end_walk(id, &WalkEnd::Superseded, commit);
            commit.walks.push(self.walks[id].to_record());
        }
        self.version = next.version;
        self.steps_without_structure = 0;
        self.mixture = Arc::new(self.regrader.original.at_version(self.mixture.version() + 1));
        commit.components.clear();
        commit.restart_mixture = true;
        self.forgetting.restart();
        self.accepted_by_seed_structure.clear();
        self.full_seed_structures.clear();
        if std::mem::take(&mut self.switched_to_additive) {
            commit.values.push((ADDITIVE.to_owned(), "0".to_owned()));
        }
        commit.values.push((TRAINING_FRAMES.to_owned(), self.forgetting_state().to_json().to_string()));
        commit.decisions.push(self.campaign_decision(VERSION, json!(next)));
    }

    /// Records the rules if they differ from those in the log. A campaign starts with the rules of its configuration.
    fn log_rule_changes(&mut self, commit: &mut Commit) {
        let rules = self.settings.changeable_rules();
        if self.rules.as_ref() == Some(&rules) {
            return;
        }
        if self.walks.len() > 0 {
            commit.decisions.push(self.campaign_decision(CONFIGURATION, json!(rules)));
        }
        commit.values.push((RULES.to_owned(), json!(rules).to_string()));
        self.rules = Some(rules);
    }

    /// A decision about no particular walk.
    pub fn campaign_decision(&self, kind: &'static str, detail: serde_json::Value) -> Decision {
        Decision { walk: None, ..self.decision(kind, WalkId(0), detail) }
    }

    /// Creates a biased walk of the seed structure with this name.
    pub fn start_walk(
        &mut self,
        id: WalkId,
        seed: usize,
        name: &str,
        conditions: WalkConditions,
    ) -> Decision {
        let mut detail = json!({ "seed_structure": name, "conditions": conditions });
        // Earlier versions of calmwalk did not test it: what the log has is what held.
        if let Some(bound) = self.settings.max_grade {
            detail["max_grade"] = bound.into();
        }
        self.walks.insert(Walk::new(id, seed as u32, conditions, self.settings.steps_per_assignment));
        self.decision("begun", id, detail)
    }

    fn resume_walks(&mut self, commit: &mut Commit) {
        let all = self.walks.iter().map(|walk| walk.record.walk);
        let ended: Vec<_> = all.filter(|id| self.can_resume(*id)).collect();
        for id in ended {
            commit.decisions.push(self.resume(id));
            commit.walks.push(self.walks[id].to_record());
        }
    }

    /// Whether a walk of the version in force ended only because of a limit that is no longer reached, or for a new version that
    /// was refused.
    pub fn can_resume(&self, id: WalkId) -> bool {
        let walk = &self.walks[id];
        let may_go_on = walk.was_superseded() || walk.ended_by_budget();
        let is_in_force = walk.record.conditions.version == self.version;
        may_go_on && is_in_force && self.end_of_all_walks().is_none() && !self.has_collected_enough(walk)
    }

    /// How all biased walks of the version in force have to end now, if they have to.
    pub fn end_of_all_walks(&self) -> Option<WalkEnd> {
        if self.is_budget_exhausted() {
            Some(WalkEnd::Budget)
        } else if self.is_refit_due() {
            Some(WalkEnd::Superseded)
        } else {
            self.finds_nothing_new().then_some(WalkEnd::NothingNew)
        }
    }

    /// Whether biased walks make room for a new version of the potential.
    fn is_refit_due(&self) -> bool {
        self.settings.refit_at.is_some_and(|structures| self.accepted >= structures)
    }

    /// Whether a walk, or all walks of its seed structure together, have their maximum number of structures.
    pub fn has_collected_enough(&self, walk: &Walk) -> bool {
        let of_seed = self.accepted_by_seed_structure.get(&walk.record.seed_structure).copied().unwrap_or(0);
        walk.record.accepted >= self.settings.max_per_walk
            || self.settings.max_per_seed_structure.is_some_and(|most| of_seed >= most)
    }

    /// Resumes a walk that has ended.
    pub fn resume(&mut self, id: WalkId) -> Decision {
        self.walks.resume(id);
        self.decision("resumed", id, json!({}))
    }

    /// Whether the campaign has its maximum number of structures.
    pub fn is_budget_exhausted(&self) -> bool {
        self.settings.max_structures.is_some_and(|total| self.accepted >= total)
    }

    /// Whether the biased walks have made their maximum number of steps without a new structure.
    pub fn finds_nothing_new(&self) -> bool {
        self.settings.max_steps_without_structure.is_some_and(|most| self.steps_without_structure >= most)
    }

    pub fn next_walk_id(&self) -> WalkId {
        WalkId(self.walks.len() as u32)
    }
}

/// The biased walks of a campaign, in order: those of the first seed structure, then those of the next.
fn planned_walks(
    seed_structures: &[SeedStructurePlan],
) -> impl Iterator<Item = (usize, &SeedStructurePlan, &WalkConditions)> {
    let with_conditions = |(index, seed)| move |conditions| (index, seed, conditions);
    seed_structures
        .iter()
        .enumerate()
        .flat_map(move |(index, seed)| seed.walks.iter().map(with_conditions((index, seed))))
}
