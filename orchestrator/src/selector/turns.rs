//! Which walk goes next.

use wire::WalkId;
use wire::messages::Assignment;

use super::walk::Walk;
use super::{Mode, Selector};

/// What a free walker is to do.
#[derive(Debug)]
pub enum Next {
    /// This turn, under the mixture of [`Selector::mixture`].
    Turn(Box<Assignment>),
    /// Nothing now: turns are out whose reports decide what comes next, or walks are paused.
    Wait,
    /// Nothing any more.
    Done,
}

impl Selector {
    /// The next turn for a free walker.
    pub fn next_turn(&mut self) -> Next {
        if self.judge.settings.mode == Mode::Reproducible && self.in_round.is_empty() {
            self.begin_round();
        }
        let ready = |(id, walk): (&WalkId, &Walk)| {
            let in_turn = match self.judge.settings.mode {
                Mode::Live => !walk.has_ended(),
                Mode::Reproducible => self.in_round.get(id).is_some_and(Option::is_none),
            };
            (in_turn && !walk.out && !self.paused.contains(id)).then_some(*id)
        };
        if let Some(id) = self.judge.walks.iter().find_map(ready) {
            return Next::Turn(Box::new(self.assign(id)));
        }
        if self.is_done() { Next::Done } else { Next::Wait }
    }

    /// Whether every walk is over.
    pub fn is_done(&self) -> bool {
        self.judge.walks.values().all(Walk::has_ended)
    }

    /// A walker was lost with its turn: the turn is given out again.
    pub fn lost(&mut self, id: WalkId) {
        if let Some(walk) = self.judge.walks.get_mut(&id) {
            walk.out = false;
        }
    }

    /// A round takes the first unfinished biased walks, and as many control walks beside them.
    fn begin_round(&mut self) {
        for biased in [true, false] {
            let unfinished =
                self.judge.walks.values().filter(|walk| !walk.has_ended() && walk.is_biased() == biased);
            let taken =
                unfinished.take(self.judge.settings.walks_per_round).map(|walk| (walk.record.walk, None));
            self.in_round.extend(taken);
        }
        if !self.in_round.is_empty() {
            self.judge.round += 1;
        }
    }

    fn assign(&mut self, id: WalkId) -> Assignment {
        let walk = self.judge.walks.get_mut(&id).expect("the caller took the id from the table");
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
            raised: self.judge.raised,
        }
    }
}
