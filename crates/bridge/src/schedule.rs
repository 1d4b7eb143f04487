//! Which calls a device does together: a pure core.
//!
//! A device does one batch at a time and has two *slots*. A slot keeps what the pull-backs of its last evaluation need, until they have
//! come or a moment has passed. While one slot computes, the other one fills, or its walkers grade their features.
//!
//! An idle device starts at once: it takes whatever is there, in the order in which it came. A batch is sent ahead of the end of
//! the last one only if it is full, or if everyone who takes part is in one of the two.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use crate::shapes::Shape;

/// How long an idle device waits at least for the rest of the pull-backs of a batch. It waits for half of the time that the evaluation
/// took, if that is longer: to evaluate again takes twice that.
const PULL_BACK_GRACE: Duration = Duration::from_millis(5);
/// A client that has not called for so long does not take part.
const ABSENT_AFTER: Duration = Duration::from_millis(500);
/// Batches that a server has at a time: the one that it computes and the next one.
const MAX_IN_FLIGHT: usize = 2;

/// Number of slots.
pub(crate) const SLOTS: usize = 2;

/// Number of one of the two slots.
pub type DeviceSlot = usize;

/// What a call asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TicketKind {
    /// Energies; `follows`: the client will pull back.
    Evaluate {
        /// Whether a pull-back follows.
        follows: bool,
        /// Whether features are wanted.
        features: bool,
        /// Whether forces are wanted.
        forces: bool,
    },
    /// The pull-back of a cotangent.
    PullBack {
        /// Whether the gradient of the energy is in it, too.
        with_energy: bool,
    },
}

impl TicketKind {
    /// Whether one batch can have both. No results of one kind depend on which others wait.
    fn goes_with(self, other: Self) -> bool {
        match (self, other) {
            (Self::Evaluate { forces, .. }, Self::Evaluate { forces: others, .. }) => forces == others,
            (Self::PullBack { with_energy }, Self::PullBack { with_energy: others }) => with_energy == others,
            _ => false,
        }
    }
}

/// A call that waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket {
    /// Number of the call.
    pub id: u64,
    /// Who called.
    pub client: u64,
    /// What for.
    pub kind: TicketKind,
    /// Size of the structure.
    pub shape: Shape,
    /// When it came.
    pub since: Instant,
    /// Whether it must be in a batch of its own, because its last result was nonsense.
    pub alone: bool,
}

/// A batch to send to the server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DeviceBatch {
    /// An evaluation.
    Evaluate {
        /// Where it is kept.
        slot: DeviceSlot,
        /// Its calls.
        tickets: Vec<Ticket>,
    },
    /// Pull-backs for the kept evaluation of the slot: one for each member, in order, `None` for those that have not come.
    PullBackKept {
        /// Where the evaluation is.
        slot: DeviceSlot,
        /// Its calls.
        tickets: Vec<Option<Ticket>>,
    },
    /// Pull-backs that need an evaluation of their own.
    PullBackAnew {
        /// Where it is kept meanwhile.
        slot: DeviceSlot,
        /// Its calls.
        tickets: Vec<Ticket>,
    },
}

/// What to do next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NextBatch {
    /// Send this batch.
    Send(DeviceBatch),
    /// Nothing before this time, unless a call or an answer comes.
    WaitUntil(Instant),
    /// Nothing, until a call or an answer comes.
    Wait,
}

#[derive(Clone, Debug, Default)]
enum SlotState {
    #[default]
    Free,
    /// Under way. Clients whose pull-backs will follow.
    Computing { members: Vec<(u64, bool)> },
    /// Evaluated. The pull-backs of its members, as far as they have come.
    Kept { members: Vec<(u64, bool)>, arrived: Vec<Option<Ticket>>, until: Instant },
}

/// Calls that wait, and what is under way.
#[derive(Clone, Debug)]
pub struct Schedule {
    slots: [SlotState; SLOTS],
    /// Slots of the batches that the server has, in order.
    sent: VecDeque<DeviceSlot>,
    waiting: VecDeque<Ticket>,
    last_call: HashMap<u64, Instant>,
    max_structures: usize,
    max_bonds: usize,
    /// Whether batches are padded to powers of two of structures.
    padding: bool,
}

impl Schedule {
    /// A schedule for batches of at most this many structures, which are padded if the framework compiles for each shape.
    pub fn new(max_structures: usize, padding: bool) -> Self {
        Self {
            slots: Default::default(),
            sent: VecDeque::new(),
            waiting: VecDeque::new(),
            last_call: HashMap::new(),
            max_structures: max_structures.max(1),
            max_bonds: usize::MAX,
            padding,
        }
    }

