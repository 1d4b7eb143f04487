//! What an agent does with its slots: exchanges that are under way, registrations that are lost and made again. No network,
//! no clock.

use wire::net::{Slot, SlotReport};
use wire::transport::{Incoming, WorkItem};

use super::pool::AssignmentPool;

/// The exchanges of an agent. `S` is a slot, `M` a registration.
#[derive(Debug)]
pub struct AgentCore<M, S = Slot> {
    pub(super) pool: AssignmentPool<S>,
    /// Exchanges under way.
    in_flight: usize,
    /// Those of them that deliver something.
    delivering: usize,
    /// Whether a new registration is requested, after this one was lost …
    is_joining: bool,
    /// … which takes effect when every exchange of the old one is complete.
    next_joined: Option<M>,
}

/// How an exchange about a slot ended.
#[derive(Debug)]
pub enum ExchangeEnd {
    /// The next assignment.
    Work(Box<WorkItem>),
    /// The slot gets no more work.
    Closed,
    /// The registration is lost.
    RejoinRequired,
}

impl<M, S> Default for AgentCore<M, S> {
    fn default() -> Self {
        let pool = AssignmentPool::default();
        Self { pool, in_flight: 0, delivering: 0, is_joining: false, next_joined: None }
    }
}

impl<M, S> AgentCore<M, S> {
    /// Starts with the slots of a registration. Returns the exchanges to begin.
    pub fn start(&mut self, slots: Vec<S>) -> Vec<(S, SlotReport)> {
        let first = self.pool.start(slots);
        first.iter().for_each(|(_, report)| self.begins(report));
        first
    }

    /// Handles a message of a walker. Returns the exchange to begin.
    pub fn handle(&mut self, message: Incoming) -> Option<(S, SlotReport)> {
        let next = match message {
            Incoming::Idle { walker, report, reply } => self.pool.walker_idle(walker, report, reply),
            Incoming::Lost { walker, crashed } => self.pool.walker_lost(walker, crashed),
            Incoming::Progress(..) => None,
        };
        next.iter().for_each(|(_, report)| self.begins(report));
        next
    }

    fn begins(&mut self, report: &SlotReport) {
        self.in_flight += 1;
        self.delivering += usize::from(!matches!(report, SlotReport::Empty));
    }

    /// Handles the end of an exchange. Returns whether to request a new registration now.
    pub fn exchanged(&mut self, slot: S, report: SlotReport, end: ExchangeEnd) -> bool {
        self.flushed(&report);
        match end {
            ExchangeEnd::Work(work) => self.pool.assign(slot, *work),
            ExchangeEnd::Closed => self.pool.slot_closed(),
            ExchangeEnd::RejoinRequired => {
                self.pool.keep_unsent(report);
                return self.rejoin();
            }
        }
        false
    }

    /// Handles the end of an exchange of an agent that ends.
    pub(super) fn flushed(&mut self, report: &SlotReport) {
        self.in_flight -= 1;
        self.delivering -= usize::from(!matches!(report, SlotReport::Empty));
    }

    /// The registration is lost: this agent was taken for dead, or the orchestrator was restarted. Waiting reports are
    /// delivered under the new one. Returns whether to request it now.
    pub fn rejoin(&mut self) -> bool {
        self.next_joined.is_none() && !std::mem::replace(&mut self.is_joining, true)
    }

    /// Handles a new registration.
    pub fn has_joined(&mut self, joined: M) {
        self.is_joining = false;
        self.next_joined = Some(joined);
    }

    /// The new registration, once every exchange of the old one is complete: [`Self::start`] with its slots.
    pub fn take_joined(&mut self) -> Option<M> {
        self.next_joined.take_if(|_| self.in_flight == 0)
    }

    /// Reports that the orchestrator has not accepted yet.
    pub fn unsent(&self) -> usize {
        self.delivering + self.pool.unsent()
    }

    /// Exchanges that deliver something.
    pub(super) fn delivering(&self) -> usize {
        self.delivering
    }

    /// Whether no work is left.
    pub fn is_over(&self) -> bool {
        self.pool.is_over()
    }

    /// Dismisses the waiting walkers.
    pub fn dismiss_idle(&mut self) {
        self.pool.dismiss_idle();
    }
}
