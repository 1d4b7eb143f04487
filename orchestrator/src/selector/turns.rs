//! Which walk goes next.

use store::records::{Commit, Decision};
use wire::WalkId;
use wire::messages::Assignment;

use super::walk::Walk;
use super::{Mode, Selector};

/// What a free walker is to do.
#[derive(Debug)]
pub enum Next {
    /// This turn, under the mixture of [`Selector::mixture`].
    Turn(Box<Assignment>),
    /// Nothing now: turns are out whose reports decide what comes next.
    Wait,
    /// Nothing any more.
    Done,
}

impl Selector {
    /// Makes a walk for every seed structure that has none: at the start of a campaign, or when seed structures were
    /// added to it. Walks that had ended by a budget which has grown since go on. The commit is empty if there was
    /// nothing to do.
    pub fn begin_walks(&mut self) -> Commit {
        let mut commit = Commit::default();
        if self.imported.0 != self.imported.1 {
            // From here on candidates can be duplicates of them.
            let detail = serde_json::json!({ "structures": self.imported.0 });
            commit.decisions.push(Decision { walk: None, ..self.decision("imported", WalkId(0), detail) });
            self.imported.1 = self.imported.0;
        }
        self.resume_walks(&mut commit);
        let begun = self.walks.values().filter(|walk| walk.is_biased()).count();
        for seed in begun..self.seeds.len() {
            let id = self.next_walk_id();
            let walk = Walk::new(id, seed as u32, self.settings.turn_steps);
            let detail = serde_json::json!({ "seed_structure": self.seeds[seed].name });
            commit.decisions.push(self.decision("begun", id, detail));
            commit.walks.push(walk.to_record());
            self.walks.insert(id, walk);
        }
        self.seal(&mut commit);
        commit
    }

    fn resume_walks(&mut self, commit: &mut Commit) {
        if self.is_used_up() {
            return;
        }
        let (mut resumed, per_seed) = (Vec::new(), self.settings.per_seed);
        for walk in self.walks.values_mut() {
            if walk.ended_by_budget() && walk.record.accepted < per_seed {
                walk.record.state = "waiting".to_owned();
                commit.walks.push(walk.to_record());
                resumed.push(walk.record.walk);
            }
        }
        let resumed = resumed.into_iter().map(|id| self.decision("resumed", id, serde_json::json!({})));
        commit.decisions.extend(resumed);
    }

    /// Whether the campaign has as many structures as it may have.
    pub(super) fn is_used_up(&self) -> bool {
        self.settings.total.is_some_and(|total| self.accepted >= total)
    }

    pub(super) fn next_walk_id(&self) -> WalkId {
        WalkId(self.walks.len() as u32)
    }

    /// The next turn for a free walker.
    pub fn next_turn(&mut self) -> Next {
        if self.settings.mode == Mode::Reproducible && self.in_round.is_empty() {
            self.begin_round();
        }
        let ready = |(id, walk): (&WalkId, &Walk)| {
            let in_turn = match self.settings.mode {
                Mode::Live => !walk.has_ended(),
                Mode::Reproducible => self.in_round.get(id).is_some_and(Option::is_none),
            };
            (in_turn && !walk.out).then_some(*id)
        };
        if let Some(id) = self.walks.iter().find_map(ready) {
            return Next::Turn(Box::new(self.assign(id)));
        }
        if self.is_done() { Next::Done } else { Next::Wait }
    }

    /// Whether every walk is over.
    pub fn is_done(&self) -> bool {
        self.walks.values().all(Walk::has_ended)
    }

    /// A walker was lost with its turn: the turn is given out again.
    pub fn lost(&mut self, id: WalkId) {
        if let Some(walk) = self.walks.get_mut(&id) {
            walk.out = false;
        }
    }

    /// A round takes the first unfinished biased walks, and as many control walks beside them.
    fn begin_round(&mut self) {
        for biased in [true, false] {
            let unfinished =
                self.walks.values().filter(|walk| !walk.has_ended() && walk.is_biased() == biased);
            let taken = unfinished.take(self.settings.walks_per_round).map(|walk| (walk.record.walk, None));
            self.in_round.extend(taken);
        }
        if !self.in_round.is_empty() {
            self.round += 1;
        }
    }

    fn assign(&mut self, id: WalkId) -> Assignment {
        let walk = self.walks.get_mut(&id).expect("the caller took the id from the table");
        walk.out = true;
        walk.record.state = "running".to_owned();
        Assignment {
            campaign: self.campaign,
            walk: id,
            turn: walk.record.turn,
            origin: walk.record.origin,
            random_walk: walk.record.partner.unwrap_or(id),
            seed_structure: self.seeds[walk.record.seed_structure as usize].structure.clone(),
            checkpoint: walk.record.checkpoint.clone(),
            verdict: walk.memory.verdict.clone(),
            until: walk.memory.until,
            wanted: walk.memory.wanted.clone(),
        }
    }
}
