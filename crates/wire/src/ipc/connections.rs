//! The server's connections to walkers: answers, wakeup events, candidates in place, and traffic statistics.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::notifier::Notifier;

use super::IpcError;
use super::borrowed_request::BorrowedRequest;
use super::config::{self, MAX_IN_PLACE, MAX_IN_PLACE_TOTAL, Service};
use crate::block::{BlockError, CandidateBlock};
use crate::control::encode;
use crate::protocol::frame;
use crate::protocol::message::{Answer, SenderId};
use crate::protocol::server_session::ServerTransport;

/// Statistics of received messages.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Number of messages.
    pub received: u64,
    /// Their total size, bytes.
    pub bytes: u64,
    /// Time spent validating and decoding them.
    pub checking: Duration,
    /// Number of rejected messages.
    pub rejected: u64,
    /// Reason of the last rejection.
    pub last_rejected: Option<String>,
    /// Number of answers that could not be sent; walkers poll for them.
    pub unsent: u64,
    /// Reason of the last failure.
    pub last_unsent: Option<String>,
}

pub(super) struct WalkerConnections {
    node: Node<Service>,
    /// Wakes each walker; opened at its first answer.
    wakeups: BTreeMap<u32, Notifier<Service>>,
    /// Candidates that may still be read in place.
    in_place: Vec<(SenderId, Weak<BorrowedRequest>)>,
    traffic: Arc<Mutex<Traffic>>,
    message_bytes: usize,
}

impl ServerTransport for WalkerConnections {
    type Request = Arc<BorrowedRequest>;

    /// The answer to a poll is the server's sign of life.
    const HOLDS_POLLS: bool = false;

    fn encode(answer: Answer<'_>) -> Vec<u8> {
        encode(&answer)
    }

    /// Also wakes the walker.
    fn send(&mut self, sender: SenderId, request: &Self::Request, answer: &[u8]) {
        let sent = config::check_free_space(frame::length(answer.len(), None), self.message_bytes)
            .and_then(|()| request.answer(answer))
            .and_then(|()| self.wake(sender));
        if let Err(reason) = sent {
            let mut traffic = self.traffic.lock().unwrap_or_else(PoisonError::into_inner);
            traffic.unsent += 1;
            traffic.last_unsent = Some(reason.to_string());
        }
    }

    /// Read in place unless too many are already.
    fn candidate(
        &mut self,
        sender: SenderId,
        request: &Self::Request,
        block: &[u8],
    ) -> Result<CandidateBlock, BlockError> {
        self.in_place.retain(|(_, request)| request.strong_count() > 0);
        let of_sender = self.in_place.iter().filter(|(of, _)| *of == sender).count();
        if of_sender >= MAX_IN_PLACE || self.in_place.len() >= MAX_IN_PLACE_TOTAL {
            return CandidateBlock::from_bytes(block);
        }
        let candidate = CandidateBlock::in_place(Arc::clone(request) as _)?;
        self.in_place.push((sender, Arc::downgrade(request)));
        Ok(candidate)
    }
}

impl WalkerConnections {
    pub(super) fn new(node: Node<Service>, traffic: Arc<Mutex<Traffic>>, message_bytes: usize) -> Self {
        Self { node, wakeups: BTreeMap::new(), in_place: Vec::new(), traffic, message_bytes }
    }

    /// Closes the connection to a walker that has exited, and removes the resources of dead processes from iceoryx2's
    /// tables.
    pub(super) fn close(&mut self, walker: u32) {
        self.wakeups.remove(&walker);
        self.node.try_cleanup_dead_nodes();
    }

    fn wake(&mut self, sender: SenderId) -> Result<(), IpcError> {
        let wakeup = match self.wakeups.entry(sender.walker) {
            Entry::Occupied(wakeup) => wakeup.into_mut(),
            Entry::Vacant(vacant) => vacant.insert(config::open_walker_wakeup(&self.node, sender)?),
        };
        match wakeup.notify() {
            Ok(0) => Err(IpcError::new("wake a walker", "it has no listener")),
            Ok(_) => Ok(()),
            Err(reason) => Err(IpcError::new("wake a walker", reason)),
        }
    }

    /// Counts a message, the time spent on it, and the reason if it was rejected.
    pub(super) fn record_message(&self, bytes: u64, time: Duration, rejected: Option<&impl fmt::Display>) {
        let mut traffic = self.traffic.lock().unwrap_or_else(PoisonError::into_inner);
        traffic.received += 1;
        traffic.bytes += bytes;
        traffic.checking += time;
        if let Some(reason) = rejected {
            traffic.rejected += 1;
            traffic.last_rejected = Some(reason.to_string());
        }
    }
}
