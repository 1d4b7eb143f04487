//! The server's connections to its walkers: where answers go, what wakes whom, and a count of what came.

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

/// What came to the server.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Messages.
    pub received: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Time spent on checking and decoding them.
    pub checking: Duration,
    /// Messages that were not listened to.
    pub rejected: u64,
    /// Why the last of them was not.
    pub last_rejected: Option<String>,
    /// Answers that could not be sent; walkers ask for them again.
    pub unsent: u64,
    /// Why the last of them could not.
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
    /// Wakes the walker; made when it first speaks.
    wakeup: Option<Notifier<Service>>,
    /// Where the answer to its offer goes.
    route: Option<Arc<BorrowedRequest>>,
    /// Where the reactor's decision comes from.
    decision: Option<oneshot::Receiver<Option<WorkItem>>>,
    /// The mixture of its turn, kept until it reports.
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

    /// Removes what dead processes left behind in iceoryx2's tables.
    pub(super) fn clean(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// The answer to the walker's offer goes here.
    pub(super) fn route(&mut self, sender: SenderId, request: &Arc<BorrowedRequest>) {
        if let Some(connection) = self.walkers.get_mut(&sender.walker) {
            connection.route = Some(Arc::clone(request));
        }
    }

    /// A way for the reactor's decision. The walker has reported: the mixture of its turn may go.
    pub(super) fn decide(&mut self, sender: SenderId) -> oneshot::Sender<Option<WorkItem>> {
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

    /// Answers the walker's offer and keeps the mixture of its turn.
    pub(super) fn answer(&mut self, sender: SenderId, answer: &[u8], mixture: Option<Arc<Mixture>>) {
        let Some(connection) = self.walkers.get_mut(&sender.walker) else { return };
        connection.mixture = mixture;
        if let Some(route) = connection.route.take() {
            self.send(sender, &route, answer);
        }
    }

    /// Sends an answer and wakes the walker. If it is lost the walker asks again.
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

    /// Counts a message, how long it took, and, if it was dropped, why.
    pub(super) fn count(&self, bytes: u64, took: Duration, rejected: Option<&impl fmt::Display>) {
        let mut traffic = self.traffic.lock().unwrap_or_else(PoisonError::into_inner);
        traffic.received += 1;
        traffic.bytes += bytes;
        traffic.checking += took;
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
            Ok(0) => Err(IpcError::new("wake a walker", "nobody listens")),
            Ok(_) => Ok(()),
            Err(reason) => Err(IpcError::new("wake a walker", reason)),
        }
    }
}
