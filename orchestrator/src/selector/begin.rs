//! What is said once at the start of each run: what has changed since the last, and which walks there are.

use serde_json::json;
use store::records::{Commit, Decision};
use wire::WalkId;

use super::SeedStructure;
use super::judge::Judge;
use super::rules::{CONFIGURATION, RULES};
use super::walk::Walk;

impl Judge {
    /// See [`super::Selector::begin_walks`].
    pub fn begin(&mut self, seeds: &[SeedStructure]) -> Commit {
        let mut commit = Commit::default();
        if self.imported.0 != self.imported.1 {
            // From here on candidates can be duplicates of them.
            commit.decisions.push(self.of_campaign("imported", json!({ "structures": self.imported.0 })));
            self.imported.1 = self.imported.0;
        }
        self.say_rules(&mut commit);
        self.resume_walks(&mut commit);
        let begun = self.walks.values().filter(|walk| walk.is_biased()).count();
        for (seed, SeedStructure { name, .. }) in seeds.iter().enumerate().skip(begun) {
            let id = self.next_walk_id();
            commit.decisions.push(self.begin_walk(id, seed, name));
            commit.walks.push(self.walks[&id].to_record());
        }
        self.seal(&mut commit);
        commit
    }

    /// Says by which rules it goes on, if the log does not know. A campaign begins by those of its configuration.
    fn say_rules(&mut self, commit: &mut Commit) {
        let rules = self.settings.changeable();
        if self.rules.as_ref() == Some(&rules) {
            return;
        }
        if !self.walks.is_empty() {
            commit.decisions.push(self.of_campaign(CONFIGURATION, json!(rules)));
        }
        commit.values.push((RULES.to_owned(), json!(rules).to_string()));
        self.rules = Some(rules);
    }

    /// A decision that is about no walk.
    pub fn of_campaign(&self, kind: &'static str, detail: serde_json::Value) -> Decision {
        Decision { walk: None, ..self.decision(kind, WalkId(0), detail) }
    }

    /// Begins the biased walk of a seed structure, which has that name.
    pub fn begin_walk(&mut self, id: WalkId, seed: usize, name: &str) -> Decision {
        self.walks.insert(id, Walk::new(id, seed as u32, self.settings.turn_steps));
        self.decision("begun", id, json!({ "seed_structure": name }))
    }

    fn resume_walks(&mut self, commit: &mut Commit) {
        let ended: Vec<_> = self.walks.keys().copied().filter(|id| self.may_go_on(*id)).collect();
        for id in ended {
            commit.decisions.push(self.resume(id));
            commit.walks.push(self.walks[&id].to_record());
        }
    }

    /// Whether a walk has ended by a budget only, which is not used up any more.
    pub fn may_go_on(&self, id: WalkId) -> bool {
        let walk = &self.walks[&id];
        !self.is_used_up() && walk.ended_by_budget() && walk.record.accepted < self.settings.per_seed
    }

    /// Lets a walk go on that has ended.
    pub fn resume(&mut self, id: WalkId) -> Decision {
        self.walk_mut(id).record.state = "waiting".to_owned();
        self.decision("resumed", id, json!({}))
    }

    /// Whether the campaign has as many structures as it may have.
    pub fn is_used_up(&self) -> bool {
        self.settings.total.is_some_and(|total| self.accepted >= total)
    }

    pub fn next_walk_id(&self) -> WalkId {
        WalkId(self.walks.len() as u32)
    }
}