    /// Bonds that the device computes for a batch: with padding, those of as many more such structures as there is room for.
    fn computed_bonds(&self, structures: usize, bonds: usize) -> usize {
        if self.padding { bonds * structures.next_power_of_two() / structures } else { bonds }
    }

    /// Largest number of structures of a batch.
    pub fn max_structures(&self) -> usize {
        self.max_structures
    }

    /// Largest number of bonds of a batch of more than one structure.
    pub fn max_bonds(&self) -> usize {
        self.max_bonds
    }

    /// Limits the bonds of batches of more than one structure.
    pub fn limit_bonds(&mut self, bonds: usize) {
        self.max_bonds = self.max_bonds.min(bonds);
    }

    /// A call has come.
    pub fn add(&mut self, ticket: Ticket) {
        self.last_call.insert(ticket.client, ticket.since);
        if is_pull_back(&ticket) {
            for slot in &mut self.slots {
                let SlotState::Kept { members, arrived, .. } = slot else { continue };
                let is_of = |(client, follows): &(u64, bool)| *follows && *client == ticket.client;
                if let Some(place) = members.iter().position(is_of) {
                    arrived[place] = Some(ticket);
                    return;
                }
            }
        } else {
            self.forget_evaluations_of(ticket.client);
        }
        self.waiting.push_back(ticket);
    }

    /// A client evaluates anew: no pull-back of what it evaluated before will come.
    fn forget_evaluations_of(&mut self, client: u64) {
        for slot in &mut self.slots {
            match slot {
                SlotState::Free => {}
                SlotState::Computing { members } => {
                    members.iter_mut().filter(|one| one.0 == client).for_each(|one| one.1 = false);
                }
                SlotState::Kept { members, arrived, .. } => {
                    let open = members.iter_mut().zip(arrived).filter(|(_, arrived)| arrived.is_none());
                    open.filter(|(one, _)| one.0 == client).for_each(|(one, _)| one.1 = false);
                    if members.iter().all(|(_, follows)| !follows) {
                        *slot = SlotState::Free;
                    }
                }
            }
        }
    }

    /// Puts calls back in front of all others, for another try.
    pub fn put_back(&mut self, tickets: Vec<Ticket>) {
        for ticket in tickets.into_iter().rev() {
            if !is_pull_back(&ticket) {
                self.forget_evaluations_of(ticket.client);
            }
            self.waiting.push_front(ticket);
        }
    }

    /// The server has answered its oldest batch, which took it `time`. Clients of an evaluation may call for pull-backs from now on.
    pub fn done(&mut self, now: Instant, time: Duration) {
        let Some(slot) = self.sent.pop_front() else { return };
        if let SlotState::Computing { members } = std::mem::take(&mut self.slots[slot])
            && members.iter().any(|(_, follows)| *follows)
        {
            let arrived = vec![None; members.len()];
            let until = now + PULL_BACK_GRACE.max(time / 2);
            self.slots[slot] = SlotState::Kept { members, arrived, until };
        }
    }

    /// The batch that was handed out last could not be sent.
    pub fn abort_newest(&mut self) {
        if let Some(slot) = self.sent.pop_back() {
            self.slots[slot] = SlotState::Free;
        }
    }

    /// The oldest batch of the server has failed.
    pub fn abort_oldest(&mut self) {
        if let Some(slot) = self.sent.pop_front() {
            self.slots[slot] = SlotState::Free;
        }
    }

    /// The server has lost everything. Pull-backs that have come for kept evaluations wait like others; the call `dropped` does not.
    pub fn forget_server(&mut self, dropped: u64) {
        self.sent.clear();
        self.waiting.retain(|ticket| ticket.id != dropped);
        for slot in std::mem::take(&mut self.slots) {
            if let SlotState::Kept { arrived, .. } = slot {
                self.put_back(arrived.into_iter().flatten().collect());
            }
        }
    }

    /// What to send, if anything. A batch counts as sent.
    pub fn next(&mut self, now: Instant) -> NextBatch {
        if self.sent.len() >= MAX_IN_FLIGHT {
            return NextBatch::Wait;
        }
        let is_idle = self.sent.is_empty();
        let complete = (0..self.slots.len()).find(|slot| self.is_complete(*slot));
        if let Some(slot) = complete {
            return NextBatch::Send(self.pull_back(slot));
        }
        if let Some(slot) = self.free_slot()
            && !self.waiting.is_empty()
            && (is_idle || self.fills_a_batch() || self.all_are_here(now))
        {
            return NextBatch::Send(self.take(slot));
        }
        match self.first_kept() {
            Some((slot, until)) if is_idle && now >= until => self.give_up_waiting(slot, now),
            Some((_, until)) if is_idle => NextBatch::WaitUntil(until),
            _ => NextBatch::Wait,
        }
    }

