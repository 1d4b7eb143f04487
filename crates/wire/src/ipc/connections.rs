//! The server's connections to walkers: routes of answers, wakeup events, and traffic statistics.

use std::collections::BTreeMap;
use std::fmt;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use calm::Mixture;
use iceoryx2::node::Node;
use iceoryx2::port::notifier::Notifier;
use tokio::sync::oneshot;

use super::IpcError;
use super::borrowed_request::BorrowedRequest;
use super::config::{self, Service};
use crate::protocol::frame;
use crate::protocol::message::SenderId;
use crate::transport::WorkItem;

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

pub(super) struct Connections {
    node: Node<Service>,
    walkers: BTreeMap<u32, Connection>,
    traffic: Arc<Mutex<Traffic>>,
    message_bytes: usize,
}

#[derive(Default)]
struct Connection {
    /// Wakes the walker; opened at its first message.
    wakeup: Option<Notifier<Service>>,
    /// The request whose response channel takes the answer.
    route: Option<Arc<BorrowedRequest>>,
    /// Receives the reactor's decision.
    decision: Option<oneshot::Receiver<Option<WorkItem>>>,
    /// The mixture of the walker's assignment, kept until its report.
    mixture: Option<Arc<Mixture>>,
}

impl Connections {
    pub(super) fn new(node: Node<Service>, traffic: Arc<Mutex<Traffic>>, message_bytes: usize) -> Self {
        Self { node, walkers: BTreeMap::new(), traffic, message_bytes }
    }

    pub(super) fn open(&mut self, walker: u32) {
        self.walkers.insert(walker, Connection::default());
    }

    pub(super) fn close(&mut self, walker: u32) {
        self.walkers.remove(&walker);
    }

    /// Removes resources of dead processes from iceoryx2's tables.
    pub(super) fn clean(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// Sets the request that takes the answer to the walker's offer.
    pub(super) fn set_route(&mut self, sender: SenderId, request: &Arc<BorrowedRequest>) {
        if let Some(connection) = self.walkers.get_mut(&sender.walker) {
            connection.route = Some(Arc::clone(request));
        }
    }

    /// Creates the channel for the reactor's decision. The walker has reported, so the mixture of its assignment is
    /// released.
    pub(super) fn decision_channel(&mut self, sender: SenderId) -> oneshot::Sender<Option<WorkItem>> {
        let (reply, decision) = oneshot::channel();
        if let Some(connection) = self.walkers.get_mut(&sender.walker) {
            connection.decision = Some(decision);
            connection.mixture = None;
        }
        reply
    }

    pub(super) fn poll_decision(&mut self, context: &mut Context<'_>) -> Poll<(u32, Option<WorkItem>)> {
        for (walker, connection) in &mut self.walkers {
            let Some(receiver) = &mut connection.decision else { continue };
            if let Poll::Ready(decision) = Pin::new(receiver).poll(context) {
                connection.decision = None;
                return Poll::Ready((*walker, decision.ok().flatten()));
            }
        }
        Poll::Pending
    }

    /// Answers the walker's offer and keeps the mixture of its new assignment.
    pub(super) fn answer(&mut self, sender: SenderId, answer: &[u8], mixture: Option<Arc<Mixture>>) {
        let Some(connection) = self.walkers.get_mut(&sender.walker) else { return };
        connection.mixture = mixture;
        if let Some(route) = connection.route.take() {
            self.send(sender, &route, answer);
        }
    }

    /// Sends an answer and wakes the walker. If the answer is lost, the walker polls again.
    pub(super) fn send(&mut self, sender: SenderId, route: &BorrowedRequest, answer: &[u8]) {
        let Some(connection) = self.walkers.get_mut(&sender.walker) else { return };
        let sent = config::check_free_space(frame::length(answer.len(), None), self.message_bytes)
            .and_then(|()| route.answer(answer))
            .and_then(|()| connection.wake(&self.node, sender));
        if let Err(reason) = sent {
            let mut traffic = self.traffic.lock().unwrap_or_else(PoisonError::into_inner);
            traffic.unsent += 1;
            traffic.last_unsent = Some(reason.to_string());
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

impl Connection {
    fn wake(&mut self, node: &Node<Service>, sender: SenderId) -> Result<(), IpcError> {
        let wakeup = match &self.wakeup {
            Some(wakeup) => wakeup,
            None => self.wakeup.insert(config::open_walker_wakeup(node, sender)?),
        };
        match wakeup.notify() {
            Ok(0) => Err(IpcError::new("wake a walker", "it has no listener")),
            Ok(_) => Ok(()),
            Err(reason) => Err(IpcError::new("wake a walker", reason)),
        }
    }
}
