//! What the selector records at the start of each run: changes since the last run, and new walks.

use serde_json::json;
use store::records::{Commit, Decision};
use wire::{WalkConditions, WalkId};

use super::SeedStructurePlan;
use super::decision_state::DecisionState;
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
        self.resume_walks(&mut commit);
        let begun = self.walks.iter().filter(|walk| walk.is_biased()).count();
        for (seed, SeedStructurePlan { name, .. }, conditions) in planned_walks(seed_structures).skip(begun) {
            let id = self.next_walk_id();
            commit.decisions.push(self.start_walk(id, seed, name, conditions.clone()));
            commit.walks.push(self.walks[id].to_record());
        }
        self.add_values(&mut commit);
        commit
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
        let detail = json!({ "seed_structure": name, "conditions": conditions });
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

    /// Whether a walk ended only because of a limit that is no longer reached.
    pub fn can_resume(&self, id: WalkId) -> bool {
        let walk = &self.walks[id];
        !self.is_budget_exhausted() && walk.ended_by_budget() && !self.has_collected_enough(walk)
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
