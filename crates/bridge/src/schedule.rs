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
    },
    /// The pull-back of a cotangent.
    PullBack,
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
        if ticket.kind == TicketKind::PullBack {
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
        let bonds: usize = self.waiting.iter().map(|ticket| ticket.shape.bonds).sum();
        self.waiting.len() >= self.max_structures || bonds >= self.max_bonds
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

    /// Takes calls of one kind, in the order in which they came.
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
                        && is_pull_back(first) == is_pull_back(&ticket)
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
    ticket.kind == TicketKind::PullBack
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
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    const CLIENTS: u64 = 6;
    const MOST: usize = 3;

    /// What happens to a schedule.
    #[derive(Clone, Copy, Debug)]
    enum Step {
        /// A client without a call calls: with a bias, it pulls back what it has evaluated, or says that it will.
        Call(u64, bool),
        /// The server answers.
        Answer,
        /// The server reports a fault of its oldest batch, whose calls are made again.
        Fault,
        /// The server is lost with all that it has.
        Loss,
        /// Time passes, ms.
        Wait(u64),
    }

    fn steps() -> impl Strategy<Value = Vec<Step>> {
        let step = prop_oneof![
            6 => (1..=CLIENTS, prop::bool::weighted(0.8)).prop_map(|(client, biased)| Step::Call(client, biased)),
            6 => Just(Step::Answer),
            1 => Just(Step::Fault),
            1 => Just(Step::Loss),
            2 => (1_u64..20).prop_map(Step::Wait),
        ];
        prop::collection::vec(step, 1..200)
    }

    /// A schedule with clients that evaluate, then pull back or not, and so on.
    struct Simulation {
        schedule: Schedule,
        now: Instant,
        next_id: u64,
        /// Calls that wait or are under way: number and client.
        open: BTreeSet<(u64, u64)>,
        sent: VecDeque<DeviceBatch>,
        /// The last answered evaluation of clients, of which a pull-back may come.
        evaluated: HashMap<u64, u64>,
        /// The evaluations that each slot keeps: clients and numbers of calls.
        kept: [Vec<(u64, u64)>; 2],
    }

    impl Simulation {
        fn new() -> Self {
            let schedule = Schedule::new(MOST, false);
            let (open, sent, evaluated, kept) = Default::default();
            Self { schedule, now: Instant::now(), next_id: 1, open, sent, evaluated, kept }
        }

        fn call(&mut self, client: u64, biased: bool) {
            if self.open.iter().any(|(_, known)| *known == client) {
                return;
            }
            let kind = match biased && self.evaluated.contains_key(&client) {
                true => TicketKind::PullBack,
                false => TicketKind::Evaluate { follows: biased, features: true },
            };
            let shape = Shape { structures: 1, atoms: 4, bonds: 10 };
            let (id, since) = (self.next_id, self.now);
            self.next_id += 1;
            self.open.insert((id, client));
            self.schedule.add(Ticket { id, client, kind, shape, since, alone: client == CLIENTS });
        }

        fn step(&mut self, step: Step) {
            match step {
                Step::Call(client, biased) => self.call(client, biased),
                Step::Wait(time) => self.now += Duration::from_millis(time),
                Step::Answer => {
                    let Some(batch) = self.sent.pop_front() else { return };
                    self.schedule.done(self.now, Duration::from_millis(1));
                    for ticket in batch.tickets() {
                        assert!(self.open.remove(&(ticket.id, ticket.client)), "answered twice: {ticket:?}");
                        match ticket.kind {
                            TicketKind::PullBack => self.evaluated.remove(&ticket.client),
                            TicketKind::Evaluate { .. } => self.evaluated.insert(ticket.client, ticket.id),
                        };
                    }
                }
                Step::Fault => {
                    let Some(batch) = self.sent.pop_front() else { return };
                    self.schedule.abort_oldest();
                    self.schedule.put_back(batch.tickets());
                }
                Step::Loss => {
                    let again = self.sent.drain(..).flat_map(|batch| batch.tickets()).collect();
                    self.schedule.put_back(again);
                    self.schedule.forget_server(0);
                }
            }
            self.send();
        }

        fn send(&mut self) {
            while let NextBatch::Send(batch) = self.schedule.next(self.now) {
                let tickets = batch.tickets();
                assert!(!tickets.is_empty() && tickets.len() <= MOST, "{batch:?}");
                assert!(
                    tickets.len() == 1
                        || tickets.iter().all(|one| !one.alone || one.kind == TicketKind::PullBack)
                );
                let is_pull_back = !matches!(batch, DeviceBatch::Evaluate { .. });
                for ticket in &tickets {
                    assert_eq!(ticket.kind == TicketKind::PullBack, is_pull_back, "{batch:?}");
                }
                self.check_places(&batch);
                self.sent.push_back(batch);
                assert!(self.sent.len() <= MAX_IN_FLIGHT);
            }
        }
    }

    impl Simulation {
        /// What a slot has evaluated, and that each pull-back is that of the last evaluation of its client.
        fn check_places(&mut self, batch: &DeviceBatch) {
            match batch {
                DeviceBatch::Evaluate { slot, tickets } => {
                    self.kept[*slot] = tickets.iter().map(|one| (one.client, one.id)).collect();
                }
                DeviceBatch::PullBackAnew { slot, .. } => self.kept[*slot].clear(),
                DeviceBatch::PullBackKept { slot, tickets } => {
                    assert_eq!(tickets.len(), self.kept[*slot].len(), "{batch:?}");
                    for (ticket, (client, id)) in tickets.iter().zip(&self.kept[*slot]) {
                        let Some(ticket) = ticket else { continue };
                        assert_eq!(
                            (ticket.client, self.evaluated.get(client)),
                            (*client, Some(id)),
                            "{batch:?}"
                        );
                    }
                }
            }
        }
    }

    proptest! {
        /// Whatever happens, each call is answered once, in batches that a server can do, and nothing waits for ever.
        #[test]
        fn every_call_is_answered_once(steps in steps()) {
            let mut simulation = Simulation::new();
            steps.into_iter().for_each(|step| simulation.step(step));
            for _ in 0..4 * CLIENTS {
                simulation.step(Step::Wait(PULL_BACK_GRACE.as_millis() as u64));
                simulation.step(Step::Answer);
            }
            prop_assert!(simulation.open.is_empty(), "{:?}", simulation.open);
        }
    }

    /// Walkers that call together go through the device together, and their pull-backs find the evaluation.
    #[test]
    fn pull_backs_use_the_kept_evaluation() {
        let mut simulation = Simulation::new();
        let calls = |simulation: &mut Simulation, clients: &[u64]| {
            clients.iter().for_each(|client| simulation.step(Step::Call(*client, true)));
        };
        // Everyone is known to take part.
        for client in [1, 1, 2, 2, 3, 3, 4, 4] {
            calls(&mut simulation, &[client]);
            simulation.step(Step::Answer);
        }
        calls(&mut simulation, &[1, 2, 3, 4]);
        simulation.step(Step::Answer);
        assert_eq!(simulation.sent[0].tickets().len(), 3, "the three that came while the device computed");
        simulation.step(Step::Call(1, true));
        simulation.step(Step::Answer);
        calls(&mut simulation, &[2, 3]);
        let first = simulation.sent.front().cloned();
        assert!(
            matches!(&first, Some(DeviceBatch::PullBackKept { tickets, .. }) if tickets.len() == 1),
            "{first:?}"
        );
        simulation.step(Step::Answer);
        simulation.step(Step::Call(4, true));
        let second = simulation.sent.front().cloned();
        assert!(
            matches!(&second, Some(DeviceBatch::PullBackKept { tickets, .. }) if tickets.len() == 3),
            "{second:?}"
        );
    }

    /// A client that did not announce a pull-back, and was evaluated beside one that did, is pulled back where it was evaluated last.
    #[test]
    fn a_pull_back_is_that_of_the_last_evaluation() {
        let mut simulation = Simulation::new();
        // 1 and 2 call while the server has two batches, and are evaluated together in the first slot.
        let busy = [(3, true), (4, false), (3, true), (1, false), (2, true)]
            .map(|(client, biased)| Step::Call(client, biased));
        let [first, others @ ..] = busy;
        [first, Step::Answer].into_iter().chain(others).for_each(|step| simulation.step(step));
        assert_eq!(simulation.sent.len(), 2);
        [Step::Answer; 3].into_iter().for_each(|step| simulation.step(step));
        let together: Vec<u64> = simulation.kept[0].iter().map(|(client, _)| *client).collect();
        assert_eq!(together, [1, 2]);
        simulation.evaluated.remove(&1);
        simulation.step(Step::Call(1, true));
        simulation.step(Step::Answer);
        simulation.step(Step::Call(1, true));
        let batch = simulation.sent.front().cloned();
        assert!(
            matches!(&batch, Some(DeviceBatch::PullBackKept { tickets, .. }) if tickets.len() == 1),
            "{batch:?}"
        );
    }

    /// A batch is not larger than the memory takes, also with its padding.
    #[test]
    fn padding_counts_as_bonds() {
        for (padding, most) in [(false, 5), (true, 4)] {
            let mut schedule = Schedule::new(8, padding);
            schedule.limit_bonds(50);
            let shape = Shape { structures: 1, atoms: 4, bonds: 10 };
            let kind = TicketKind::Evaluate { follows: true, features: true };
            let now = Instant::now();
            (1..9).for_each(|id| {
                schedule.add(Ticket { id, client: id, kind, shape, since: now, alone: false })
            });
            let NextBatch::Send(batch) = schedule.next(now) else { panic!("nothing is sent") };
            assert_eq!(batch.tickets().len(), most);
        }
    }

    /// An evaluation that is made again, because its result was nonsense, is the one that is pulled back.
    #[test]
    fn what_is_evaluated_again_is_forgotten_first() {
        let mut simulation = Simulation::new();
        simulation.step(Step::Call(1, true));
        let ticket = simulation.sent[0].tickets()[0];
        simulation.schedule.done(simulation.now, Duration::from_secs(1));
        simulation.schedule.put_back(vec![Ticket { alone: true, ..ticket }]);
        simulation.sent.clear();
        simulation.send();
        assert!(matches!(simulation.sent[0], DeviceBatch::Evaluate { slot: 0, .. }), "{:?}", simulation.sent);
    }

    /// An idle device waits for pull-backs for half of the time that the evaluation took.
    #[test]
    fn the_wait_for_pull_backs_grows_with_the_evaluation() {
        let mut simulation = Simulation::new();
        simulation.step(Step::Call(1, true));
        let now = simulation.now;
        simulation.schedule.done(now, Duration::from_millis(80));
        let until = now + Duration::from_millis(40);
        assert_eq!(simulation.schedule.next(now), NextBatch::WaitUntil(until));
        assert_eq!(simulation.schedule.next(until), NextBatch::Wait, "it is given up");
        simulation.schedule.add(Ticket { kind: TicketKind::PullBack, ..simulation.sent[0].tickets()[0] });
        assert!(matches!(simulation.schedule.next(until), NextBatch::Send(DeviceBatch::PullBackAnew { .. })));
    }
}
