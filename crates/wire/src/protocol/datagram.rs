//! The protocol over any carrier of single messages: both ends, without ports, threads or a clock. A simulation carries
//! the messages, and may lose, delay, repeat and reorder them.

use std::collections::VecDeque;
use std::sync::Arc;
use std::task::{Context, Waker};

use calm::Mixture;
use zerocopy::IntoBytes;

use super::frame;
use super::message::{Answer, AnswerBody, Envelope, Payload, SenderId};
use super::server_session::{ServerSession, ServerTransport};
use crate::block::{BlockError, Candidate, CandidateBlock};
use crate::control::{decode, encode};
use crate::messages::{Assignment, AssignmentReport};
use crate::transport::{Incoming, WorkItem};

/// Why a datagram was not accepted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct DatagramError(String);

/// An answer of the server to a process.
#[derive(Clone, Debug)]
pub struct AnswerDatagram {
    /// Number of the walker.
    pub walker: u32,
    /// Start count of its process.
    pub incarnation: u32,
    /// The encoded answer.
    pub bytes: Vec<u8>,
}

/// The server's end: a session with the walkers of one run.
pub struct DatagramServer(ServerSession<AnswerQueue>);

/// Answers that are not carried away yet.
#[derive(Default)]
struct AnswerQueue(VecDeque<AnswerDatagram>);

impl ServerTransport for AnswerQueue {
    type Request = ();

    const HOLDS_POLLS: bool = false;

    fn encode(answer: Answer<'_>) -> Vec<u8> {
        encode(&answer)
    }

    fn send(&mut self, SenderId { walker, incarnation, .. }: SenderId, (): &(), answer: &[u8]) {
        self.0.push_back(AnswerDatagram { walker, incarnation, bytes: answer.to_vec() });
    }

    fn candidate(&mut self, _: SenderId, (): &(), block: &[u8]) -> Result<CandidateBlock, BlockError> {
        CandidateBlock::from_bytes(block)
    }
}

impl DatagramServer {
    /// The server of a run, which `session` distinguishes from others.
    pub fn new(session: u64) -> Self {
        Self(ServerSession::new(session, AnswerQueue::default()))
    }

    /// Accepts messages only of this incarnation of the walker from now on. The previous one counts as lost.
    pub fn expect(&mut self, walker: u32, incarnation: u32) {
        if let Some(previous) = self.0.incarnation(walker) {
            self.0.process_ended(walker, previous, false);
        }
        self.0.expect(walker, incarnation);
    }

    /// Handles the exit of a walker's process, unless it has a successor.
    pub fn process_ended(&mut self, walker: u32, incarnation: u32, crashed: bool) {
        self.0.process_ended(walker, incarnation, crashed);
    }

    /// Handles a message. Returns its walker, and whether it contains a report.
    ///
    /// # Errors
    /// The message is damaged, or its sender is not expected.
    pub fn receive(&mut self, datagram: &[u8]) -> Result<(u32, bool), DatagramError> {
        let rejected = |why: &dyn std::fmt::Display| DatagramError(why.to_string());
        let (control, block) = frame::split(datagram).map_err(|why| rejected(&why))?;
        let envelope: Envelope<'_> = decode(control).map_err(|why| rejected(&why))?;
        let walker = envelope.sender.walker;
        let reports = matches!(envelope.payload, Payload::Offer { report: Some(_), .. });
        self.0.receive(envelope, &(), block).map_err(|why| rejected(&why))?;
        Ok((walker, reports))
    }

    /// Encodes the answers to the offers that the reactor has decided. `work` sees each assignment first.
    pub fn answer_decided(&mut self, mut work: impl FnMut(&WorkItem)) {
        let mut context = Context::from_waker(Waker::noop());
        while let std::task::Poll::Ready(decision) = self.0.poll_decision(&mut context) {
            decision.work.iter().for_each(&mut work);
            self.0.answer(decision);
        }
    }

    /// The messages for the reactor that arrived since the last call.
    pub fn take_incoming(&mut self) -> Vec<Incoming> {
        self.0.outbox.drain(..).collect()
    }

    /// The answers since the last call.
    pub fn take_answers(&mut self) -> Vec<AnswerDatagram> {
        self.0.transport.0.drain(..).collect()
    }

    /// The mixtures of all assignments that walkers have not reported on.
    pub fn mixtures(&self) -> impl Iterator<Item = &Arc<Mixture>> {
        self.0.mixtures()
    }
}

/// The walker's end: the current offer of a process.
pub struct DatagramWalker {
    sender: SenderId,
    sequence: u64,
    report: Option<AssignmentReport<Candidate>>,
}

/// What the server answers about the current offer.
#[derive(Clone, Debug)]
pub enum OfferAnswer {
    /// The report is committed; the next assignment, with the version of its mixture.
    Assignment(Box<Assignment>, u64),
    /// There is no more work.
    Shutdown,
    /// The decision is pending: poll again.
    Pending,
    /// The offer was not received: send it again.
    Unknown,
}

impl DatagramWalker {
    /// The process with this start count, before its first offer.
    pub fn new(session: u64, walker: u32, incarnation: u32) -> Self {
        Self { sender: SenderId { session, walker, incarnation }, sequence: 0, report: None }
    }

    /// Begins the next offer, which delivers this report. Send [`Self::offer`] then.
    pub fn begin_offer(&mut self, report: Option<AssignmentReport<Candidate>>) {
        self.sequence += 1;
        self.report = report;
    }

    /// The current offer.
    pub fn offer(&self) -> Vec<u8> {
        let (payload, candidate) = Payload::offer(self.sequence, self.report.as_ref());
        self.message(payload, candidate)
    }

    /// A question about the current offer.
    pub fn poll(&self) -> Vec<u8> {
        self.message(Payload::Poll { sequence: self.sequence }, None)
    }

    fn message(&self, payload: Payload<'_>, candidate: Option<&Candidate>) -> Vec<u8> {
        let control = encode(&Envelope { sender: self.sender, payload });
        frame::to_words(&control, candidate).as_bytes().to_vec()
    }

    /// Reads an answer; `None` if it is one to an earlier offer.
    ///
    /// # Errors
    /// The answer is damaged.
    pub fn receive(&self, answer: &[u8]) -> Result<Option<OfferAnswer>, DatagramError> {
        let Answer { sequence, body } =
            Answer::decode(answer).map_err(|why| DatagramError(why.to_string()))?;
        let body = match body {
            AnswerBody::Assignment { mixture_version, assignment } => {
                OfferAnswer::Assignment(Box::new(assignment.into_owned()), mixture_version)
            }
            AnswerBody::Shutdown => OfferAnswer::Shutdown,
            AnswerBody::Pending => OfferAnswer::Pending,
            AnswerBody::Unknown => OfferAnswer::Unknown,
        };
        Ok((sequence == self.sequence).then_some(body))
    }
}
