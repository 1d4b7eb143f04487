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
mod exit_reason;

use std::time::Duration;

use child::{Child, State};
pub use exit_reason::ExitReason;

/// How patient a supervisor is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// A child that gave no sign of life for so long, from its start on, hangs and is killed.
    pub heartbeat_timeout: Duration,
    /// Pause before the start after a first failure; it doubles with each further one in a row.
    pub initial_backoff: Duration,
    /// No pause is longer.
    pub max_backoff: Duration,
    /// A child is started again so many times in a row without having been useful; the failure after that is its last.
    pub max_restarts: u32,
    /// What is left so long after it was told to end is killed; if it outlives its parent, it is left to itself.
    pub grace_period: Duration,
    /// The children work for the campaign, not for the parent: they may go on without it, and one that leaves while
    /// there is work has failed, whatever its exit code.
    pub detached: bool,
}

impl Default for Limits {
    fn default() -> Self {
        let seconds = Duration::from_secs;
        Self {
            heartbeat_timeout: seconds(120),
            initial_backoff: seconds(1),
            max_backoff: seconds(60),
            max_restarts: 5,
            grace_period: seconds(30),
            detached: false,
        }
    }
}

/// What is to be done with a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Start it. It counts as started from here on; if that fails, it has ended as [`ExitReason::StartFailed`].
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
pub enum ChildState {
    /// Started, and not heard of yet.
    Starting,
    /// At work.
    Running,
    /// To be started again in a while.
    BackingOff {
        /// For so long yet.
        left: Duration,
    },
    /// Told to end, or killed, and not gone yet.
    Stopping,
    /// Ended in order; it will not be started again.
    Exited,
    /// Failed too often in a row; it will not be started again.
    Failed,
}

impl std::fmt::Display for ChildState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Starting => f.write_str("starting"),
            Self::Running => f.write_str("running"),
            Self::BackingOff { left } => write!(f, "pausing for {} s", left.as_secs_f64().ceil()),
            Self::Stopping => f.write_str("ending"),
            Self::Exited => f.write_str("gone home"),
            Self::Failed => f.write_str("given up"),
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
    pub state: ChildState,
    /// Starts that followed a failure.
    pub restarts: u32,
    /// How it failed last, if it ever did.
    pub last_failure: Option<ExitReason>,
}

/// The end of a process, as the supervisor judges it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildExit {
    /// Which start it was; 0 for an adopted process.
    pub incarnation: u32,
    /// How it ended: in place of the signal, why it was sent.
    pub reason: ExitReason,
    /// What becomes of the child: pausing, gone home or given up.
    pub then: ChildState,
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
    pub fn heartbeat(&mut self, number: u32, now: Duration) {
        // Signs of a process that is dead or being killed come late and mean nothing.
        if let Some(State::Running { heard, yet }) = self.child(number).map(|child| &mut child.state) {
            *heard = now.max(*heard);
            *yet = true;
        }
    }

    /// The child delivered something: whatever failed before, its next failure is a first one.
    pub fn delivered(&mut self, number: u32, now: Duration) {
        self.heartbeat(number, now);
        // It may have died since: what it delivered counts all the same.
        if let Some(child) = self.child(number) {
            child.failures = 0;
        }
    }

    /// The process of a child is gone (and reaped, if it was a child). `None` if it had none.
    pub fn ended(&mut self, number: u32, reason: ExitReason, now: Duration) -> Option<ChildExit> {
        let (limits, stopping) = (self.limits, self.stopping);
        let child = self.child(number)?;
        let reason = child.exit_reason(reason)?;
        child.exited(&reason, &limits, stopping, now);
        Some(ChildExit { incarnation: child.incarnation, reason, then: child.public_state(now) })
    }

    /// There is no more work: nothing is started any more.
    pub fn close(&mut self) {
        self.stopping = true;
        for child in &mut self.children {
            if let State::Waiting { .. } = child.state {
                child.state = State::Exited;
            }
        }
    }

    /// The whole set is to end: nothing is started any more, what runs is told to end, and killed by [`Self::due_actions`]
    /// when its time of grace is over.
    pub fn stop(&mut self, now: Duration) -> Vec<Action> {
        self.close();
        let mut actions = Vec::new();
        for (number, child) in (0..).zip(&mut self.children) {
            if let State::Running { .. } = child.state {
                child.state = State::Stopping { since: now };
                actions.push(Action::Terminate { number });
            }
        }
        actions
    }

    /// What is due by now. To be asked at [`Self::next_deadline`], and after anything else that happened.
    pub fn due_actions(&mut self, now: Duration) -> Vec<Action> {
        let limits = self.limits;
        if self.was_suspended(now) {
            self.reset_heartbeats(now);
        }
        let due = |(number, child): (u32, &mut Child)| child.due_action(number, &limits, now);
        (0..).zip(&mut self.children).filter_map(due).collect()
    }

    /// When something will be due if nothing happens until then.
    pub fn next_deadline(&self) -> Option<Duration> {
        self.children.iter().filter_map(|child| child.next_deadline(&self.limits)).min()
    }

    /// Whether no process is left and none will be started.
    pub fn is_over(&self) -> bool {
        self.children.iter().all(|child| matches!(child.state, State::Exited | State::Failed))
    }

    /// Where each of the children stands.
    pub fn status(&self, now: Duration) -> impl Iterator<Item = ChildStatus> {
        (0..).zip(&self.children).map(move |(number, child)| child.status(number, now))
    }

    fn child(&mut self, number: u32) -> Option<&mut Child> {
        self.children.get_mut(usize::try_from(number).ok()?)
    }

    /// Whether whoever was to ask at [`Self::next_deadline`] was itself held up, by Ctrl-Z or a host that was suspended.
    /// Nobody listened in that time, so that no silence is proved.
    fn was_suspended(&self, now: Duration) -> bool {
        self.next_deadline().is_some_and(|due| now.saturating_sub(due) > self.limits.heartbeat_timeout / 10)
    }

    fn reset_heartbeats(&mut self, now: Duration) {
        for child in &mut self.children {
            if let State::Running { heard, .. } = &mut child.state {
                *heard = now;
            }
        }
    }
}
