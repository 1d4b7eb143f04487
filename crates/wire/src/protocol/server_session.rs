//! The server's end of the protocol, the same for every transport between processes: what an offer, a poll and progress
//! mean. The reactor decides each offer once, and the walker receives the answer after the commit.

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use calm::Mixture;
use tokio::sync::oneshot;

use super::message::{Answer, AnswerBody, Envelope, Payload, SenderId, attach_candidate};
use super::rejected::RejectedMessage;
use super::sequence::{OfferStatus, SequenceTracker};
use crate::block::{BlockError, CandidateBlock};
use crate::ids::WalkId;
use crate::messages::{AssignmentReport, WalkProgress};
use crate::transport::{Incoming, WorkItem};

/// Maximum number of progress messages queued for the reactor.
const MAX_QUEUED_PROGRESS: usize = 64;

/// What a transport between processes does for the server.
pub(crate) trait ServerTransport {
    /// A received request, kept until it is answered.
    type Request: Clone;

    /// Whether a poll waits for the decision. Otherwise the server answers at once that the offer is pending.
    const HOLDS_POLLS: bool;

    /// Encodes an answer.
    fn encode(answer: Answer<'_>) -> Vec<u8>;

    /// Sends an encoded answer to a request. If it is lost, the walker polls again.
    fn send(&mut self, sender: SenderId, request: &Self::Request, answer: &[u8]);

    /// The candidate of a new offer from its block, which is not empty.
    fn candidate(
        &mut self,
        sender: SenderId,
        request: &Self::Request,
        block: &[u8],
    ) -> Result<CandidateBlock, BlockError>;
}

/// The walkers of a session and their offers.
pub(crate) struct ServerSession<T: ServerTransport> {
    pub transport: T,
    /// Messages for the reactor: at most one offer and one exit of each walker, and some progress.
    pub outbox: VecDeque<Incoming>,
    sequences: SequenceTracker,
    /// The pending offer of each walker.
    pending: BTreeMap<u32, PendingOffer<T::Request>>,
    /// The mixture of each walker's assignment, kept until its report.
    mixtures: BTreeMap<u32, Arc<Mixture>>,
}

/// An offer that waits for the reactor's decision.
struct PendingOffer<R> {
    /// The walker's latest request about it, which takes the answer.
    request: R,
    decision: oneshot::Receiver<Option<WorkItem>>,
}

/// The reactor's decision on an offer.
pub(crate) struct OfferDecision<R> {
    walker: u32,
    request: R,
    /// The next assignment; `None` for shutdown.
    pub work: Option<WorkItem>,
}

impl<T: ServerTransport> ServerSession<T> {
    pub(crate) fn new(session: u64, transport: T) -> Self {
        Self {
            transport,
            outbox: VecDeque::new(),
            sequences: SequenceTracker::new(session),
            pending: BTreeMap::new(),
            mixtures: BTreeMap::new(),
        }
    }

    /// Accepts messages only of this incarnation of the walker from now on.
    pub(crate) fn expect(&mut self, walker: u32, incarnation: u32) {
        self.sequences.expect(walker, incarnation);
    }

    /// The incarnation of the walker whose messages are accepted.
    pub(crate) fn incarnation(&self, walker: u32) -> Option<u32> {
        self.sequences.incarnation(walker)
    }

    /// Rejects all further messages of the walker. Drops its pending decision before the reactor learns of the loss, so
    /// that the reactor recognizes an assignment sent in the meantime as lost either way.
    pub(crate) fn remove(&mut self, walker: u32, crashed: bool) {
        self.sequences.remove(walker);
        self.pending.remove(&walker);
        self.mixtures.remove(&walker);
        self.outbox.push_back(Incoming::Lost { walker, crashed });
    }

    /// Handles the exit of a walker's process. Does nothing, and returns `false`, if the process already has a successor.
    pub(crate) fn process_ended(&mut self, walker: u32, incarnation: u32, crashed: bool) -> bool {
        let is_current = self.incarnation(walker) == Some(incarnation);
        if is_current {
            self.remove(walker, crashed);
        }
        is_current
    }

    /// Handles a message of a walker. `block` is the candidate that came with it, or empty.
    pub(crate) fn receive(
        &mut self,
        Envelope { sender, payload }: Envelope<'_>,
        request: &T::Request,
        block: &[u8],
    ) -> Result<(), RejectedMessage> {
        self.sequences.check_sender(sender)?;
        match payload {
            Payload::Offer { sequence, report } => {
                if self.is_new(sender, sequence, request)? {
                    let candidate = (!block.is_empty())
                        .then(|| self.transport.candidate(sender, request, block))
                        .transpose()?;
                    self.begin(sender.walker, request, attach_candidate(report, candidate)?);
                }
            }
            Payload::Poll { sequence } => self.poll(sender, sequence, request)?,
            Payload::Progress(walk, progress) => self.progress(walk, progress.into_owned()),
        }
        Ok(())
    }

