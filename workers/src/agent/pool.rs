//! Who has which turn in hand. No line, no clock.

use std::collections::{BTreeMap, VecDeque};

use tokio::sync::oneshot;
use wire::WalkId;
use wire::messages::Report;
use wire::net::{Slot, SlotReport};
use wire::transport::WorkItem;

/// The turns and walkers of a host. `S` is a slot: the place of a turn at the orchestrator.
#[derive(Debug)]
pub(super) struct Pool<S = Slot> {
    /// Turns that no walker has begun.
    ready: VecDeque<(S, WorkItem)>,
    /// Walkers that wait for one, in the order in which they came.
    waiting: VecDeque<(u32, oneshot::Sender<Option<WorkItem>>)>,
    /// What each of the others works on.
    in_hand: BTreeMap<u32, (Option<S>, WalkId)>,
    /// Reports whose slots are gone.
    untold: VecDeque<Report>,
    /// Slots for which there may be work.
    open: usize,
}

impl<S> Default for Pool<S> {
    fn default() -> Self {
        let (ready, waiting, untold) = (VecDeque::new(), VecDeque::new(), VecDeque::new());
        Self { ready, waiting, in_hand: BTreeMap::new(), untold, open: 0 }
    }
}

impl<S> Pool<S> {
    /// Begins with these slots, or goes on with them in place of others: what is to be told first. Turns that a walker has
    /// in hand keep a slot; those that nobody has begun are given up.
    pub(super) fn begin(&mut self, slots: Vec<S>) -> Vec<(S, SlotReport)> {
        self.open = slots.len();
        self.ready.clear();
        let mut slots = slots.into_iter();
        for (slot, _) in self.in_hand.values_mut() {
            *slot = slots.next();
        }
        slots
            .map(|slot| (slot, self.untold.pop_front().map_or(SlotReport::Empty, SlotReport::Report)))
            .collect()
    }

    /// A walker is free: what came of its turn is to be told, and it waits for another.
    pub(super) fn free(
        &mut self,
        walker: u32,
        report: Option<Report>,
        reply: oneshot::Sender<Option<WorkItem>>,
    ) -> Option<(S, SlotReport)> {
        let slot = self.in_hand.remove(&walker).and_then(|(slot, _)| slot);
        self.waiting.push_back((walker, reply));
        self.deal();
        match (slot, report) {
            (Some(slot), Some(report)) => Some((slot, SlotReport::Report(report))),
            (Some(slot), None) => Some((slot, SlotReport::Lost { crashed: false })),
            (None, report) => {
                self.untold.extend(report);
                None
            }
        }
    }

    /// A walker is no more: if it had a turn in hand, that is to be told.
    pub(super) fn gone(&mut self, walker: u32, crashed: bool) -> Option<(S, SlotReport)> {
        let (slot, _) = self.in_hand.remove(&walker)?;
        Some((slot?, SlotReport::Lost { crashed }))
    }

    /// A turn has come.
    pub(super) fn turn(&mut self, slot: S, work: WorkItem) {
        self.ready.push_back((slot, work));
        self.deal();
    }

    /// There is no more work for a slot.
    pub(super) fn sent_home(&mut self) {
        self.open = self.open.saturating_sub(1);
    }

    /// Keeps what could not be told.
    pub(super) fn keep(&mut self, told: SlotReport) {
        if let SlotReport::Report(report) = told {
            self.untold.push_back(report);
        }
    }

    /// The slot of the walk's turn that a walker has in hand.
    pub(super) fn slot_of(&self, walk: WalkId) -> Option<&S> {
        self.in_hand.values().find(|(_, of)| *of == walk).and_then(|(slot, _)| slot.as_ref())
    }

    /// Sends those home who wait.
    pub(super) fn send_home(&mut self) {
        for (_, reply) in self.waiting.drain(..) {
            // A walker that is gone already needs no answer.
            let _ = reply.send(None);
        }
    }

    /// Reports that nobody takes for the time being.
    pub(super) fn untold(&self) -> usize {
        self.untold.len()
    }

    /// Walkers that wait for a turn.
    pub(super) fn idle(&self) -> usize {
        self.waiting.len()
    }

    /// Whether no walker has a turn in hand.
    pub(super) fn is_idle(&self) -> bool {
        self.in_hand.is_empty()
    }

    /// Whether nothing is left to be done.
    pub(super) fn is_over(&self) -> bool {
        self.open == 0 && self.in_hand.is_empty()
    }

    /// Gives turns to walkers as far as there are both.
    fn deal(&mut self) {
        while let Some((slot, work)) = self.ready.pop_front() {
            let Some((walker, reply)) = self.waiting.pop_front() else {
                self.ready.push_front((slot, work));
                return;
            };
            let walk = work.assignment.walk;
            match reply.send(Some(work)) {
                Ok(()) => drop(self.in_hand.insert(walker, (Some(slot), walk))),
                // This walker is gone; the next one gets it.
                Err(Some(work)) => self.ready.push_front((slot, work)),
                Err(None) => {}
            }
        }
    }
}
