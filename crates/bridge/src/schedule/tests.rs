//! Properties of the schedule under random calls, answers and failures.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

const CLIENTS: u64 = 6;
const MOST: usize = 3;

/// Whether a client's calls are those with forces, or those with one gradient for forces and bias.
fn has_forces(client: u64) -> bool {
    client <= 4
}

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
            true => TicketKind::PullBack { with_energy: !has_forces(client) },
            false => TicketKind::Evaluate { follows: biased, features: true, forces: has_forces(client) },
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
                        TicketKind::PullBack { .. } => self.evaluated.remove(&ticket.client),
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
            assert!(tickets.len() == 1 || tickets.iter().all(|one| !one.alone || is_pull_back(one)));
            let pulls_back = !matches!(batch, DeviceBatch::Evaluate { .. });
            for ticket in &tickets {
                assert_eq!(is_pull_back(ticket), pulls_back, "{batch:?}");
                assert!(ticket.kind.goes_with(tickets[0].kind), "{batch:?}");
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
                    assert_eq!((ticket.client, self.evaluated.get(client)), (*client, Some(id)), "{batch:?}");
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
        let kind = TicketKind::Evaluate { follows: true, features: true, forces: true };
        let now = Instant::now();
        (1..9).for_each(|id| schedule.add(Ticket { id, client: id, kind, shape, since: now, alone: false }));
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
    let kind = TicketKind::PullBack { with_energy: false };
    simulation.schedule.add(Ticket { kind, ..simulation.sent[0].tickets()[0] });
    assert!(matches!(simulation.schedule.next(until), NextBatch::Send(DeviceBatch::PullBackAnew { .. })));
}

/// Calls without forces do not fill a batch of calls with them, nor go ahead in one.
#[test]
fn calls_of_two_kinds_have_batches_of_their_own() {
    let (mut schedule, now) = (Schedule::new(MOST, false), Instant::now());
    let shape = Shape { structures: 1, atoms: 4, bonds: 10 };
    for client in [1, 5, 2, 6] {
        let kind = TicketKind::Evaluate { follows: true, features: true, forces: has_forces(client) };
        schedule.add(Ticket { id: client, client, kind, shape, since: now, alone: false });
    }
    for expected in [[1, 2], [5, 6]] {
        let NextBatch::Send(batch) = schedule.next(now) else { panic!("nothing is sent") };
        assert_eq!(batch.tickets().iter().map(|one| one.client).collect::<Vec<_>>(), expected);
    }
}