    /// Handles an offer without report of a sender that lost its walker: forwards the loss first.
    pub(crate) fn receive_loss(
        &mut self,
        sender: SenderId,
        sequence: u64,
        crashed: bool,
        request: &T::Request,
    ) -> Result<(), RejectedMessage> {
        if self.is_new(sender, sequence, request)? {
            self.outbox.push_back(Incoming::Lost { walker: sender.walker, crashed });
            self.begin(sender.walker, request, None);
        }
        Ok(())
    }

    /// Whether an offer is new. Repeats the answer to an answered offer; a pending one is answered through its latest
    /// request.
    fn is_new(
        &mut self,
        sender: SenderId,
        sequence: u64,
        request: &T::Request,
    ) -> Result<bool, RejectedMessage> {
        match self.sequences.offer(sender, sequence)? {
            OfferStatus::Answered(answer) => self.transport.send(sender, request, answer),
            OfferStatus::Pending => self.hold(sender.walker, request),
            OfferStatus::New | OfferStatus::Unknown => return Ok(true),
        }
        Ok(false)
    }

    fn hold(&mut self, walker: u32, request: &T::Request) {
        if let Some(pending) = self.pending.get_mut(&walker) {
            pending.request = request.clone();
        }
    }

    /// Forwards an offer to the reactor. The walker has reported, so the mixture of its assignment is released.
    fn begin(&mut self, walker: u32, request: &T::Request, report: Option<AssignmentReport>) {
        self.sequences.begin(walker);
        self.mixtures.remove(&walker);
        let (reply, decision) = oneshot::channel();
        self.pending.insert(walker, PendingOffer { request: request.clone(), decision });
        self.outbox.push_back(Incoming::Idle { walker, report, reply });
    }

    fn poll(&mut self, sender: SenderId, sequence: u64, request: &T::Request) -> Result<(), RejectedMessage> {
        let body = match self.sequences.poll(sender, sequence)? {
            OfferStatus::Answered(answer) => {
                self.transport.send(sender, request, answer);
                return Ok(());
            }
            OfferStatus::Pending if T::HOLDS_POLLS => {
                self.hold(sender.walker, request);
                return Ok(());
            }
            OfferStatus::Pending => AnswerBody::Pending,
            OfferStatus::New | OfferStatus::Unknown => AnswerBody::Unknown,
        };
        self.transport.send(sender, request, &T::encode(Answer { sequence, body }));
        Ok(())
    }

    /// May drop the message.
    fn progress(&mut self, walk: WalkId, progress: WalkProgress) {
        if self.outbox.len() < MAX_QUEUED_PROGRESS {
            self.outbox.push_back(Incoming::Progress(walk, progress));
        }
    }

    /// The next decision of the reactor, for [`ServerSession::answer`].
    pub(crate) fn poll_decision(&mut self, context: &mut Context<'_>) -> Poll<OfferDecision<T::Request>> {
        let decided = self.pending.iter_mut().find_map(|(walker, pending)| {
            match Pin::new(&mut pending.decision).poll(context) {
                Poll::Ready(decision) => Some((*walker, decision.ok().flatten())),
                Poll::Pending => None,
            }
        });
        let Some((walker, work)) = decided else { return Poll::Pending };
        let Some(PendingOffer { request, .. }) = self.pending.remove(&walker) else { return Poll::Pending };
        Poll::Ready(OfferDecision { walker, request, work })
    }

    /// Answers a pending offer and keeps the mixture of the new assignment.
    pub(crate) fn answer(&mut self, decision: OfferDecision<T::Request>) {
        let OfferDecision { walker, request, work } = decision;
        let Some((sender, sequence)) = self.sequences.pending(walker) else { return };
        let body = match &work {
            Some(WorkItem { assignment, mixture }) => AnswerBody::Assignment {
                mixture_version: mixture.version(),
                assignment: Cow::Borrowed(assignment),
            },
            None => AnswerBody::Shutdown,
        };
        let answer = T::encode(Answer { sequence, body });
        self.transport.send(sender, &request, &answer);
        self.sequences.set_answer(walker, answer);
        self.mixtures.extend(work.map(|work| (walker, work.mixture)));
    }

