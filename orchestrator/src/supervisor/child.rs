//! One child: where it stands and what it waits for.

use std::time::Duration;

use super::{ChildStatus, Ending, Limits, Order, Standing};

/// Where a child stands, with the times that decide what comes next.
#[derive(Clone, Copy, Debug)]
pub(super) enum State {
    /// No process; the next start is due then.
    Waiting { until: Duration },
    /// A process that was last heard of then, if it ever was: else it was started then.
    Running { heard: Duration, yet: bool },
    /// A process that was told to end.
    Leaving { since: Duration },
    /// A process that was killed, and why.
    Killed { overdue: Overdue },
    /// No process: ended in order.
    Home,
    /// No process: failed too often.
    GivenUp,
}

/// What a process was killed for.
#[derive(Clone, Copy, Debug)]
pub(super) enum Overdue {
    Silent(Duration),
    Lingering(Duration),
}

#[derive(Clone, Debug)]
pub(super) struct Child {
    pub state: State,
    /// Starts so far.
    pub incarnation: u32,
    /// Failures in a row, without anything useful in between.
    pub failures: u32,
    /// Starts in a row that failed because the host lacked something. They do not count as failures of the child.
    shortages: u32,
    restarts: u32,
    last_failure: Option<Ending>,
}

impl Default for Child {
    fn default() -> Self {
        let state = State::Waiting { until: Duration::ZERO };
        Self { state, incarnation: 0, failures: 0, shortages: 0, restarts: 0, last_failure: None }
    }
}

impl Child {
    /// Whether it never had a process, and may have one.
    pub fn is_fresh(&self) -> bool {
        self.incarnation == 0 && self.last_failure.is_none() && matches!(self.state, State::Waiting { .. })
    }

    /// What its process ended of: of what it was killed for, if it was. `None` if it had no process.
    pub fn judge(&self, ending: Ending) -> Option<Ending> {
        match self.state {
            State::Running { .. } | State::Leaving { .. } => Some(ending),
            // It may have ended by itself just before the signal.
            State::Killed { .. } if !matches!(ending, Ending::Signal { signal: 9, .. } | Ending::Unseen) => {
                Some(ending)
            }
            State::Killed { overdue: Overdue::Silent(silence) } => Some(Ending::Silent(silence)),
            State::Killed { overdue: Overdue::Lingering(grace) } => Some(Ending::Lingering(grace)),
            State::Waiting { .. } | State::Home | State::GivenUp => None,
        }
    }

    /// Decides what becomes of it without its process.
    pub fn leave(&mut self, ending: &Ending, limits: &Limits, stopping: bool, now: Duration) {
        let may_leave = stopping || !limits.outlives;
        let failed = !(may_leave && ending.is_in_order() || stopping && ending.is_what_stop_asks_for());
        self.shortages = if ending.is_shortage() { self.shortages.saturating_add(1) } else { 0 };
        if failed {
            self.failures = self.failures.saturating_add(u32::from(!ending.is_shortage()));
            self.last_failure = Some(ending.clone());
        }
        self.state = if stopping || !failed {
            State::Home
        } else if self.shortages > 0 {
            State::Waiting { until: now.saturating_add(pause(limits, self.shortages)) }
        } else if self.failures > limits.restarts {
            State::GivenUp
        } else {
            State::Waiting { until: now.saturating_add(pause(limits, self.failures)) }
        };
    }

    /// What is due of it by now; it counts as done.
    pub fn due(&mut self, number: u32, limits: &Limits, now: Duration) -> Option<Order> {
        if self.next(limits).is_none_or(|due| due > now) {
            return None;
        }
        let (state, order) = match self.state {
            State::Waiting { .. } => {
                self.incarnation += 1;
                self.restarts += u32::from(self.last_failure.is_some());
                let start = Order::Start { number, incarnation: self.incarnation };
                (State::Running { heard: now, yet: false }, start)
            }
            State::Running { .. } => {
                (State::Killed { overdue: Overdue::Silent(limits.silence) }, Order::Kill { number })
            }
            State::Leaving { .. } if limits.outlives => {
                self.state = State::Home;
                return None;
            }
            State::Leaving { .. } => {
                (State::Killed { overdue: Overdue::Lingering(limits.grace) }, Order::Kill { number })
            }
            State::Killed { .. } | State::Home | State::GivenUp => return None,
        };
        self.state = state;
        Some(order)
    }

    /// When something will be due of it.
    pub fn next(&self, limits: &Limits) -> Option<Duration> {
        match self.state {
            State::Waiting { until } => Some(until),
            State::Running { heard, .. } => Some(heard.saturating_add(limits.silence)),
            State::Leaving { since } => Some(since.saturating_add(limits.grace)),
            State::Killed { .. } | State::Home | State::GivenUp => None,
        }
    }

    pub fn standing(&self, now: Duration) -> Standing {
        match self.state {
            State::Waiting { until } => Standing::Pausing { left: until.saturating_sub(now) },
            State::Running { yet: false, .. } => Standing::Starting,
            State::Running { yet: true, .. } => Standing::Running,
            State::Leaving { .. } | State::Killed { .. } => Standing::Ending,
            State::Home => Standing::GoneHome,
            State::GivenUp => Standing::GivenUp,
        }
    }

    pub fn status(&self, number: u32, now: Duration) -> ChildStatus {
        ChildStatus {
            number,
            incarnation: self.incarnation,
            standing: self.standing(now),
            restarts: self.restarts,
            last_failure: self.last_failure.clone(),
        }
    }
}

/// The pause after so many failures in a row: it doubles from the first to the longest.
fn pause(limits: &Limits, failures: u32) -> Duration {
    let doublings = 1u32.checked_shl(failures.saturating_sub(1)).unwrap_or(u32::MAX);
    limits.first_pause.saturating_mul(doublings).min(limits.longest_pause)
}
