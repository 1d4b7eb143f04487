//! The supervisor: explicit scenarios, then arbitrary events in any order.

use std::collections::BTreeMap;
use std::time::Duration;

use orchestrator::supervisor::{
    ChildExit, ChildState, ChildStatus, ExitReason, Limits, Supervisor, SupervisorAction,
};
use proptest::prelude::*;

const LIMITS: Limits = Limits {
    heartbeat_timeout: Duration::from_secs(120),
    initial_backoff: Duration::from_secs(1),
    max_backoff: Duration::from_secs(6),
    max_restarts: 5,
    grace_period: Duration::from_secs(30),
    detached: false,
};

fn s(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

fn crash() -> ExitReason {
    ExitReason::Exit { code: 2, last_line: None }
}

fn finished() -> ExitReason {
    ExitReason::Exit { code: 0, last_line: None }
}

fn signal(signal: i32) -> ExitReason {
    ExitReason::Signal { signal, last_line: None }
}

fn start(number: u32, incarnation: u32) -> SupervisorAction {
    SupervisorAction::Start { number, incarnation }
}

fn status(supervisor: &Supervisor, number: u32, now: Duration) -> ChildStatus {
    supervisor.status(now).nth(number as usize).unwrap()
}

/// A supervisor of this number of children, all started at time 0.
fn started(children: u32) -> Supervisor {
    let mut supervisor = Supervisor::new(children, LIMITS);
    let actions: Vec<_> = (0..children).map(|number| start(number, 1)).collect();
    assert_eq!(supervisor.due_actions(s(0)), actions);
    supervisor
}

#[test]
fn detached_children_are_not_killed() {
    let mut supervisor = Supervisor::new(2, Limits { detached: true, ..LIMITS });
    assert_eq!(supervisor.due_actions(s(0)), [start(0, 1), start(1, 1)]);
    let left = supervisor.ended(0, finished(), s(5)).unwrap();
    assert_eq!(left.then, ChildState::BackingOff { left: s(1) });
    assert_eq!(supervisor.due_actions(s(6)), [start(0, 2)]);
    assert_eq!(
        supervisor.stop(s(10)),
        [SupervisorAction::Terminate { number: 0 }, SupervisorAction::Terminate { number: 1 }]
    );
    assert_eq!(
        supervisor.ended(0, ExitReason::Exit { code: 130, last_line: None }, s(11)).unwrap().then,
        ChildState::Exited
    );
    // The other child is still working when its grace period ends.
    assert_eq!((supervisor.due_actions(s(39)), supervisor.is_over()), (vec![], false));
    assert_eq!((supervisor.due_actions(s(40)), supervisor.is_over()), (vec![], true));
}

#[test]
fn nothing_is_started_without_work() {
    let mut supervisor = started(2);
    supervisor.ended(0, crash(), s(1)).unwrap();
    supervisor.close();
    assert_eq!(
        (supervisor.due_actions(s(100)), status(&supervisor, 0, s(100)).state),
        (vec![], ChildState::Exited)
    );
    assert!(!supervisor.is_over());
    supervisor.ended(1, finished(), s(101)).unwrap();
    assert!(supervisor.is_over());
}

#[test]
fn backoff_doubles_up_to_the_maximum_until_the_child_fails() {
    let mut supervisor = started(2);
    supervisor.heartbeat(1, s(0));
    let mut now = s(0);
    for (incarnation, pause) in (2..).zip([1, 2, 4, 6, 6]) {
        let ended = supervisor.ended(0, crash(), now).unwrap();
        assert_eq!(ended.then, ChildState::BackingOff { left: s(pause) });
        assert_eq!(supervisor.due_actions(now + s(pause) - Duration::from_nanos(1)), []);
        assert_eq!(supervisor.next_deadline(), Some(now + s(pause)));
        now += s(pause);
        assert_eq!(supervisor.due_actions(now), [start(0, incarnation)]);
        // A heartbeat proves nothing: a child that is about to die also sends it.
        supervisor.heartbeat(0, now);
    }
    let last = supervisor.ended(0, signal(11), now);
    assert_eq!(last, Some(ChildExit { incarnation: 6, reason: signal(11), then: ChildState::Failed }));
    let failed = status(&supervisor, 0, now);
    assert_eq!((failed.incarnation, failed.restarts), (6, 5));
    assert_eq!(failed.last_failure, Some(signal(11)));
    // The others continue.
    assert!(!supervisor.is_over());
    assert_eq!(status(&supervisor, 1, now).state, ChildState::Running);
    assert_eq!(supervisor.next_deadline(), Some(s(120)));
    supervisor.ended(1, finished(), now);
    assert!(supervisor.is_over() && supervisor.next_deadline().is_none());
}

#[test]
fn deliveries_reset_failures() {
    let mut supervisor = started(1);
    let mut now = s(0);
    for incarnation in 2..30 {
        assert_eq!(
            supervisor.ended(0, crash(), now).unwrap().then,
            ChildState::BackingOff { left: s(1) },
            "{incarnation}"
        );
        now += s(1);
        assert_eq!(supervisor.due_actions(now), [start(0, incarnation)]);
        supervisor.delivered(0, now);
    }
    // A delivery may be noticed only after the exit.
    supervisor.ended(0, crash(), now);
    supervisor.delivered(0, now);
    supervisor.due_actions(now + s(1));
    assert_eq!(supervisor.ended(0, crash(), now).unwrap().then, ChildState::BackingOff { left: s(1) });
}

#[test]
fn without_restarts_the_first_failure_is_the_last() {
    let mut supervisor = Supervisor::new(1, Limits { max_restarts: 0, ..LIMITS });
    supervisor.due_actions(s(0));
    assert_eq!(supervisor.ended(0, crash(), s(0)).unwrap().then, ChildState::Failed);
}

#[test]
fn finished_children_are_not_restarted() {
    let mut supervisor = started(1);
    let ended = supervisor.ended(0, finished(), s(5)).unwrap();
    assert_eq!(ended, ChildExit { incarnation: 1, reason: finished(), then: ChildState::Exited });
    assert_eq!(supervisor.due_actions(s(1000)), []);
    assert!(supervisor.is_over());
    assert_eq!(status(&supervisor, 0, s(5)).last_failure, None);
    assert_eq!(supervisor.ended(0, finished(), s(6)), None, "it had no process");
}

#[test]
fn unresponsive_children_are_killed_once_and_restarted() {
    for speaks in [false, true] {
        let mut supervisor = started(1);
        let heard = if speaks { s(50) } else { s(0) };
        if speaks {
            supervisor.heartbeat(0, heard);
        }
        let standing = if speaks { ChildState::Running } else { ChildState::Starting };
        assert_eq!(status(&supervisor, 0, heard).state, standing);
        assert_eq!(supervisor.next_deadline(), Some(heard + s(120)));
        if speaks {
            // Heartbeats may arrive in any order.
            supervisor.heartbeat(0, heard - s(10));
        }
        assert_eq!(supervisor.due_actions(heard + s(119)), []);
        assert_eq!(supervisor.due_actions(heard + s(120)), [SupervisorAction::Kill { number: 0 }]);
        assert_eq!(status(&supervisor, 0, heard).state, ChildState::Stopping);
        // It may take time to die, and earlier heartbeats arrive late.
        supervisor.heartbeat(0, heard + s(121));
        assert_eq!(supervisor.due_actions(heard + s(500)), []);
        assert_eq!(supervisor.next_deadline(), None);
        let ended = supervisor.ended(0, signal(9), heard + s(500)).unwrap();
        assert_eq!(ended.reason, ExitReason::Unresponsive(s(120)));
        assert_eq!(ended.then, ChildState::BackingOff { left: s(1) });
    }
}

/// It may have ended by itself just before it was killed.
#[test]
fn a_child_that_ends_before_it_is_killed_has_ended_by_itself() {
    let mut supervisor = started(2);
    supervisor.due_actions(s(120));
    let ended = supervisor.ended(0, finished(), s(121)).unwrap();
    assert_eq!((ended.reason, ended.then), (finished(), ChildState::Exited));
    let ended = supervisor.ended(1, signal(11), s(121)).unwrap();
    assert_eq!((ended.reason, ended.then), (signal(11), ChildState::BackingOff { left: s(1) }));
}

#[test]
fn missed_heartbeats_during_a_suspension_do_not_count() {
    let mut supervisor = started(1);
    supervisor.heartbeat(0, s(10));
    // The orchestrator was suspended from 20 s to 1,000 s.
    assert_eq!(supervisor.due_actions(s(1000)), []);
    assert_eq!(supervisor.next_deadline(), Some(s(1120)));
    assert_eq!(
        supervisor.due_actions(s(1121)),
        [SupervisorAction::Kill { number: 0 }],
        "a little late is no excuse"
    );
    let mut supervisor = started(1);
    assert_eq!(supervisor.due_actions(s(132)).len(), 1, "a tenth of the time is a little");
    let mut supervisor = started(1);
    assert_eq!(supervisor.due_actions(s(133)), []);
}

#[test]
fn a_stop_terminates_and_then_kills() {
    let mut supervisor = started(5);
    supervisor.ended(1, crash(), s(1));
    supervisor.ended(2, finished(), s(1));
    supervisor.due_actions(s(1));
    let terminate = [0, 3, 4].map(|number| SupervisorAction::Terminate { number });
    assert_eq!(supervisor.stop(s(1)), terminate);
    assert_eq!(status(&supervisor, 1, s(1)).state, ChildState::Exited, "it is not started again");
    assert_eq!(supervisor.ended(0, signal(15), s(2)).unwrap().then, ChildState::Exited);
    assert_eq!(status(&supervisor, 0, s(2)).last_failure, None, "it ended as requested");
    assert_eq!(supervisor.ended(3, signal(11), s(2)).unwrap().then, ChildState::Exited);
    assert_eq!(status(&supervisor, 3, s(2)).last_failure, Some(signal(11)));
    assert_eq!(supervisor.next_deadline(), Some(s(31)));
    assert_eq!(supervisor.due_actions(s(31)), [SupervisorAction::Kill { number: 4 }]);
    assert_eq!(supervisor.ended(4, signal(9), s(31)).unwrap().reason, ExitReason::StopTimeout(s(30)));
    assert!(supervisor.is_over());
}

#[test]
fn children_interrupted_from_outside_are_restarted() {
    let interrupted = ExitReason::Exit { code: 130, last_line: None };
    let mut supervisor = started(1);
    let ended = supervisor.ended(0, interrupted.clone(), s(0)).unwrap();
    assert_eq!(ended.then, ChildState::BackingOff { left: s(1) });
    supervisor.due_actions(s(1));
    supervisor.stop(s(1));
    assert_eq!(supervisor.ended(0, crash(), s(1)).unwrap().then, ChildState::Exited);
    assert_eq!(status(&supervisor, 0, s(1)).last_failure, Some(crash()));
    let mut supervisor = started(1);
    supervisor.stop(s(1));
    supervisor.ended(0, interrupted, s(1));
    assert_eq!(status(&supervisor, 0, s(1)).last_failure, None, "it ended as requested");
}

#[test]
fn a_child_that_cannot_be_started_counts_as_failed() {
    let mut supervisor = started(1);
    let reason = ExitReason::StartFailed { reason: "no such program".to_owned(), is_shortage: false };
    let ended = supervisor.ended(0, reason.clone(), s(0)).unwrap();
    assert_eq!(ended, ChildExit { incarnation: 1, reason, then: ChildState::BackingOff { left: s(1) } });
    assert_eq!(supervisor.due_actions(s(1)), [start(0, 2)]);
}

#[test]
fn starts_without_resources_are_retried_forever() {
    let mut supervisor = started(1);
    let shortage = || ExitReason::StartFailed { reason: "too many open files".to_owned(), is_shortage: true };
    let mut now = s(0);
    for (incarnation, pause) in (2..).zip([1, 2, 4].into_iter().chain([6; 100])) {
        let ended = supervisor.ended(0, shortage(), now).unwrap();
        assert_eq!(ended.then, ChildState::BackingOff { left: s(pause) }, "{incarnation}");
        now += s(pause);
        assert_eq!(supervisor.due_actions(now), [start(0, incarnation)]);
    }
    assert_eq!(status(&supervisor, 0, now).last_failure, Some(shortage()));
    // None of this counts as a failure of the child.
    for pause in [1, 2, 4, 6, 6] {
        assert_eq!(
            supervisor.ended(0, crash(), now).unwrap().then,
            ChildState::BackingOff { left: s(pause) }
        );
        now += s(pause);
        supervisor.due_actions(now);
    }
    assert_eq!(supervisor.ended(0, crash(), now).unwrap().then, ChildState::Failed);
}

#[test]
fn running_processes_are_adopted() {
    let mut supervisor = Supervisor::new(2, LIMITS);
    assert!(supervisor.adopt(1, s(0)));
    assert!(!supervisor.adopt(1, s(0)), "it has one");
    assert!(!supervisor.adopt(2, s(0)), "no such child");
    assert_eq!(supervisor.due_actions(s(0)), [start(0, 1)]);
    assert!(!supervisor.adopt(0, s(0)), "it was started");
    supervisor.heartbeat(0, s(100));
    assert_eq!(
        supervisor.due_actions(s(120)),
        [SupervisorAction::Kill { number: 1 }],
        "it must speak like any other"
    );
    let ended = supervisor.ended(1, ExitReason::Unknown, s(120)).unwrap();
    assert_eq!((ended.incarnation, ended.reason), (0, ExitReason::Unresponsive(s(120))));
    assert!(!supervisor.adopt(1, s(120)), "its next process is one of ours");
    assert_eq!(supervisor.due_actions(s(121)), [start(1, 1)]);
    assert_eq!(status(&supervisor, 1, s(121)).restarts, 1);
}

#[test]
fn very_large_limits_do_not_overflow() {
    let limits = Limits {
        heartbeat_timeout: Duration::MAX,
        max_backoff: Duration::MAX,
        max_restarts: u32::MAX,
        ..LIMITS
    };
    let mut supervisor = Supervisor::new(1, limits);
    for _ in 0..100 {
        supervisor.due_actions(supervisor.next_deadline().unwrap());
        supervisor.ended(0, crash(), s(1)).unwrap();
    }
    assert_eq!(status(&supervisor, 0, s(0)).restarts, 99);
}

#[test]
fn a_campaign_without_walks_ends_immediately() {
    assert!(Supervisor::new(0, LIMITS).is_over());
}

const CHILDREN: u32 = 3;

#[derive(Clone, Debug)]
enum Happening {
    Pass(Duration),
    Heard(u32),
    Useful(u32),
    Ended(u32, ExitReason),
    Adopted(u32),
    Stop,
}

fn happening() -> impl Strategy<Value = Happening> {
    // One number more than there are children.
    let number = 0..=CHILDREN;
    let reason = prop_oneof![
        4 => Just(crash()),
        2 => Just(signal(9)),
        1 => Just(finished()),
        1 => Just(ExitReason::Unknown),
        1 => any::<bool>().prop_map(|is_shortage| ExitReason::StartFailed { reason: String::new(), is_shortage }),
    ];
    prop_oneof![
        8 => (0u64..20_000).prop_map(|ms| Happening::Pass(Duration::from_millis(ms))),
        1 => (0u64..200).prop_map(|s| Happening::Pass(Duration::from_secs(s))),
        4 => number.clone().prop_map(Happening::Heard),
        1 => number.clone().prop_map(Happening::Useful),
        8 => (number.clone(), reason).prop_map(|(number, reason)| Happening::Ended(number, reason)),
        1 => number.prop_map(Happening::Adopted),
        1 => Just(Happening::Stop),
    ]
}

/// The actual processes, and the invariants of actions on them.
#[derive(Default)]
struct World {
    now: Duration,
    alive: BTreeMap<u32, bool>,
    incarnation: BTreeMap<u32, u32>,
    unrewarded: BTreeMap<u32, u32>,
    stopped: bool,
}

impl World {
    fn obey(&mut self, actions: Vec<SupervisorAction>) {
        for action in actions {
            match action {
                SupervisorAction::Start { number, incarnation } => {
                    assert!(!self.stopped, "a start after the stop");
                    assert!(number < CHILDREN);
                    assert_eq!(self.alive.insert(number, false), None, "two processes of number {number}");
                    let before = self.incarnation.insert(number, incarnation).unwrap_or(0);
                    assert_eq!(incarnation, before + 1);
                    let starts = self.unrewarded.entry(number).or_default();
                    *starts += 1;
                    assert!(*starts <= LIMITS.max_restarts + 1, "started too often");
                }
                SupervisorAction::Terminate { number } => assert_eq!(self.alive.get(&number), Some(&false)),
                SupervisorAction::Kill { number } => {
                    assert_eq!(self.alive.insert(number, true), Some(false), "one kill for one process");
                }
            }
        }
    }

    fn happen(&mut self, supervisor: &mut Supervisor, happening: Happening) {
        match happening {
            Happening::Pass(time) => self.now += time,
            Happening::Heard(number) => supervisor.heartbeat(number, self.now),
            Happening::Useful(number) => {
                supervisor.delivered(number, self.now);
                self.unrewarded.insert(number, 0);
            }
            Happening::Ended(number, reason) => {
                let was_alive = self.alive.remove(&number).is_some();
                if was_alive && matches!(reason, ExitReason::StartFailed { is_shortage: true, .. }) {
                    // It may be restarted any number of times.
                    let starts = self.unrewarded.entry(number).or_default();
                    *starts = starts.saturating_sub(1);
                }
                assert_eq!(supervisor.ended(number, reason, self.now).is_some(), was_alive);
            }
            Happening::Adopted(number) => {
                if supervisor.adopt(number, self.now) {
                    assert!(!self.stopped && !self.incarnation.contains_key(&number));
                    assert_eq!(self.alive.insert(number, false), None);
                }
            }
            Happening::Stop => {
                self.stopped = true;
                let actions = supervisor.stop(self.now);
                self.obey(actions);
            }
        }
        let actions = supervisor.due_actions(self.now);
        self.obey(actions);
        // Otherwise sleeping until then would be a busy loop.
        assert!(supervisor.next_deadline().is_none_or(|next| next > self.now));
        assert!(!supervisor.is_over() || self.alive.is_empty());
    }
}

proptest! {
    #[test]
    fn invariants_hold_for_any_order_of_events(happenings in prop::collection::vec(happening(), 0..200)) {
        let mut supervisor = Supervisor::new(CHILDREN, LIMITS);
        let mut world = World::default();
        for happening in happenings {
            world.happen(&mut supervisor, happening);
        }
        // After a stop, every process has exited or is killed at the end of the grace period.
        world.happen(&mut supervisor, Happening::Stop);
        world.happen(&mut supervisor, Happening::Pass(LIMITS.grace_period));
        assert!(world.alive.values().all(|killed| *killed));
        for number in 0..CHILDREN {
            world.happen(&mut supervisor, Happening::Ended(number, signal(9)));
        }
        assert!(supervisor.is_over() && supervisor.next_deadline().is_none());
    }

    #[test]
    fn children_that_always_fail_are_not_restarted_forever(deaths in prop::collection::vec(0u64..200, 18)) {
        let mut supervisor = Supervisor::new(CHILDREN, LIMITS);
        let mut deaths = deaths.into_iter();
        let mut starts = 0;
        while let Some(now) = supervisor.next_deadline() {
            for action in supervisor.due_actions(now) {
                match action {
                    SupervisorAction::Start { number, .. } => {
                        starts += 1;
                        let death = now + Duration::from_millis(deaths.next().unwrap());
                        supervisor.ended(number, crash(), death).unwrap();
                    }
                    other => panic!("{other:?}"),
                }
            }
        }
        assert!(supervisor.is_over());
        assert_eq!(starts, CHILDREN * (LIMITS.max_restarts + 1));
        assert!(supervisor.status(s(0)).all(|child| child.state == ChildState::Failed));
    }
}