    /// The mixtures of all assignments that walkers have not reported on.
    pub(crate) fn mixtures(&self) -> impl Iterator<Item = &Arc<Mixture>> {
        self.mixtures.values()
    }
}

#[cfg(test)]
mod tests {
    use std::task::Waker;

    use atoms::{Cell, Structure};

    use super::super::datagram::{DatagramServer, DatagramWalker, OfferAnswer};
    use super::super::frame;
    use super::*;
    use crate::block::Candidate;
    use crate::control::encode;
    use crate::ids::{CampaignId, CandidateId, ContentHash, Origin};
    use crate::messages::Outcome;

    const SENDER: SenderId = SenderId { session: 7, walker: 3, incarnation: 1 };

    /// A server that expects the first process of walker 3, and that process.
    fn both_ends() -> (DatagramServer, DatagramWalker) {
        let mut server = DatagramServer::new(SENDER.session);
        server.expect(SENDER.walker, SENDER.incarnation);
        let walker = DatagramWalker::new(SENDER.session, SENDER.walker, SENDER.incarnation);
        (server, walker)
    }

    fn message(payload: Payload<'_>) -> Vec<u8> {
        frame::with_block(&encode(&Envelope { sender: SENDER, payload }), None)
    }

    /// The answers that a walker has got.
    fn answers(server: &mut DatagramServer, walker: &DatagramWalker) -> Vec<OfferAnswer> {
        server.answer_decided(|_| {});
        let answers = server.take_answers();
        answers.iter().filter_map(|answer| walker.receive(&answer.bytes).unwrap()).collect()
    }

    #[test]
    fn an_offer_is_forwarded_once_and_answered_when_it_is_decided() {
        let (mut server, mut walker) = both_ends();
        walker.begin_offer(None);
        server.receive(&walker.poll()).unwrap();
        assert!(matches!(answers(&mut server, &walker)[..], [OfferAnswer::Unknown]), "it was lost");
        for _ in 0..2 {
            server.receive(&walker.offer()).unwrap();
        }
        let mut incoming = server.take_incoming();
        let Some(Incoming::Idle { walker: 3, report: None, reply }) = incoming.pop() else { panic!() };
        assert!(incoming.is_empty() && answers(&mut server, &walker).is_empty());
        server.receive(&walker.poll()).unwrap();
        assert!(matches!(answers(&mut server, &walker)[..], [OfferAnswer::Pending]));
        reply.send(None).unwrap();
        assert!(matches!(answers(&mut server, &walker)[..], [OfferAnswer::Shutdown]));
        for question in [walker.poll(), walker.offer()] {
            server.receive(&question).unwrap();
            assert!(matches!(answers(&mut server, &walker)[..], [OfferAnswer::Shutdown]), "it is repeated");
        }
        assert!(server.take_incoming().is_empty());
    }

    #[test]
    fn only_the_end_of_the_current_process_is_a_loss() {
        let (mut server, mut walker) = both_ends();
        walker.begin_offer(None);
        server.receive(&walker.offer()).unwrap();
        let Some(Incoming::Idle { reply, .. }) = server.take_incoming().pop() else { panic!() };
        server.process_ended(SENDER.walker, SENDER.incarnation + 1, true);
        assert!(server.take_incoming().is_empty());
        server.process_ended(SENDER.walker, SENDER.incarnation, true);
        assert!(matches!(server.take_incoming()[..], [Incoming::Lost { walker: 3, crashed: true }]));
        // The reactor learns that its decision reaches no walker.
        assert!(reply.send(None).is_err());
        assert!(server.receive(&walker.poll()).is_err());
        server.expect(SENDER.walker, SENDER.incarnation + 1);
        assert!(server.receive(&walker.offer()).is_err(), "a message of the process before");
        // A successor that comes first makes it a loss as well.
        server.expect(SENDER.walker, SENDER.incarnation + 2);
        assert!(matches!(server.take_incoming()[..], [Incoming::Lost { walker: 3, crashed: false }]));
    }

    #[test]
    fn a_candidate_without_a_report_is_rejected() {
        let (mut server, _) = both_ends();
        let offer =
            encode(&Envelope { sender: SENDER, payload: Payload::Offer { sequence: 1, report: None } });
        assert!(server.receive(&frame::with_block(&offer, Some(&[7; 8]))).is_err());
        assert!(server.take_incoming().is_empty());
    }

