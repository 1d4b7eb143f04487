//! Choice of the next walk.

use wire::WalkId;
use wire::messages::Assignment;

use super::{CampaignMode, Selector};

/// What an idle walker does next.
#[derive(Debug)]
pub enum Scheduling {
    /// Works on this assignment, with the mixture of [`Selector::mixture`].
    Assign(Box<Assignment>),
    /// Waits: reports that determine the next assignment are outstanding, or walks are paused.
    Wait,
    /// Exits: there is no more work.
    Done,
}

impl Selector {
    /// The next assignment for an idle walker, which is busy from then on.
    pub fn next_assignment(&mut self, walker: u32) -> Scheduling {
        if self.decisions.settings.mode == CampaignMode::Reproducible && self.outstanding.is_empty() {
            self.start_round();
        }
        match self.next_walk() {
            Some(id) => Scheduling::Assign(Box::new(self.assign(id, walker))),
            None if self.is_done() => Scheduling::Done,
            None => Scheduling::Wait,
        }
    }

    /// The first walk that is ready. In live mode, control walks get their share of the assignments while biased walks
    /// are ready, too.
    fn next_walk(&self) -> Option<WalkId> {
        let [biased, control] = self.ready.each_ref().map(|walks| walks.first().copied());
        let (Some(biased), Some(control)) = (biased, control) else { return biased.or(control) };
        Some(match self.decisions.settings.mode {
            // A round has as many control walks as biased ones.
            CampaignMode::Reproducible => biased.min(control),
            CampaignMode::Live if self.is_turn_of_controls() => control,
            CampaignMode::Live => biased,
        })
    }

    /// Finds out again whether these walks can be assigned. Called for every walk that was begun, resumed, ended, paused,
    /// assigned, reported on, lost, or taken into a round, so that no assignment needs a look at all walks.
    pub(super) fn update_ready(&mut self, walks: impl IntoIterator<Item = WalkId>) {
        for id in walks {
            let Some(walk) = self.decisions.walks.get(id) else { continue };
            let is_due = match self.decisions.settings.mode {
                CampaignMode::Reproducible => self.outstanding.contains(&id),
                CampaignMode::Live => !walk.has_ended(),
            };
            let ready = &mut self.ready[usize::from(!walk.is_biased())];
            if is_due && !self.assigned.contains_key(&id) && !self.paused.contains(&id) {
                ready.insert(id);
            } else {
                ready.remove(&id);
            }
        }
    }

    /// Whether the next assignment is one of the share of control walks. It follows from the number of assignments so
    /// far, and is the same after a restart.
    fn is_turn_of_controls(&self) -> bool {
        let number = (self.decisions.walks.reported() + self.assigned.len() as u64) as f64;
        let share = self.decisions.settings.control_share;
        ((number + 1.0) * share).floor() > (number * share).floor()
    }

    /// Whether every walk has ended.
    pub fn is_done(&self) -> bool {
        self.decisions.walks.have_all_ended()
    }

    /// Whether a walker runs this walk.
    pub fn is_assigned(&self, id: WalkId) -> bool {
        self.assigned.contains_key(&id)
    }

    /// Number of walks that walkers run.
    pub fn assignments(&self) -> usize {
        self.assigned.len()
    }

    /// The walk that this walker runs.
    pub fn walk_of(&self, walker: u32) -> Option<WalkId> {
        self.assigned.iter().find_map(|(id, holder)| (*holder == walker).then_some(*id))
    }

    /// Takes back a walk from a walker that will not report on it; another walker gets it.
    pub fn assignment_lost(&mut self, id: WalkId) {
        self.assigned.remove(&id);
        self.update_ready([id]);
    }

    /// Starts a round with the first unfinished biased walks and as many control walks.
    fn start_round(&mut self) {
        for biased in [true, false] {
            let unfinished = self.decisions.walks.unfinished(biased);
            let taken = unfinished.take(self.decisions.settings.walks_per_round);
            self.outstanding.extend(taken);
        }
        if !self.outstanding.is_empty() {
            self.decisions.round += 1;
        }
        let round: Vec<WalkId> = self.outstanding.iter().copied().collect();
        self.update_ready(round);
    }

    fn assign(&mut self, id: WalkId, walker: u32) -> Assignment {
        self.assigned.insert(id, walker);
        self.update_ready([id]);
        let walk = self.decisions.walks.get_mut(id);
        walk.record.state = "running".to_owned();
        Assignment {
            campaign: self.campaign,
            walk: id,
            number: walk.record.assignments,
            origin: walk.record.origin,
            random_walk: walk.record.partner.unwrap_or(id),
            seed_structure: self.seed_structures[walk.record.seed_structure as usize].structure.clone(),
            conditions: walk.record.conditions.clone(),
            checkpoint: walk.record.checkpoint.clone(),
            verdict: walk.state.verdict.clone(),
            last_step: walk.state.until,
            frame_steps: walk.state.wanted.clone(),
            threshold_factor: self.decisions.threshold_factor,
        }
    }
}
