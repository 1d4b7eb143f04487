//! State of the server: the walkers' messages, and the mixtures that they read.

use std::sync::Arc;
use std::time::Instant;

use super::IpcError;
use super::borrowed_request::BorrowedRequest;
use super::config::IpcRequest;
use super::connections::WalkerConnections;
use crate::control::decode;
use crate::mixture::SharedMixture;
use crate::protocol::message::{Envelope, Payload};
use crate::protocol::rejected::RejectedMessage;
use crate::protocol::server_session::{OfferDecision, ServerSession};

pub(super) struct IpcSession {
    pub(super) walkers: ServerSession<WalkerConnections>,
    mixtures: SharedMixture,
}

impl IpcSession {
    pub(super) fn new(session: u64, mixtures: SharedMixture, connections: WalkerConnections) -> Self {
        Self { walkers: ServerSession::new(session, connections), mixtures }
    }

    pub(super) fn expect(&mut self, walker: u32, incarnation: u32) {
        if let Some(previous) = self.walkers.incarnation(walker) {
            self.walker_lost(walker, previous, false);
        }
        self.walkers.expect(walker, incarnation);
    }

    /// Handles the exit of a walker's process. Does nothing if the process already has a successor, whose resources must
    /// not be freed.
    pub(super) fn walker_lost(&mut self, walker: u32, incarnation: u32, crashed: bool) {
        if self.walkers.process_ended(walker, incarnation, crashed) {
            self.walkers.transport.close(walker);
            self.mixtures.release(walker);
        }
    }

    /// Handles a message. Returns its walker and whether it contains a report, unless the message is rejected.
    pub(super) fn receive(&mut self, request: IpcRequest) -> Option<(u32, bool)> {
        let (begin, bytes) = (Instant::now(), size_of_val(request.payload()) as u64);
        let received = self.dispatch(request);
        self.walkers.transport.record_message(bytes, begin.elapsed(), received.as_ref().err());
        received.ok()
    }

    fn dispatch(&mut self, request: IpcRequest) -> Result<(u32, bool), RejectedMessage> {
        let request = Arc::new(BorrowedRequest::new(request)?);
        let envelope: Envelope<'_> = decode(request.control())?;
        let walker = envelope.sender.walker;
        let reports = matches!(envelope.payload, Payload::Offer { report: Some(_), .. });
        self.walkers.receive(envelope, &request, request.block())?;
        Ok((walker, reports))
    }

    /// Shares the mixture of a decision, and answers the walker.
    pub(super) fn handle_decision(
        &mut self,
        decision: OfferDecision<Arc<BorrowedRequest>>,
    ) -> Result<(), IpcError> {
        if let Some(work) = &decision.work {
            self.mixtures.publish(&work.mixture)?;
        }
        self.walkers.answer(decision);
        Ok(())
    }
}
