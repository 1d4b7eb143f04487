//! The supervisor: decides which of a numbered set of processes to start, stop or kill, and when.
//!
//! A pure, synchronous core: events of the processes go in, actions come out. It reads no clock and handles no process;
//! all times are relative to a fixed instant chosen by the caller, for example [`crate::launcher::Children`].
//!
//! A child that exits before its work is finished is restarted after a backoff, which doubles with each consecutive
//! failure. A delivery (a report, a label) resets the count of failures. A heartbeat does not, or a child that crashes
//! in its first piece of work would be restarted forever.
//!
//! If a start fails because the host lacks file descriptors, processes or memory, this says nothing about the child:
//! the start is repeated with the same doubling backoff, without limit.

mod action;
mod child;
mod child_status;
mod exit_reason;
mod limits;

use std::time::Duration;

pub use action::SupervisorAction;
use child::{Child, ChildPhase};
pub use child_status::{ChildState, ChildStatus};
pub use exit_reason::ExitReason;
pub use limits::Limits;

/// The exit of a process, as the supervisor interprets it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildExit {
    /// Start count of the process; 0 for an adopted process.
    pub incarnation: u32,
    /// Why it exited; if it was killed, why.
    pub reason: ExitReason,
    /// State of the child after the exit: backing off, exited or failed.
    pub then: ChildState,
}

/// Supervises the children of one kind, numbered from 0.
#[derive(Clone, Debug)]
pub struct Supervisor {
    limits: Limits,
    children: Vec<Child>,
    stopping: bool,
}

impl Supervisor {
    /// This number of children, all due to be started.
    pub fn new(children: u32, limits: Limits) -> Self {
        Self { limits, children: (0..children).map(|_| Child::default()).collect(), stopping: false }
    }

    /// Adopts a running process as a child that was never started. Returns `false` if there is no such child, if it was
    /// started before, or after a stop.
    pub fn adopt(&mut self, number: u32, now: Duration) -> bool {
        match self.child(number) {
            Some(child) if child.is_fresh() => {
                child.phase = ChildPhase::Running { last_heartbeat: now, has_heartbeat: false };
                true
            }
            _ => false,
        }
    }

    /// Records a heartbeat.
    pub fn heartbeat(&mut self, number: u32, now: Duration) {
        // Late heartbeats of a process that is dead or being killed mean nothing.
        if let Some(ChildPhase::Running { last_heartbeat, has_heartbeat }) =
            self.child(number).map(|child| &mut child.phase)
        {
            *last_heartbeat = now.max(*last_heartbeat);
            *has_heartbeat = true;
        }
    }

    /// Records a delivery, which resets the count of failures.
    pub fn delivered(&mut self, number: u32, now: Duration) {
        self.heartbeat(number, now);
        // The process may have died since; its delivery still counts.
        if let Some(child) = self.child(number) {
            child.failures = 0;
        }
    }

    /// Records that a child's process has exited (and was waited for, if it was a child process). `None` if it had
    /// none.
    pub fn ended(&mut self, number: u32, reason: ExitReason, now: Duration) -> Option<ChildExit> {
        let (limits, stopping) = (self.limits, self.stopping);
        let child = self.child(number)?;
        let reason = child.exit_reason(reason)?;
        child.exited(&reason, &limits, stopping, now);
        Some(ChildExit { incarnation: child.incarnation, reason, then: child.public_state(now) })
    }

    /// There is no more work: starts no more processes.
    pub fn close(&mut self) {
        self.stopping = true;
        for child in &mut self.children {
            if let ChildPhase::Waiting { .. } = child.phase {
                child.phase = ChildPhase::Exited;
            }
        }
    }

    /// Stops all children: starts no more processes and asks the running ones to exit. [`Self::due_actions`] kills them
    /// after the grace period.
    pub fn stop(&mut self, now: Duration) -> Vec<SupervisorAction> {
        self.close();
        let mut actions = Vec::new();
        for (number, child) in (0..).zip(&mut self.children) {
            if let ChildPhase::Running { .. } = child.phase {
                child.phase = ChildPhase::Stopping { since: now };
                actions.push(SupervisorAction::Terminate { number });
            }
        }
        actions
    }

    /// The actions that are due. Call it at [`Self::next_deadline`], and after every other event.
    pub fn due_actions(&mut self, now: Duration) -> Vec<SupervisorAction> {
        let limits = self.limits;
        if self.was_suspended(now) {
            self.reset_heartbeats(now);
        }
        let due = |(number, child): (u32, &mut Child)| child.due_action(number, &limits, now);
        (0..).zip(&mut self.children).filter_map(due).collect()
    }

    /// Time of the next action if no event happens before.
    pub fn next_deadline(&self) -> Option<Duration> {
        self.children.iter().filter_map(|child| child.next_deadline(&self.limits)).min()
    }

    /// Whether no process is running and none will be started.
    pub fn is_over(&self) -> bool {
        self.children.iter().all(|child| matches!(child.phase, ChildPhase::Exited | ChildPhase::Failed))
    }

    /// Status of all children.
    pub fn status(&self, now: Duration) -> impl Iterator<Item = ChildStatus> {
        (0..).zip(&self.children).map(move |(number, child)| child.status(number, now))
    }

    fn child(&mut self, number: u32) -> Option<&mut Child> {
        self.children.get_mut(usize::try_from(number).ok()?)
    }

    /// Whether the caller itself was suspended past [`Self::next_deadline`], by Ctrl-Z or because the host was
    /// suspended. Heartbeats were not received in that time, so their absence proves nothing.
    fn was_suspended(&self, now: Duration) -> bool {
        self.next_deadline().is_some_and(|due| now.saturating_sub(due) > self.limits.heartbeat_timeout / 10)
    }

    fn reset_heartbeats(&mut self, now: Duration) {
        for child in &mut self.children {
            if let ChildPhase::Running { last_heartbeat, .. } = &mut child.phase {
                *last_heartbeat = now;
            }
        }
    }
}
