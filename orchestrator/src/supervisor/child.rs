//! State of one child process.

use std::time::Duration;

use super::action::SupervisorAction;
use super::child_status::{ChildState, ChildStatus};
use super::exit_reason::ExitReason;
use super::limits::Limits;

/// What a child is doing, with the times that determine its next action.
#[derive(Clone, Copy, Debug)]
pub(super) enum ChildPhase {
    /// No process; start one at this time.
    Waiting { until: Duration },
    /// A process with its last heartbeat, or its start time if `has_heartbeat` is false.
    Running { last_heartbeat: Duration, has_heartbeat: bool },
    /// The process was asked to exit.
    Stopping { since: Duration },
    /// The process was killed, with the reason.
    Killed { reason: KillReason },
    /// No process: it exited normally.
    Exited,
    /// No process: it failed too often.
    Failed,
}

/// Why a process was killed.
#[derive(Clone, Copy, Debug)]
pub(super) enum KillReason {
    Unresponsive(Duration),
    StopTimeout(Duration),
}

#[derive(Clone, Debug)]
pub(super) struct Child {
    pub phase: ChildPhase,
    /// Number of starts.
    pub incarnation: u32,
    /// Consecutive failures without a delivery.
    pub failures: u32,
    /// Consecutive starts that failed because of a shortage of resources on the host. They are not failures of the
    /// child.
    shortages: u32,
    restarts: u32,
    last_failure: Option<ExitReason>,
}

impl Default for Child {
    fn default() -> Self {
        let phase = ChildPhase::Waiting { until: Duration::ZERO };
        Self { phase, incarnation: 0, failures: 0, shortages: 0, restarts: 0, last_failure: None }
    }
}

impl Child {
    /// Whether it never had a process and can still have one.
    pub fn is_fresh(&self) -> bool {
        self.incarnation == 0
            && self.last_failure.is_none()
            && matches!(self.phase, ChildPhase::Waiting { .. })
    }

    /// Why its process exited; if it was killed, the reason for that. `None` if it had no process.
    pub fn exit_reason(&self, reason: ExitReason) -> Option<ExitReason> {
        match self.phase {
            ChildPhase::Running { .. } | ChildPhase::Stopping { .. } => Some(reason),
            // It may have exited by itself just before the signal.
            ChildPhase::Killed { .. }
                if !matches!(reason, ExitReason::Signal { signal: 9, .. } | ExitReason::Unknown) =>
            {
                Some(reason)
            }
            ChildPhase::Killed { reason: KillReason::Unresponsive(silence) } => {
                Some(ExitReason::Unresponsive(silence))
            }
            ChildPhase::Killed { reason: KillReason::StopTimeout(grace) } => {
                Some(ExitReason::StopTimeout(grace))
            }
            ChildPhase::Waiting { .. } | ChildPhase::Exited | ChildPhase::Failed => None,
        }
    }

    /// Determines the next state after its process has exited.
    pub fn exited(&mut self, reason: &ExitReason, limits: &Limits, stopping: bool, now: Duration) {
        let may_leave = stopping || !limits.detached;
        let failed = !(may_leave && reason.is_success() || stopping && reason.is_expected_after_stop());
        self.shortages = if reason.is_shortage() { self.shortages.saturating_add(1) } else { 0 };
        if failed {
            self.failures = self.failures.saturating_add(u32::from(!reason.is_shortage()));
            self.last_failure = Some(reason.clone());
        }
        self.phase = if stopping || !failed {
            ChildPhase::Exited
        } else if self.shortages > 0 {
            ChildPhase::Waiting { until: now.saturating_add(backoff(limits, self.shortages)) }
        } else if self.failures > limits.max_restarts {
            ChildPhase::Failed
        } else {
            ChildPhase::Waiting { until: now.saturating_add(backoff(limits, self.failures)) }
        };
    }

    /// The action that is due, which then counts as done.
    pub fn due_action(&mut self, number: u32, limits: &Limits, now: Duration) -> Option<SupervisorAction> {
        if self.next_deadline(limits).is_none_or(|due| due > now) {
            return None;
        }
        let (phase, action) = match self.phase {
            ChildPhase::Waiting { .. } => {
                self.incarnation += 1;
                self.restarts += u32::from(self.last_failure.is_some());
                let start = SupervisorAction::Start { number, incarnation: self.incarnation };
                (ChildPhase::Running { last_heartbeat: now, has_heartbeat: false }, start)
            }
            ChildPhase::Running { .. } => (
                ChildPhase::Killed { reason: KillReason::Unresponsive(limits.heartbeat_timeout) },
                SupervisorAction::Kill { number },
            ),
            ChildPhase::Stopping { .. } if limits.detached => {
                self.phase = ChildPhase::Exited;
                return None;
            }
            ChildPhase::Stopping { .. } => (
                ChildPhase::Killed { reason: KillReason::StopTimeout(limits.grace_period) },
                SupervisorAction::Kill { number },
            ),
            ChildPhase::Killed { .. } | ChildPhase::Exited | ChildPhase::Failed => return None,
        };
        self.phase = phase;
        Some(action)
    }

    /// Time of the next action.
    pub fn next_deadline(&self, limits: &Limits) -> Option<Duration> {
        match self.phase {
            ChildPhase::Waiting { until } => Some(until),
            ChildPhase::Running { last_heartbeat, .. } => {
                Some(last_heartbeat.saturating_add(limits.heartbeat_timeout))
            }
            ChildPhase::Stopping { since } => Some(since.saturating_add(limits.grace_period)),
            ChildPhase::Killed { .. } | ChildPhase::Exited | ChildPhase::Failed => None,
        }
    }

    pub fn public_state(&self, now: Duration) -> ChildState {
        match self.phase {
            ChildPhase::Waiting { until } => ChildState::BackingOff { left: until.saturating_sub(now) },
            ChildPhase::Running { has_heartbeat: false, .. } => ChildState::Starting,
            ChildPhase::Running { has_heartbeat: true, .. } => ChildState::Running,
            ChildPhase::Stopping { .. } | ChildPhase::Killed { .. } => ChildState::Stopping,
            ChildPhase::Exited => ChildState::Exited,
            ChildPhase::Failed => ChildState::Failed,
        }
    }

    pub fn status(&self, number: u32, now: Duration) -> ChildStatus {
        ChildStatus {
            number,
            incarnation: self.incarnation,
            state: self.public_state(now),
            restarts: self.restarts,
            last_failure: self.last_failure.clone(),
        }
    }
}

/// Backoff after this number of consecutive failures; doubles up to the maximum.
fn backoff(limits: &Limits, failures: u32) -> Duration {
    let doublings = 1u32.checked_shl(failures.saturating_sub(1)).unwrap_or(u32::MAX);
    limits.initial_backoff.saturating_mul(doublings).min(limits.max_backoff)
}
