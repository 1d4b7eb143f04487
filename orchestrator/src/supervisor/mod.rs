//! The supervisor: which of a numbered set of processes is to be started, told to end, or killed, and when.
//!
//! A pure, synchronous core: what happened to the processes goes in, orders come out. It reads no clock and knows
//! no process; every time is one since a fixed instant of whoever asks, [`crate::launcher::Children`] say.
//!
//! A child that ended without having been sent home is started again after a pause, which doubles with each failure in a
//! row. Being useful (a delivered report, a label) ends the row: a sign of life alone does not, or a child that dies
//! of its first piece of work would be started for ever.
//!
//! A start that fails because the host lacks descriptors, processes or memory says nothing about the child: it is tried again,
//! after pauses that double likewise, and never ends in giving up.

mod child;
mod ending;

use std::time::Duration;

use child::{Child, State};
pub use ending::Ending;

/// How patient a supervisor is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// A child that gave no sign of life for so long, from its start on, hangs and is killed.
    pub silence: Duration,
    /// Pause before the start after a first failure; it doubles with each further one in a row.
    pub first_pause: Duration,
    /// No pause is longer.
    pub longest_pause: Duration,
    /// A child is started again so many times in a row without having been useful; the failure after that is its last.
    pub restarts: u32,
    /// What is left so long after it was told to end is killed; if it outlives its parent, it is left to itself.
    pub grace: Duration,
    /// The children work for the campaign, not for the parent: they may go on without it, and one that leaves while
    /// there is work has failed, whatever its exit code.
    pub outlives: bool,
}

impl Default for Limits {
    fn default() -> Self {
        let seconds = Duration::from_secs;
        Self {
            silence: seconds(120),
            first_pause: seconds(1),
            longest_pause: seconds(60),
            restarts: 5,
            grace: seconds(30),
            outlives: false,
        }
    }
}

/// What is to be done with a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// Start it. It counts as started from here on; if that fails, it has ended as [`Ending::NotStarted`].
    Start {
        /// Which child.
        number: u32,
        /// The how-manieth start of this child, from 1: never the same twice.
        incarnation: u32,
    },
    /// Ask it to end in order (SIGTERM).
    Terminate {
        /// Which child.
        number: u32,
    },
    /// End it (SIGKILL).
    Kill {
        /// Which child.
        number: u32,
    },
}

/// Where a child stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Started, and not heard of yet.
    Starting,
    /// At work.
    Running,
    /// To be started again in a while.
    Pausing {
        /// For so long yet.
        left: Duration,
    },
    /// Told to end, or killed, and not gone yet.
    Ending,
    /// Ended in order; it will not be started again.
    GoneHome,
    /// Failed too often in a row; it will not be started again.
    GivenUp,
}

impl std::fmt::Display for Standing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Starting => f.write_str("starting"),
            Self::Running => f.write_str("running"),
            Self::Pausing { left } => write!(f, "pausing for {} s", left.as_secs_f64().ceil()),
            Self::Ending => f.write_str("ending"),
            Self::GoneHome => f.write_str("gone home"),
            Self::GivenUp => f.write_str("given up"),
        }
    }
}

/// What there is to say of a child.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildStatus {
    /// Which child.
    pub number: u32,
    /// Starts so far; 0 if the process was adopted and is still that one.
    pub incarnation: u32,
    /// Where it stands.
    pub standing: Standing,
    /// Starts that followed a failure.
    pub restarts: u32,
    /// How it failed last, if it ever did.
    pub last_failure: Option<Ending>,
}

/// The end of a process, as the supervisor judges it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ended {
    /// Which start it was; 0 for an adopted process.
    pub incarnation: u32,
    /// How it ended: in place of the signal, why it was sent.
    pub ending: Ending,
    /// What becomes of the child: pausing, gone home or given up.
    pub then: Standing,
}

/// Watches the children of one kind, numbered from 0.
#[derive(Clone, Debug)]
pub struct Supervisor {
    limits: Limits,
    children: Vec<Child>,
    stopping: bool,
}

