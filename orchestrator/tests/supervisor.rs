//! The supervisor: scenarios by hand, then whatever may happen in any order.

use std::collections::BTreeMap;
use std::time::Duration;

use orchestrator::supervisor::{ChildStatus, Ended, Ending, Limits, Order, Standing, Supervisor};
use proptest::prelude::*;

const LIMITS: Limits = Limits {
    silence: Duration::from_secs(120),
    first_pause: Duration::from_secs(1),
    longest_pause: Duration::from_secs(6),
    restarts: 5,
    grace: Duration::from_secs(30),
    outlives: false,
};

fn s(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

fn crash() -> Ending {
    Ending::Exit { code: 2, words: None }
}

fn home() -> Ending {
    Ending::Exit { code: 0, words: None }
}

fn signal(signal: i32) -> Ending {
    Ending::Signal { signal, words: None }
}

fn start(number: u32, incarnation: u32) -> Order {
    Order::Start { number, incarnation }
}

fn status(supervisor: &Supervisor, number: u32, now: Duration) -> ChildStatus {
    supervisor.status(now).nth(number as usize).unwrap()
}

/// A supervisor of so many children, all started at 0.
fn started(children: u32) -> Supervisor {
    let mut supervisor = Supervisor::new(children, LIMITS);
    let orders: Vec<_> = (0..children).map(|number| start(number, 1)).collect();
    assert_eq!(supervisor.due(s(0)), orders);
    supervisor
}

#[test]
fn who_outlives_its_parent_stays_while_there_is_work_and_is_not_killed() {
    let mut supervisor = Supervisor::new(2, Limits { outlives: true, ..LIMITS });
    assert_eq!(supervisor.due(s(0)), [start(0, 1), start(1, 1)]);
    let left = supervisor.ended(0, home(), s(5)).unwrap();
    assert_eq!(left.then, Standing::Pausing { left: s(1) });
    assert_eq!(supervisor.due(s(6)), [start(0, 2)]);
    assert_eq!(supervisor.stop(s(10)), [Order::Terminate { number: 0 }, Order::Terminate { number: 1 }]);
    assert_eq!(
        supervisor.ended(0, Ending::Exit { code: 130, words: None }, s(11)).unwrap().then,
        Standing::GoneHome
    );
    // The other still has something in hand when its time of grace is over.
    assert_eq!((supervisor.due(s(39)), supervisor.is_over()), (vec![], false));
    assert_eq!((supervisor.due(s(40)), supervisor.is_over()), (vec![], true));
}

#[test]
fn nobody_is_started_when_there_is_no_more_work() {
    let mut supervisor = started(2);
    supervisor.ended(0, crash(), s(1)).unwrap();
    supervisor.close();
    assert_eq!(
        (supervisor.due(s(100)), status(&supervisor, 0, s(100)).standing),
        (vec![], Standing::GoneHome)
    );
    assert!(!supervisor.is_over());
    supervisor.ended(1, home(), s(101)).unwrap();
    assert!(supervisor.is_over());
}

#[test]
fn pauses_double_up_to_the_longest_until_the_child_is_given_up() {
    let mut supervisor = started(2);
    supervisor.heard(1, s(0));
    let mut now = s(0);
    for (incarnation, pause) in (2..).zip([1, 2, 4, 6, 6]) {
        let ended = supervisor.ended(0, crash(), now).unwrap();
        assert_eq!(ended.then, Standing::Pausing { left: s(pause) });
        assert_eq!(supervisor.due(now + s(pause) - Duration::from_nanos(1)), []);
        assert_eq!(supervisor.next(), Some(now + s(pause)));
        now += s(pause);
        assert_eq!(supervisor.due(now), [start(0, incarnation)]);
        // A sign of life proves nothing: it comes from a child that is about to die, too.
        supervisor.heard(0, now);
    }
    let last = supervisor.ended(0, signal(11), now);
    assert_eq!(last, Some(Ended { incarnation: 6, ending: signal(11), then: Standing::GivenUp }));
    let given_up = status(&supervisor, 0, now);
    assert_eq!((given_up.incarnation, given_up.restarts), (6, 5));
    assert_eq!(given_up.last_failure, Some(signal(11)));
    // The others go on.
    assert!(!supervisor.is_over());
    assert_eq!(status(&supervisor, 1, now).standing, Standing::Running);
    assert_eq!(supervisor.next(), Some(s(120)));
    supervisor.ended(1, home(), now);
    assert!(supervisor.is_over() && supervisor.next().is_none());
}

#[test]
fn what_was_useful_begins_a_new_row_of_failures() {
    let mut supervisor = started(1);
    let mut now = s(0);
    for incarnation in 2..30 {
        assert_eq!(
            supervisor.ended(0, crash(), now).unwrap().then,
            Standing::Pausing { left: s(1) },
            "{incarnation}"
        );
        now += s(1);
        assert_eq!(supervisor.due(now), [start(0, incarnation)]);
        supervisor.useful(0, now);
    }
    // What it delivered may be seen only after its end.
    supervisor.ended(0, crash(), now);
    supervisor.useful(0, now);
    supervisor.due(now + s(1));
    assert_eq!(supervisor.ended(0, crash(), now).unwrap().then, Standing::Pausing { left: s(1) });
}

#[test]
fn without_restarts_the_first_failure_is_the_last() {
    let mut supervisor = Supervisor::new(1, Limits { restarts: 0, ..LIMITS });
    supervisor.due(s(0));
    assert_eq!(supervisor.ended(0, crash(), s(0)).unwrap().then, Standing::GivenUp);
}

#[test]
fn who_went_home_stays_there() {
    let mut supervisor = started(1);
    let ended = supervisor.ended(0, home(), s(5)).unwrap();
    assert_eq!(ended, Ended { incarnation: 1, ending: home(), then: Standing::GoneHome });
    assert_eq!(supervisor.due(s(1000)), []);
    assert!(supervisor.is_over());
    assert_eq!(status(&supervisor, 0, s(5)).last_failure, None);
    assert_eq!(supervisor.ended(0, home(), s(6)), None, "it had no process");
}

#[test]
fn a_silent_child_is_killed_once_and_started_again() {
    for speaks in [false, true] {
        let mut supervisor = started(1);
        let heard = if speaks { s(50) } else { s(0) };
        if speaks {
            supervisor.heard(0, heard);
        }
        let standing = if speaks { Standing::Running } else { Standing::Starting };
        assert_eq!(status(&supervisor, 0, heard).standing, standing);
        assert_eq!(supervisor.next(), Some(heard + s(120)));
        if speaks {
            // Signs may arrive in any order.
            supervisor.heard(0, heard - s(10));
        }
        assert_eq!(supervisor.due(heard + s(119)), []);
        assert_eq!(supervisor.due(heard + s(120)), [Order::Kill { number: 0 }]);
        assert_eq!(status(&supervisor, 0, heard).standing, Standing::Ending);
        // It may take its time to die, and what it said before comes late.
        supervisor.heard(0, heard + s(121));
        assert_eq!(supervisor.due(heard + s(500)), []);
        assert_eq!(supervisor.next(), None);
        let ended = supervisor.ended(0, signal(9), heard + s(500)).unwrap();
        assert_eq!(ended.ending, Ending::Silent(s(120)));
        assert_eq!(ended.then, Standing::Pausing { left: s(1) });
    }
}

#[test]
fn silence_proves_nothing_if_nobody_listened() {
    let mut supervisor = started(1);
    supervisor.heard(0, s(10));
    // The orchestrator was held up from 20 s to 1,000 s.
    assert_eq!(supervisor.due(s(1000)), []);
    assert_eq!(supervisor.next(), Some(s(1120)));
    assert_eq!(supervisor.due(s(1121)), [Order::Kill { number: 0 }], "a little late is no excuse");
}

#[test]
fn a_stop_terminates_and_then_kills() {
    let mut supervisor = started(5);
    supervisor.ended(1, crash(), s(1));
    supervisor.ended(2, home(), s(1));
    supervisor.due(s(1));
    let terminate = [0, 3, 4].map(|number| Order::Terminate { number });
    assert_eq!(supervisor.stop(s(1)), terminate);
    assert_eq!(status(&supervisor, 1, s(1)).standing, Standing::GoneHome, "it is not started again");
    assert_eq!(supervisor.ended(0, signal(15), s(2)).unwrap().then, Standing::GoneHome);
    assert_eq!(status(&supervisor, 0, s(2)).last_failure, None, "as it was told");
    assert_eq!(supervisor.ended(3, signal(11), s(2)).unwrap().then, Standing::GoneHome);
    assert_eq!(status(&supervisor, 3, s(2)).last_failure, Some(signal(11)));
    assert_eq!(supervisor.next(), Some(s(31)));
    assert_eq!(supervisor.due(s(31)), [Order::Kill { number: 4 }]);
    assert_eq!(supervisor.ended(4, signal(9), s(31)).unwrap().ending, Ending::Lingering(s(30)));
    assert!(supervisor.is_over());
}

#[test]
fn who_was_interrupted_by_others_is_started_again() {
    let interrupted = Ending::Exit { code: 130, words: None };
    let mut supervisor = started(1);
    let ended = supervisor.ended(0, interrupted.clone(), s(0)).unwrap();
    assert_eq!(ended.then, Standing::Pausing { left: s(1) });
    supervisor.due(s(1));
    supervisor.stop(s(1));
    assert_eq!(supervisor.ended(0, crash(), s(1)).unwrap().then, Standing::GoneHome);
    assert_eq!(status(&supervisor, 0, s(1)).last_failure, Some(crash()));
    let mut supervisor = started(1);
    supervisor.stop(s(1));
    supervisor.ended(0, interrupted, s(1));
    assert_eq!(status(&supervisor, 0, s(1)).last_failure, None, "as it was told");
}

#[test]
fn a_child_that_cannot_be_started_counts_as_failed() {
    let mut supervisor = started(1);
    let reason = Ending::NotStarted { reason: "no such program".to_owned(), is_shortage: false };
    let ended = supervisor.ended(0, reason.clone(), s(0)).unwrap();
    assert_eq!(ended, Ended { incarnation: 1, ending: reason, then: Standing::Pausing { left: s(1) } });
    assert_eq!(supervisor.due(s(1)), [start(0, 2)]);
}

#[test]
fn a_start_that_the_host_has_no_room_for_is_tried_again_for_ever() {
    let mut supervisor = started(1);
    let shortage = || Ending::NotStarted { reason: "too many open files".to_owned(), is_shortage: true };
    let mut now = s(0);
    for (incarnation, pause) in (2..).zip([1, 2, 4].into_iter().chain([6; 100])) {
        let ended = supervisor.ended(0, shortage(), now).unwrap();
        assert_eq!(ended.then, Standing::Pausing { left: s(pause) }, "{incarnation}");
        now += s(pause);
        assert_eq!(supervisor.due(now), [start(0, incarnation)]);
    }
    assert_eq!(status(&supervisor, 0, now).last_failure, Some(shortage()));
    // Nothing of that counts against the child.
    for pause in [1, 2, 4, 6, 6] {
        assert_eq!(supervisor.ended(0, crash(), now).unwrap().then, Standing::Pausing { left: s(pause) });
        now += s(pause);
        supervisor.due(now);
    }
    assert_eq!(supervisor.ended(0, crash(), now).unwrap().then, Standing::GivenUp);
}

#[test]
fn a_living_process_is_taken_in_without_a_start() {
    let mut supervisor = Supervisor::new(2, LIMITS);
    assert!(supervisor.adopt(1, s(0)));
    assert!(!supervisor.adopt(1, s(0)), "it has one");
    assert!(!supervisor.adopt(2, s(0)), "no such child");
    assert_eq!(supervisor.due(s(0)), [start(0, 1)]);
    assert!(!supervisor.adopt(0, s(0)), "it was started");
    supervisor.heard(0, s(100));
    assert_eq!(supervisor.due(s(120)), [Order::Kill { number: 1 }], "it must speak like any other");
    let ended = supervisor.ended(1, Ending::Unseen, s(120)).unwrap();
    assert_eq!((ended.incarnation, ended.ending), (0, Ending::Silent(s(120))));
    assert!(!supervisor.adopt(1, s(120)), "its next process is one of ours");
    assert_eq!(supervisor.due(s(121)), [start(1, 1)]);
    assert_eq!(status(&supervisor, 1, s(121)).restarts, 1);
}

#[test]
fn enormous_limits_are_no_trouble() {
    let limits =
        Limits { silence: Duration::MAX, longest_pause: Duration::MAX, restarts: u32::MAX, ..LIMITS };
    let mut supervisor = Supervisor::new(1, limits);
    for _ in 0..100 {
        supervisor.due(supervisor.next().unwrap());
        supervisor.ended(0, crash(), s(1)).unwrap();
    }
    assert_eq!(status(&supervisor, 0, s(0)).restarts, 99);
}

#[test]
fn nobody_is_soon_over() {
    assert!(Supervisor::new(0, LIMITS).is_over());
}

const CHILDREN: u32 = 3;

#[derive(Clone, Debug)]
enum Happening {
    Pass(Duration),
    Heard(u32),
    Useful(u32),
    Ended(u32, Ending),
    Adopted(u32),
    Stop,
}

fn happening() -> impl Strategy<Value = Happening> {
    // One number more than there are children.
    let number = 0..=CHILDREN;
    let ending = prop_oneof![
        4 => Just(crash()),
        2 => Just(signal(9)),
        1 => Just(home()),
        1 => Just(Ending::Unseen),
        1 => any::<bool>().prop_map(|is_shortage| Ending::NotStarted { reason: String::new(), is_shortage }),
    ];
    prop_oneof![
        8 => (0u64..20_000).prop_map(|ms| Happening::Pass(Duration::from_millis(ms))),
        1 => (0u64..200).prop_map(|s| Happening::Pass(Duration::from_secs(s))),
        4 => number.clone().prop_map(Happening::Heard),
        1 => number.clone().prop_map(Happening::Useful),
        8 => (number.clone(), ending).prop_map(|(number, ending)| Happening::Ended(number, ending)),
        1 => number.prop_map(Happening::Adopted),
        1 => Just(Happening::Stop),
    ]
}

/// The processes as they really are, and what must hold of the orders about them.
#[derive(Default)]
struct World {
    now: Duration,
    alive: BTreeMap<u32, bool>,
    incarnation: BTreeMap<u32, u32>,
    unrewarded: BTreeMap<u32, u32>,
    stopped: bool,
}

impl World {
    fn obey(&mut self, orders: Vec<Order>) {
        for order in orders {
            match order {
                Order::Start { number, incarnation } => {
                    assert!(!self.stopped, "a start after the stop");
                    assert!(number < CHILDREN);
                    assert_eq!(self.alive.insert(number, false), None, "two processes of number {number}");
                    let before = self.incarnation.insert(number, incarnation).unwrap_or(0);
                    assert_eq!(incarnation, before + 1);
                    let starts = self.unrewarded.entry(number).or_default();
                    *starts += 1;
                    assert!(*starts <= LIMITS.restarts + 1, "started too often");
                }
                Order::Terminate { number } => assert_eq!(self.alive.get(&number), Some(&false)),
                Order::Kill { number } => {
                    assert_eq!(self.alive.insert(number, true), Some(false), "one kill for one process");
                }
            }
        }
    }

    fn happen(&mut self, supervisor: &mut Supervisor, happening: Happening) {
        match happening {
            Happening::Pass(time) => self.now += time,
            Happening::Heard(number) => supervisor.heard(number, self.now),
            Happening::Useful(number) => {
                supervisor.useful(number, self.now);
                self.unrewarded.insert(number, 0);
            }
            Happening::Ended(number, ending) => {
                let was_alive = self.alive.remove(&number).is_some();
                if was_alive && matches!(ending, Ending::NotStarted { is_shortage: true, .. }) {
                    // It may be started again any number of times.
                    let starts = self.unrewarded.entry(number).or_default();
                    *starts = starts.saturating_sub(1);
                }
                assert_eq!(supervisor.ended(number, ending, self.now).is_some(), was_alive);
            }
            Happening::Adopted(number) => {
                if supervisor.adopt(number, self.now) {
                    assert!(!self.stopped && !self.incarnation.contains_key(&number));
                    assert_eq!(self.alive.insert(number, false), None);
                }
            }
            Happening::Stop => {
                self.stopped = true;
                let orders = supervisor.stop(self.now);
                self.obey(orders);
            }
        }
        let orders = supervisor.due(self.now);
        self.obey(orders);
        // Else whoever sleeps until then would not sleep.
        assert!(supervisor.next().is_none_or(|next| next > self.now));
        assert!(!supervisor.is_over() || self.alive.is_empty());
    }
}

proptest! {
    #[test]
    fn nothing_goes_wrong_in_any_order(happenings in prop::collection::vec(happening(), 0..200)) {
        let mut supervisor = Supervisor::new(CHILDREN, LIMITS);
        let mut world = World::default();
        for happening in happenings {
            world.happen(&mut supervisor, happening);
        }
        // After a stop the time of grace is all that it takes to have everything dead or killed.
        world.happen(&mut supervisor, Happening::Stop);
        world.happen(&mut supervisor, Happening::Pass(LIMITS.grace));
        assert!(world.alive.values().all(|killed| *killed));
        for number in 0..CHILDREN {
            world.happen(&mut supervisor, Happening::Ended(number, signal(9)));
        }
        assert!(supervisor.is_over() && supervisor.next().is_none());
    }

    #[test]
    fn children_that_always_fail_are_given_up_in_the_end(deaths in prop::collection::vec(0u64..200, 18)) {
        let mut supervisor = Supervisor::new(CHILDREN, LIMITS);
        let mut deaths = deaths.into_iter();
        let mut starts = 0;
        while let Some(now) = supervisor.next() {
            for order in supervisor.due(now) {
                match order {
                    Order::Start { number, .. } => {
                        starts += 1;
                        let death = now + Duration::from_millis(deaths.next().unwrap());
                        supervisor.ended(number, crash(), death).unwrap();
                    }
                    other => panic!("{other:?}"),
                }
            }
        }
        assert!(supervisor.is_over());
        assert_eq!(starts, CHILDREN * (LIMITS.restarts + 1));
        assert!(supervisor.status(s(0)).all(|child| child.standing == Standing::GivenUp));
    }
}