    /// Whether all members that will pull back have called.
    fn is_complete(&self, slot: DeviceSlot) -> bool {
        let SlotState::Kept { members, arrived, .. } = &self.slots[slot] else { return false };
        members.iter().zip(arrived).all(|((_, follows), call)| call.is_some() || !follows)
    }

    fn free_slot(&self) -> Option<DeviceSlot> {
        self.slots.iter().position(|slot| matches!(slot, SlotState::Free))
    }

    /// The slot that is given up first, and when.
    fn first_kept(&self) -> Option<(DeviceSlot, Instant)> {
        let kept = self.slots.iter().enumerate().filter_map(|(slot, state)| match state {
            SlotState::Kept { until, .. } => Some((slot, *until)),
            _ => None,
        });
        kept.min_by_key(|(_, until)| *until)
    }

    /// Pulls back what has come, or frees the slot if nothing has.
    fn give_up_waiting(&mut self, slot: DeviceSlot, now: Instant) -> NextBatch {
        let SlotState::Kept { arrived, .. } = &self.slots[slot] else { return NextBatch::Wait };
        if arrived.iter().any(Option::is_some) {
            return NextBatch::Send(self.pull_back(slot));
        }
        self.slots[slot] = SlotState::Free;
        self.next(now)
    }

    fn pull_back(&mut self, slot: DeviceSlot) -> DeviceBatch {
        let state = std::mem::replace(&mut self.slots[slot], SlotState::Computing { members: Vec::new() });
        self.sent.push_back(slot);
        let tickets = if let SlotState::Kept { arrived, .. } = state { arrived } else { Vec::new() };
        DeviceBatch::PullBackKept { slot, tickets }
    }

    fn fills_a_batch(&self) -> bool {
        let Some(first) = self.waiting.front() else { return false };
        let of_batch = || self.waiting.iter().filter(|ticket| first.kind.goes_with(ticket.kind));
        let bonds: usize = of_batch().map(|ticket| ticket.shape.bonds).sum();
        of_batch().count() >= self.max_structures || bonds >= self.max_bonds
    }

    /// Whether every client that takes part waits, or is in a slot.
    fn all_are_here(&self, now: Instant) -> bool {
        let in_slots = |client: &u64| {
            self.slots.iter().any(|slot| match slot {
                SlotState::Free => false,
                SlotState::Computing { members } | SlotState::Kept { members, .. } => {
                    members.iter().any(|(member, _)| member == client)
                }
            })
        };
        let waits = |client: &u64| self.waiting.iter().any(|ticket| ticket.client == *client);
        let mut present = self.last_call.iter().filter(|(_, last)| now.duration_since(**last) < ABSENT_AFTER);
        present.all(|(client, _)| waits(client) || in_slots(client))
    }

    /// Takes calls that go together, in the order in which they came.
    fn take(&mut self, slot: DeviceSlot) -> DeviceBatch {
        let mut taken: Vec<Ticket> = Vec::new();
        let mut left = VecDeque::new();
        let mut bonds = 0;
        for ticket in std::mem::take(&mut self.waiting) {
            let fits = match taken.first() {
                None => true,
                Some(first) => {
                    taken.len() < self.max_structures
                        && self.computed_bonds(taken.len() + 1, bonds + ticket.shape.bonds) <= self.max_bonds
                        && !first.alone
                        && !ticket.alone
                        && first.kind.goes_with(ticket.kind)
                }
            };
            if fits {
                bonds += ticket.shape.bonds;
                taken.push(ticket);
            } else {
                left.push_back(ticket);
            }
        }
        self.waiting = left;
        self.sent.push_back(slot);
        let anew = taken.first().is_some_and(is_pull_back);
        let follows = |ticket: &Ticket| matches!(ticket.kind, TicketKind::Evaluate { follows: true, .. });
        let members = taken.iter().map(|ticket| (ticket.client, follows(ticket))).collect();
        self.slots[slot] = SlotState::Computing { members };
        if anew {
            DeviceBatch::PullBackAnew { slot, tickets: taken }
        } else {
            DeviceBatch::Evaluate { slot, tickets: taken }
        }
    }
}

fn is_pull_back(ticket: &Ticket) -> bool {
    matches!(ticket.kind, TicketKind::PullBack { .. })
}

impl DeviceBatch {
    /// Its calls.
    pub fn tickets(&self) -> Vec<Ticket> {
        match self {
            Self::Evaluate { tickets, .. } | Self::PullBackAnew { tickets, .. } => tickets.clone(),
            Self::PullBackKept { tickets, .. } => tickets.iter().flatten().copied().collect(),
        }
    }
}

#[cfg(test)]
mod tests;