impl Supervisor {
    /// So many children, all of which are due to be started.
    pub fn new(children: u32, limits: Limits) -> Self {
        Self { limits, children: (0..children).map(|_| Child::default()).collect(), stopping: false }
    }

    /// Takes a living process for a child that was not started yet. Refused (`false`) when there is no such child,
    /// when it was started before, and after a stop.
    pub fn adopt(&mut self, number: u32, now: Duration) -> bool {
        match self.child(number) {
            Some(child) if child.is_fresh() => {
                child.state = State::Running { heard: now, yet: false };
                true
            }
            _ => false,
        }
    }

    /// A sign of life.
    pub fn heard(&mut self, number: u32, now: Duration) {
        // Signs of a process that is dead or being killed come late and mean nothing.
        if let Some(State::Running { heard, yet }) = self.child(number).map(|child| &mut child.state) {
            *heard = now.max(*heard);
            *yet = true;
        }
    }

    /// The child delivered something: whatever failed before, its next failure is a first one.
    pub fn useful(&mut self, number: u32, now: Duration) {
        self.heard(number, now);
        // It may have died since: what it delivered counts all the same.
        if let Some(child) = self.child(number) {
            child.failures = 0;
        }
    }

    /// The process of a child is gone (and reaped, if it was a child). `None` if it had none.
    pub fn ended(&mut self, number: u32, ending: Ending, now: Duration) -> Option<Ended> {
        let (limits, stopping) = (self.limits, self.stopping);
        let child = self.child(number)?;
        let ending = child.judge(ending)?;
        child.leave(&ending, &limits, stopping, now);
        Some(Ended { incarnation: child.incarnation, ending, then: child.standing(now) })
    }

    /// There is no more work: nothing is started any more.
    pub fn close(&mut self) {
        self.stopping = true;
        for child in &mut self.children {
            if let State::Waiting { .. } = child.state {
                child.state = State::Home;
            }
        }
    }

    /// The whole set is to end: nothing is started any more, what runs is told to end, and killed by [`Self::due`]
    /// when its time of grace is over.
    pub fn stop(&mut self, now: Duration) -> Vec<Order> {
        self.close();
        let mut orders = Vec::new();
        for (number, child) in (0..).zip(&mut self.children) {
            if let State::Running { .. } = child.state {
                child.state = State::Leaving { since: now };
                orders.push(Order::Terminate { number });
            }
        }
        orders
    }

    /// What is due by now. To be asked at [`Self::next`], and after anything else that happened.
    pub fn due(&mut self, now: Duration) -> Vec<Order> {
        let limits = self.limits;
        if self.overslept(now) {
            self.listen_anew(now);
        }
        let due = |(number, child): (u32, &mut Child)| child.due(number, &limits, now);
        (0..).zip(&mut self.children).filter_map(due).collect()
    }

    /// When something will be due if nothing happens until then.
    pub fn next(&self) -> Option<Duration> {
        self.children.iter().filter_map(|child| child.next(&self.limits)).min()
    }

    /// Whether no process is left and none will be started.
    pub fn is_over(&self) -> bool {
        self.children.iter().all(|child| matches!(child.state, State::Home | State::GivenUp))
    }

    /// Where each of the children stands.
    pub fn status(&self, now: Duration) -> impl Iterator<Item = ChildStatus> {
        (0..).zip(&self.children).map(move |(number, child)| child.status(number, now))
    }

    fn child(&mut self, number: u32) -> Option<&mut Child> {
        self.children.get_mut(usize::try_from(number).ok()?)
    }

    /// Whether whoever was to ask at [`Self::next`] was itself held up, by Ctrl-Z or a host that was suspended.
    /// Nobody listened in that time, so that no silence is proved.
    fn overslept(&self, now: Duration) -> bool {
        self.next().is_some_and(|due| now.saturating_sub(due) > self.limits.silence / 10)
    }

    fn listen_anew(&mut self, now: Duration) {
        for child in &mut self.children {
            if let State::Running { heard, .. } = &mut child.state {
                *heard = now;
            }
        }
    }
}
