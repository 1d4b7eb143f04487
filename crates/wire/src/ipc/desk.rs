//! The server's work between two waits: what is said to whom.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::{Arc, Weak};
use std::task::{Context, Poll};
use std::time::Instant;

use super::IpcError;
use super::config::{IN_PLACE, IN_PLACE_IN_ALL, Request};
use super::lent::Lent;
use super::lines::Lines;
use crate::block::{BlockError, CandidateBlock};
use crate::control::{EncodedReport, seal, unseal};
use crate::exchange::conversation::{Conversations, Next};
use crate::exchange::dropped::Dropped;
use crate::exchange::message::{Answer, Caller, Decision, Letter, Words, complete};
use crate::ids::WalkId;
use crate::messages::Progress;
use crate::mixture::SharedMixture;
use crate::transport::{Incoming, Work};

/// More progress than this is not kept for a busy reactor.
const PROGRESS_KEPT: usize = 64;

pub(super) struct Desk {
    /// What the reactor has not taken yet: at most an offer of each walker, its end, and some progress.
    pub(super) outbox: VecDeque<Incoming>,
    conversations: Conversations,
    lines: Lines,
    /// Candidates that may still be read in place.
    in_place: Vec<(Caller, Weak<Lent>)>,
    mixtures: SharedMixture,
}

impl Desk {
    pub(super) fn new(session: u64, mixtures: SharedMixture, lines: Lines) -> Self {
        let conversations = Conversations::new(session);
        Self { outbox: VecDeque::new(), conversations, lines, in_place: Vec::new(), mixtures }
    }

    pub(super) fn expect(&mut self, walker: u32, incarnation: u32) {
        if let Some(previous) = self.conversations.expected(walker) {
            self.gone(walker, previous, false);
        }
        self.conversations.expect(walker, incarnation);
        self.lines.open(walker);
    }

    /// The walker's process is dead. Its decision is dropped before the reactor hears of it, so that a turn which is
    /// given to it meanwhile is known to be lost one way or the other. News of a process that has a successor is no news: what the
    /// successor holds must not be freed.
    pub(super) fn gone(&mut self, walker: u32, incarnation: u32, fault: bool) {
        if self.conversations.expected(walker) != Some(incarnation) {
            return;
        }
        self.conversations.forget(walker);
        self.lines.close(walker);
        self.lines.clean();
        self.mixtures.release(walker);
        self.outbox.push_back(Incoming::Gone { walker, fault });
    }

    /// Takes in a message; the walker that it is of and whether it brings a report, unless it is dropped.
    pub(super) fn receive(&mut self, request: Request) -> Option<(u32, bool)> {
        let (begin, bytes) = (Instant::now(), size_of_val(request.payload()) as u64);
        let heard = self.listen(request);
        self.lines.count(bytes, begin.elapsed(), heard.as_ref().err());
        heard.ok()
    }

    fn listen(&mut self, request: Request) -> Result<(u32, bool), Dropped> {
        let lent = Arc::new(Lent::new(request)?);
        let Letter { caller, words } = unseal(lent.control())?;
        self.conversations.check(caller)?;
        let reports = matches!(words, Words::Offer { report: Some(_), .. });
        match words {
            Words::Offer { sequence, report } => self.offer(caller, sequence, report, &lent)?,
            Words::Ask { sequence } => self.ask(caller, sequence, &lent)?,
            Words::Progress(walk, progress) => self.progress(walk, progress.into_owned()),
        }
        Ok((caller.walker, reports))
    }

    fn offer(
        &mut self,
        caller: Caller,
        sequence: u64,
        report: Option<EncodedReport<'_>>,
        lent: &Arc<Lent>,
    ) -> Result<(), Dropped> {
        match self.conversations.offer(caller, sequence)? {
            Next::Again(answer) => self.lines.send(caller, lent, answer),
            // The walker listens where it spoke last.
            Next::Wait => self.lines.route(caller, lent),
            Next::Take | Next::Unknown => {
                let report = complete(report, self.candidate(caller, lent)?)?;
                self.conversations.take(caller.walker);
                self.lines.route(caller, lent);
                let reply = self.lines.decide(caller);
                self.outbox.push_back(Incoming::Free { walker: caller.walker, report, reply });
            }
        }
        Ok(())
    }

    fn ask(&mut self, caller: Caller, sequence: u64, lent: &Lent) -> Result<(), Dropped> {
        let decision = match self.conversations.ask(caller, sequence)? {
            Next::Again(answer) => {
                self.lines.send(caller, lent, answer);
                return Ok(());
            }
            Next::Wait => Decision::Wait,
            Next::Take | Next::Unknown => Decision::Unknown,
        };
        self.lines.send(caller, lent, &seal(&Answer { sequence, decision }));
        Ok(())
    }

    /// May be lost: whoever watches can do without.
    fn progress(&mut self, walk: WalkId, progress: Progress) {
        if self.outbox.len() < PROGRESS_KEPT {
            self.outbox.push_back(Incoming::Progress(walk, progress));
        }
    }

    /// The candidate beside a message, where it stands if not too many stand already.
    fn candidate(&mut self, caller: Caller, lent: &Arc<Lent>) -> Result<Option<CandidateBlock>, BlockError> {
        if lent.block().is_empty() {
            return Ok(None);
        }
        self.in_place.retain(|(_, lent)| lent.strong_count() > 0);
        let of_caller = self.in_place.iter().filter(|(of, _)| *of == caller).count();
        if of_caller >= IN_PLACE || self.in_place.len() >= IN_PLACE_IN_ALL {
            return CandidateBlock::from_bytes(lent.block()).map(Some);
        }
        let block = CandidateBlock::in_place(Arc::clone(lent) as _)?;
        self.in_place.push((caller, Arc::downgrade(lent)));
        Ok(Some(block))
    }

    /// The next walker whose offer has been decided, and the decision: a turn, or home.
    pub(super) fn poll_decision(&mut self, context: &mut Context<'_>) -> Poll<(u32, Option<Work>)> {
        self.lines.poll_decision(context)
    }

    /// Answers the offer of a walker.
    pub(super) fn decided(&mut self, walker: u32, work: Option<Work>) -> Result<(), IpcError> {
        let Some((caller, sequence)) = self.conversations.undecided(walker) else { return Ok(()) };
        let decision = match &work {
            Some(Work { assignment, mixture }) => {
                self.mixtures.publish(mixture)?;
                Decision::Turn { mixture_version: mixture.version(), assignment: Cow::Borrowed(assignment) }
            }
            None => Decision::Home,
        };
        let answer = seal(&Answer { sequence, decision });
        self.lines.answer(caller, &answer, work.map(|work| work.mixture));
        self.conversations.answered(walker, answer);
        Ok(())
    }
}