    #[test]
    fn progress_that_nobody_takes_is_dropped() {
        let (mut server, mut walker) = both_ends();
        let progress = |step| {
            message(Payload::Progress(WalkId(5), Cow::Owned(WalkProgress { step, ..Default::default() })))
        };
        for step in 0..MAX_QUEUED_PROGRESS as u64 + 9 {
            server.receive(&progress(step)).unwrap();
        }
        walker.begin_offer(None);
        server.receive(&walker.offer()).unwrap();
        let mut incoming = server.take_incoming();
        assert!(matches!(incoming.pop(), Some(Incoming::Idle { .. })), "an offer is not dropped");
        assert_eq!(incoming.len(), MAX_QUEUED_PROGRESS);
        for (step, one) in (0..).zip(&incoming) {
            assert!(matches!(one, Incoming::Progress(WalkId(5), of) if of.step == step));
        }
    }

    /// A candidate of one atom.
    fn candidate() -> Candidate {
        let structure = Structure {
            species: vec!["Al".parse().unwrap()],
            positions: vec![[0.5, 0.0, 0.0]],
            cell: Cell::orthorhombic(4.0, 4.0, 4.0),
            periodic: [true; 3],
        };
        let content = ContentHash::from_structure(&structure);
        Candidate {
            id: CandidateId { campaign: CampaignId([1; 16]), walk: WalkId(5), segment: 0, step: 8, content },
            origin: Origin::Biased,
            mixture_version: 2,
            temperature: 300.0,
            relative_volume: 1.0,
            energy: -1.5,
            virial: [[0.0; 3]; 3],
            structure,
            forces: vec![[0.25, 0.0, 0.0]],
            gamma: vec![1.5],
            gamma_nbr: vec![1.25],
            features: vec![0.5, 0.75],
        }
    }

    #[test]
    fn a_candidate_arrives_with_its_report() {
        let (mut server, mut walker) = both_ends();
        let report = AssignmentReport {
            walk: WalkId(5),
            assignment: 4,
            start: None,
            outcome: Outcome::Candidate(candidate()),
            checkpoint: vec![7],
            progress: WalkProgress::default(),
            trace: Vec::new(),
            frames: Vec::new(),
        };
        walker.begin_offer(Some(report));
        assert_eq!(server.receive(&walker.offer()).unwrap(), (SENDER.walker, true));
        let Some(Incoming::Idle { report: Some(report), .. }) = server.take_incoming().pop() else {
            panic!()
        };
        let Outcome::Candidate(block) = report.outcome else { panic!() };
        assert_eq!((report.assignment, block.view().to_candidate()), (4, candidate()));
    }

    /// A transport that keeps what is sent: the number of the request, and the answer.
    #[derive(Default)]
    struct Kept(Vec<(u32, Vec<u8>)>);

    impl ServerTransport for Kept {
        type Request = u32;

        const HOLDS_POLLS: bool = true;

        fn encode(answer: Answer<'_>) -> Vec<u8> {
            encode(&answer)
        }

        fn send(&mut self, _: SenderId, request: &u32, answer: &[u8]) {
            self.0.push((*request, answer.to_vec()));
        }

        fn candidate(&mut self, _: SenderId, _: &u32, block: &[u8]) -> Result<CandidateBlock, BlockError> {
            CandidateBlock::from_bytes(block)
        }
    }

    /// With a transport that holds polls, the latest request about an offer gets the answer, once.
    #[test]
    fn a_loss_is_forwarded_before_the_next_offer() {
        let mut session = ServerSession::new(SENDER.session, Kept::default());
        session.expect(SENDER.walker, SENDER.incarnation);
        for request in [1, 2] {
            session.receive_loss(SENDER, 1, true, &request).unwrap();
        }
        let poll = Envelope { sender: SENDER, payload: Payload::Poll { sequence: 1 } };
        session.receive(poll, &3, &[]).unwrap();
        let mut incoming: Vec<_> = session.outbox.drain(..).collect();
        let Some(Incoming::Idle { walker: 3, report: None, reply }) = incoming.pop() else { panic!() };
        assert!(matches!(incoming[..], [Incoming::Lost { walker: 3, crashed: true }]), "once");
        assert!(session.transport.0.is_empty());
        reply.send(None).unwrap();
        let mut context = Context::from_waker(Waker::noop());
        let Poll::Ready(decision) = session.poll_decision(&mut context) else { panic!() };
        session.answer(decision);
        assert!(session.poll_decision(&mut context).is_pending());
        assert_eq!(session.transport.0.iter().map(|(request, _)| *request).collect::<Vec<_>>(), [3]);
        assert!(session.receive_loss(SENDER, 3, true, &4).is_err(), "out of order");
    }
}
