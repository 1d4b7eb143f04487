//! The server's lines to its walkers: where answers go, what wakes whom, and a count of what came.

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
use super::config::{self, Service};
use super::lent::Lent;
use crate::exchange::frame;
use crate::exchange::message::Caller;
use crate::transport::Work;

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
    pub dropped: u64,
    /// Why the last of them was not.
    pub last_dropped: Option<String>,
    /// Answers that could not be sent; walkers ask for them again.
    pub unsent: u64,
    /// Why the last of them could not.
    pub last_unsent: Option<String>,
}

pub(super) struct Lines {
    node: Node<Service>,
    walkers: BTreeMap<u32, Line>,
    traffic: Arc<Mutex<Traffic>>,
    message_bytes: usize,
}

#[derive(Default)]
struct Line {
    /// Wakes the walker; made when it first speaks.
    bell: Option<Notifier<Service>>,
    /// Where the answer to its offer goes.
    route: Option<Arc<Lent>>,
    /// Where the reactor's decision comes from.
    decision: Option<oneshot::Receiver<Option<Work>>>,
    /// The mixture of its turn, kept until it reports.
    mixture: Option<Arc<Mixture>>,
}

impl Lines {
    pub(super) fn new(node: Node<Service>, traffic: Arc<Mutex<Traffic>>, message_bytes: usize) -> Self {
        Self { node, walkers: BTreeMap::new(), traffic, message_bytes }
    }

    pub(super) fn open(&mut self, walker: u32) {
        self.walkers.insert(walker, Line::default());
    }

    pub(super) fn close(&mut self, walker: u32) {
        self.walkers.remove(&walker);
    }

    /// Removes what dead processes left behind in iceoryx2's tables.
    pub(super) fn clean(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    /// The answer to the walker's offer goes here.
    pub(super) fn route(&mut self, caller: Caller, lent: &Arc<Lent>) {
        if let Some(line) = self.walkers.get_mut(&caller.walker) {
            line.route = Some(Arc::clone(lent));
        }
    }

    /// A way for the reactor's decision. The walker has reported: the mixture of its turn may go.
    pub(super) fn decide(&mut self, caller: Caller) -> oneshot::Sender<Option<Work>> {
        let (reply, decision) = oneshot::channel();
        if let Some(line) = self.walkers.get_mut(&caller.walker) {
            line.decision = Some(decision);
            line.mixture = None;
        }
        reply
    }

    pub(super) fn poll_decision(&mut self, context: &mut Context<'_>) -> Poll<(u32, Option<Work>)> {
        for (walker, line) in &mut self.walkers {
            let Some(receiver) = &mut line.decision else { continue };
            if let Poll::Ready(decision) = Pin::new(receiver).poll(context) {
                line.decision = None;
                return Poll::Ready((*walker, decision.ok().flatten()));
            }
        }
        Poll::Pending
    }

    /// Answers the walker's offer and keeps the mixture of its turn.
    pub(super) fn answer(&mut self, caller: Caller, answer: &[u8], mixture: Option<Arc<Mixture>>) {
        let Some(line) = self.walkers.get_mut(&caller.walker) else { return };
        line.mixture = mixture;
        if let Some(route) = line.route.take() {
            self.send(caller, &route, answer);
        }
    }

    /// Sends an answer and wakes the walker. If it is lost the walker asks again.
    pub(super) fn send(&mut self, caller: Caller, route: &Lent, answer: &[u8]) {
        let Some(line) = self.walkers.get_mut(&caller.walker) else { return };
        let sent = config::check_room(frame::length(answer.len(), None), self.message_bytes)
            .and_then(|()| route.answer(answer))
            .and_then(|()| line.ring(&self.node, caller));
        if let Err(reason) = sent {
            let mut traffic = self.traffic.lock().unwrap_or_else(PoisonError::into_inner);
            traffic.unsent += 1;
            traffic.last_unsent = Some(reason.to_string());
        }
    }

    /// Counts a message, how long it took, and, if it was dropped, why.
    pub(super) fn count(&self, bytes: u64, took: Duration, dropped: Option<&impl fmt::Display>) {
        let mut traffic = self.traffic.lock().unwrap_or_else(PoisonError::into_inner);
        traffic.received += 1;
        traffic.bytes += bytes;
        traffic.checking += took;
        if let Some(reason) = dropped {
            traffic.dropped += 1;
            traffic.last_dropped = Some(reason.to_string());
        }
    }
}

impl Line {
    fn ring(&mut self, node: &Node<Service>, caller: Caller) -> Result<(), IpcError> {
        let bell = match &self.bell {
            Some(bell) => bell,
            None => self.bell.insert(config::walker_bell(node, caller)?),
        };
        match bell.notify() {
            Ok(0) => Err(IpcError::new("wake a walker", "nobody listens")),
            Ok(_) => Ok(()),
            Err(reason) => Err(IpcError::new("wake a walker", reason)),
        }
    }
}
