//! Which walker works on which assignment. No network, no clock.

use std::collections::{BTreeMap, VecDeque};

use tokio::sync::oneshot;
use wire::WalkId;
use wire::messages::AssignmentReport;
use wire::net::{Slot, SlotReport};
use wire::transport::WorkItem;

/// The assignments and walkers of a host. `S` is a slot: the orchestrator's entry for one assignment.
#[derive(Debug)]
pub(super) struct AssignmentPool<S = Slot> {
    /// Assignments that no walker has started.
    ready: VecDeque<(S, WorkItem)>,
    /// Walkers that wait for an assignment, in order of arrival.
    waiting: VecDeque<(u32, oneshot::Sender<Option<WorkItem>>)>,
    /// The assignment of each busy walker.
    assigned: BTreeMap<u32, (Option<S>, WalkId)>,
    /// Reports whose slots are lost.
    unsent: VecDeque<Box<AssignmentReport>>,
    /// Slots that may still get work.
    open_slots: usize,
}

impl<S> Default for AssignmentPool<S> {
    fn default() -> Self {
        let (ready, waiting, unsent) = (VecDeque::new(), VecDeque::new(), VecDeque::new());
        Self { ready, waiting, assigned: BTreeMap::new(), unsent, open_slots: 0 }
    }
}

impl<S> AssignmentPool<S> {
    /// Starts with these slots, or replaces lost ones by them. Assignments in progress keep a slot; assignments not
    /// started are dropped. Returns the first message for each free slot.
    pub(super) fn start(&mut self, slots: Vec<S>) -> Vec<(S, SlotReport)> {
        self.open_slots = slots.len();
        self.ready.clear();
        let mut slots = slots.into_iter();
        for (slot, _) in self.assigned.values_mut() {
            *slot = slots.next();
        }
        slots
            .map(|slot| (slot, self.unsent.pop_front().map_or(SlotReport::Empty, SlotReport::Report)))
            .collect()
    }

    /// Handles an idle walker: returns the report of its assignment, and queues it for another one.
    pub(super) fn walker_idle(
        &mut self,
        walker: u32,
        report: Option<AssignmentReport>,
        reply: oneshot::Sender<Option<WorkItem>>,
    ) -> Option<(S, SlotReport)> {
        let slot = self.assigned.remove(&walker).and_then(|(slot, _)| slot);
        self.waiting.push_back((walker, reply));
        self.dispatch();
        match (slot, report) {
            (Some(slot), Some(report)) => Some((slot, SlotReport::Report(Box::new(report)))),
            (Some(slot), None) => Some((slot, SlotReport::Lost { crashed: false })),
            (None, report) => {
                self.unsent.extend(report.map(Box::new));
                None
            }
        }
    }

    /// Handles a lost walker: returns the message about its assignment, if it had one.
    pub(super) fn walker_lost(&mut self, walker: u32, crashed: bool) -> Option<(S, SlotReport)> {
        let (slot, _) = self.assigned.remove(&walker)?;
        Some((slot?, SlotReport::Lost { crashed }))
    }

    /// Adds an assignment.
    pub(super) fn assign(&mut self, slot: S, work: WorkItem) {
        self.ready.push_back((slot, work));
        self.dispatch();
    }

    /// Handles a slot that gets no more work.
    pub(super) fn slot_closed(&mut self) {
        self.open_slots = self.open_slots.saturating_sub(1);
    }

    /// Keeps a report that could not be delivered.
    pub(super) fn keep_unsent(&mut self, report: SlotReport) {
        if let SlotReport::Report(report) = report {
            self.unsent.push_back(report);
        }
    }

    /// The slot of a walk that is in progress here.
    pub(super) fn slot_of(&self, walk: WalkId) -> Option<&S> {
        self.assigned.values().find(|(_, of)| *of == walk).and_then(|(slot, _)| slot.as_ref())
    }

    /// Dismisses the waiting walkers.
    pub(super) fn dismiss_idle(&mut self) {
        for (_, reply) in self.waiting.drain(..) {
            // A walker that has ended needs no reply.
            let _ = reply.send(None);
        }
    }

    /// Reports that wait for a slot.
    pub(super) fn unsent(&self) -> usize {
        self.unsent.len()
    }

    /// Walkers without an assignment.
    pub(super) fn idle(&self) -> usize {
        self.waiting.len()
    }

    /// Whether no walker has an assignment.
    pub(super) fn is_idle(&self) -> bool {
        self.assigned.is_empty()
    }

    /// Whether no work is left.
    pub(super) fn is_over(&self) -> bool {
        self.open_slots == 0 && self.assigned.is_empty()
    }

    /// Gives assignments to waiting walkers.
    fn dispatch(&mut self) {
        while let Some((slot, work)) = self.ready.pop_front() {
            let Some((walker, reply)) = self.waiting.pop_front() else {
                self.ready.push_front((slot, work));
                return;
            };
            let walk = work.assignment.walk;
            match reply.send(Some(work)) {
                Ok(()) => drop(self.assigned.insert(walker, (Some(slot), walk))),
                // This walker has ended; the next one gets the assignment.
                Err(Some(work)) => self.ready.push_front((slot, work)),
                Err(None) => {}
            }
        }
    }
}
