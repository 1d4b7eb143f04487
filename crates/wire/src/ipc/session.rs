//! State of the server: handles messages and decisions.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::{Arc, Weak};
use std::task::{Context, Poll};
use std::time::Instant;

use super::IpcError;
use super::borrowed_request::BorrowedRequest;
use super::config::{MAX_IN_PLACE, MAX_IN_PLACE_TOTAL, Request};
use super::connections::Connections;
use crate::block::{BlockError, CandidateBlock};
use crate::control::{EncodedReport, decode, encode};
use crate::ids::WalkId;
use crate::messages::Progress;
use crate::mixture::SharedMixture;
use crate::protocol::message::{Answer, AnswerBody, Envelope, Payload, SenderId, attach_candidate};
use crate::protocol::rejected::RejectedMessage;
use crate::protocol::sequence::{OfferStatus, SequenceTracker};
use crate::transport::{Incoming, WorkItem};

/// Maximum number of progress messages queued for the reactor.
const MAX_QUEUED_PROGRESS: usize = 64;

pub(super) struct ServerSession {
    /// Messages for the reactor: at most one offer and one exit of each walker, and some progress.
    pub(super) outbox: VecDeque<Incoming>,
    sequences: SequenceTracker,
    connections: Connections,
    /// Candidates that may still be read in place.
    in_place: Vec<(SenderId, Weak<BorrowedRequest>)>,
    mixtures: SharedMixture,
}

impl ServerSession {
    pub(super) fn new(session: u64, mixtures: SharedMixture, connections: Connections) -> Self {
        let sequences = SequenceTracker::new(session);
        Self { outbox: VecDeque::new(), sequences, connections, in_place: Vec::new(), mixtures }
    }

    pub(super) fn expect(&mut self, walker: u32, incarnation: u32) {
        if let Some(previous) = self.sequences.incarnation(walker) {
            self.walker_lost(walker, previous, false);
        }
        self.sequences.expect(walker, incarnation);
        self.connections.open(walker);
    }

    /// Handles the exit of a walker's process. Drops the pending decision before the reactor learns of the exit, so
    /// that an assignment sent in the meantime is recognized as lost either way. Does nothing if the process already
    /// has a successor, whose resources must not be freed.
    pub(super) fn walker_lost(&mut self, walker: u32, incarnation: u32, crashed: bool) {
        if self.sequences.incarnation(walker) != Some(incarnation) {
            return;
        }
        self.sequences.remove(walker);
        self.connections.close(walker);
        self.connections.clean();
        self.mixtures.release(walker);
        self.outbox.push_back(Incoming::Lost { walker, crashed });
    }

    /// Handles a message. Returns its walker and whether it contains a report, unless the message is rejected.
    pub(super) fn receive(&mut self, request: Request) -> Option<(u32, bool)> {
        let (begin, bytes) = (Instant::now(), size_of_val(request.payload()) as u64);
        let received = self.dispatch(request);
        self.connections.record_message(bytes, begin.elapsed(), received.as_ref().err());
        received.ok()
    }

    fn dispatch(&mut self, request: Request) -> Result<(u32, bool), RejectedMessage> {
        let request = Arc::new(BorrowedRequest::new(request)?);
        let Envelope { sender, payload } = decode(request.control())?;
        self.sequences.check_sender(sender)?;
        let reports = matches!(payload, Payload::Offer { report: Some(_), .. });
        match payload {
            Payload::Offer { sequence, report } => self.offer(sender, sequence, report, &request)?,
            Payload::Poll { sequence } => self.poll(sender, sequence, &request)?,
            Payload::Progress(walk, progress) => self.progress(walk, progress.into_owned()),
        }
        Ok((sender.walker, reports))
    }

    fn offer(
        &mut self,
        sender: SenderId,
        sequence: u64,
        report: Option<EncodedReport<'_>>,
        request: &Arc<BorrowedRequest>,
    ) -> Result<(), RejectedMessage> {
        match self.sequences.offer(sender, sequence)? {
            OfferStatus::Answered(answer) => self.connections.send(sender, request, answer),
            // The walker waits for the answer to its latest request.
            OfferStatus::Pending => self.connections.set_route(sender, request),
            OfferStatus::New | OfferStatus::Unknown => {
                let report = attach_candidate(report, self.candidate(sender, request)?)?;
                self.sequences.begin(sender.walker);
                self.connections.set_route(sender, request);
                let reply = self.connections.decision_channel(sender);
                self.outbox.push_back(Incoming::Idle { walker: sender.walker, report, reply });
            }
        }
        Ok(())
    }

    fn poll(
        &mut self,
        sender: SenderId,
        sequence: u64,
        request: &BorrowedRequest,
    ) -> Result<(), RejectedMessage> {
        let body = match self.sequences.poll(sender, sequence)? {
            OfferStatus::Answered(answer) => {
                self.connections.send(sender, request, answer);
                return Ok(());
            }
            OfferStatus::Pending => AnswerBody::Pending,
            OfferStatus::New | OfferStatus::Unknown => AnswerBody::Unknown,
        };
        self.connections.send(sender, request, &encode(&Answer { sequence, body }));
        Ok(())
    }

    /// May drop the message.
    fn progress(&mut self, walk: WalkId, progress: Progress) {
        if self.outbox.len() < MAX_QUEUED_PROGRESS {
            self.outbox.push_back(Incoming::Progress(walk, progress));
        }
    }

    /// The candidate of a message; read in place unless too many are already.
    fn candidate(
        &mut self,
        sender: SenderId,
        request: &Arc<BorrowedRequest>,
    ) -> Result<Option<CandidateBlock>, BlockError> {
        if request.block().is_empty() {
            return Ok(None);
        }
        self.in_place.retain(|(_, request)| request.strong_count() > 0);
        let of_sender = self.in_place.iter().filter(|(of, _)| *of == sender).count();
        if of_sender >= MAX_IN_PLACE || self.in_place.len() >= MAX_IN_PLACE_TOTAL {
            return CandidateBlock::from_bytes(request.block()).map(Some);
        }
        let block = CandidateBlock::in_place(Arc::clone(request) as _)?;
        self.in_place.push((sender, Arc::downgrade(request)));
        Ok(Some(block))
    }

    /// The next decision of the reactor and its walker: an assignment, or `None` for shutdown.
    pub(super) fn poll_decision(&mut self, context: &mut Context<'_>) -> Poll<(u32, Option<WorkItem>)> {
        self.connections.poll_decision(context)
    }

    /// Answers the pending offer of a walker.
    pub(super) fn handle_decision(&mut self, walker: u32, work: Option<WorkItem>) -> Result<(), IpcError> {
        let Some((sender, sequence)) = self.sequences.pending(walker) else { return Ok(()) };
        let body = match &work {
            Some(WorkItem { assignment, mixture }) => {
                self.mixtures.publish(mixture)?;
                AnswerBody::Assignment {
                    mixture_version: mixture.version(),
                    assignment: Cow::Borrowed(assignment),
                }
            }
            None => AnswerBody::Shutdown,
        };
        let answer = encode(&Answer { sequence, body });
        self.connections.answer(sender, &answer, work.map(|work| work.mixture));
        self.sequences.set_answer(walker, answer);
        Ok(())
    }
}
