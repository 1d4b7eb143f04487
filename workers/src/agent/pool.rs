//! Who has which turn in hand. No line, no clock.

use std::collections::{BTreeMap, VecDeque};

use tokio::sync::oneshot;
use wire::WalkId;
use wire::messages::Report;
use wire::net::{Slot, Told};
use wire::transport::Work;

/// The turns and walkers of a host. `S` is a slot: the place of a turn at the orchestrator.
#[derive(Debug)]
pub(super) struct AssignmentPool<S = Slot> {
    /// Turns that no walker has begun.
    ready: VecDeque<(S, Work)>,
    /// Walkers that wait for one, in the order in which they came.
    waiting: VecDeque<(u32, oneshot::Sender<Option<Work>>)>,
    /// What each of the others works on.
    assigned: BTreeMap<u32, (Option<S>, WalkId)>,
    /// Reports whose slots are gone.
    unsent: VecDeque<Report>,
    /// Slots for which there may be work.
    open_slots: usize,
}

impl<S> Default for AssignmentPool<S> {
    fn default() -> Self {
        let (ready, waiting, unsent) = (VecDeque::new(), VecDeque::new(), VecDeque::new());
        Self { ready, waiting, assigned: BTreeMap::new(), unsent, open_slots: 0 }
    }
}

impl<S> AssignmentPool<S> {
    /// Begins with these slots, or goes on with them in place of others: what is to be told first. Turns that a walker has
    /// in hand keep a slot; those that nobody has begun are given up.
    pub(super) fn start(&mut self, slots: Vec<S>) -> Vec<(S, Told)> {
        self.open_slots = slots.len();
        self.ready.clear();
        let mut slots = slots.into_iter();
        for (slot, _) in self.assigned.values_mut() {
            *slot = slots.next();
        }
        slots.map(|slot| (slot, self.unsent.pop_front().map_or(Told::Nothing, Told::Report))).collect()
    }

    /// A walker is free: what came of its turn is to be told, and it waits for another.
    pub(super) fn walker_idle(
        &mut self,
        walker: u32,
        report: Option<Report>,
        reply: oneshot::Sender<Option<Work>>,
    ) -> Option<(S, Told)> {
        let slot = self.assigned.remove(&walker).and_then(|(slot, _)| slot);
        self.waiting.push_back((walker, reply));
        self.dispatch();
        match (slot, report) {
            (Some(slot), Some(report)) => Some((slot, Told::Report(report))),
            (Some(slot), None) => Some((slot, Told::Lost { fault: false })),
            (None, report) => {
                self.unsent.extend(report);
                None
            }
        }
    }

    /// A walker is no more: if it had a turn in hand, that is to be told.
    pub(super) fn walker_lost(&mut self, walker: u32, fault: bool) -> Option<(S, Told)> {
        let (slot, _) = self.assigned.remove(&walker)?;
        Some((slot?, Told::Lost { fault }))
    }

    /// A turn has come.
    pub(super) fn assign(&mut self, slot: S, work: Work) {
        self.ready.push_back((slot, work));
        self.dispatch();
    }

    /// There is no more work for a slot.
    pub(super) fn slot_closed(&mut self) {
        self.open_slots = self.open_slots.saturating_sub(1);
    }

    /// Keeps what could not be told.
    pub(super) fn keep_unsent(&mut self, told: Told) {
        if let Told::Report(report) = told {
            self.unsent.push_back(report);
        }
    }

    /// The slot of the walk's turn that a walker has in hand.
    pub(super) fn slot_of(&self, walk: WalkId) -> Option<&S> {
        self.assigned.values().find(|(_, of)| *of == walk).and_then(|(slot, _)| slot.as_ref())
    }

    /// Sends those home who wait.
    pub(super) fn dismiss_idle(&mut self) {
        for (_, reply) in self.waiting.drain(..) {
            // A walker that is gone already needs no answer.
            let _ = reply.send(None);
        }
    }

    /// Reports that nobody takes for the time being.
    pub(super) fn unsent(&self) -> usize {
        self.unsent.len()
    }

    /// Walkers that wait for a turn.
    pub(super) fn idle(&self) -> usize {
        self.waiting.len()
    }

    /// Whether no walker has a turn in hand.
    pub(super) fn is_idle(&self) -> bool {
        self.assigned.is_empty()
    }

    /// Whether nothing is left to be done.
    pub(super) fn is_over(&self) -> bool {
        self.open_slots == 0 && self.assigned.is_empty()
    }

    /// Gives turns to walkers as far as there are both.
    fn dispatch(&mut self) {
        while let Some((slot, work)) = self.ready.pop_front() {
            let Some((walker, reply)) = self.waiting.pop_front() else {
                self.ready.push_front((slot, work));
                return;
            };
            let walk = work.assignment.walk;
            match reply.send(Some(work)) {
                Ok(()) => drop(self.assigned.insert(walker, (Some(slot), walk))),
                // This walker is gone; the next one gets it.
                Err(Some(work)) => self.ready.push_front((slot, work)),
                Err(None) => {}
            }
        }
    }
}
