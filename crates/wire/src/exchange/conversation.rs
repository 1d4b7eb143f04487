//! Who is to be heard, and how far the conversation with each walker has come. No port, no clock.

use std::collections::BTreeMap;

use super::message::Caller;

/// The conversations of a session.
#[derive(Debug)]
pub(crate) struct Conversations {
    session: u64,
    walkers: BTreeMap<u32, Conversation>,
}

#[derive(Debug)]
struct Conversation {
    incarnation: u32,
    /// The last offer that was taken; 0 before the first.
    sequence: u64,
    /// The answer to it, as it was sent; none while it is being decided.
    answer: Option<Vec<u8>>,
}

/// What to do about an offer or a question.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Next<'a> {
    /// A new offer, to be decided.
    Take,
    /// It is being decided.
    Wait,
    /// It has been answered: the same answer again.
    Again(&'a [u8]),
    /// It never came.
    Unknown,
}

/// Why a message is not listened to.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Stranger {
    #[error("a message of session {found:016x}; this is session {expected:016x}")]
    Session { found: u64, expected: u64 },
    #[error("a message of walker {0}, which is not expected")]
    Walker(u32),
    #[error("a message of incarnation {found} of walker {walker}; expected {expected}")]
    Incarnation { walker: u32, found: u32, expected: u32 },
    #[error("offer {found} of walker {walker}, whose last was {last}")]
    Sequence { walker: u32, found: u64, last: u64 },
}

impl Conversations {
    pub(crate) fn new(session: u64) -> Self {
        Self { session, walkers: BTreeMap::new() }
    }

    /// From now on this incarnation of the walker is heard and no other.
    pub(crate) fn expect(&mut self, walker: u32, incarnation: u32) {
        self.walkers.insert(walker, Conversation { incarnation, sequence: 0, answer: None });
    }

    /// The incarnation of the walker that is heard.
    pub(crate) fn expected(&self, walker: u32) -> Option<u32> {
        self.walkers.get(&walker).map(|conversation| conversation.incarnation)
    }

    /// The walker is heard no more.
    pub(crate) fn forget(&mut self, walker: u32) {
        self.walkers.remove(&walker);
    }

    /// Whether a message comes from whom it should.
    pub(crate) fn check(&self, caller: Caller) -> Result<(), Stranger> {
        self.find(caller).map(|_| ())
    }

    /// What to do about an offer. It counts as taken after [`Conversations::take`] only, so that one whose content turns
    /// out to be damaged changes nothing.
    pub(crate) fn offer(&self, caller: Caller, sequence: u64) -> Result<Next<'_>, Stranger> {
        let conversation = self.find(caller)?;
        match conversation.next(sequence) {
            Some(Next::Unknown) => Ok(Next::Take),
            Some(next) => Ok(next),
            None => Err(conversation.out_of_order(caller, sequence)),
        }
    }

    /// What to answer to a question.
    pub(crate) fn ask(&self, caller: Caller, sequence: u64) -> Result<Next<'_>, Stranger> {
        let conversation = self.find(caller)?;
        conversation.next(sequence).ok_or_else(|| conversation.out_of_order(caller, sequence))
    }

    /// The walker's next offer is being decided.
    pub(crate) fn take(&mut self, walker: u32) {
        if let Some(conversation) = self.walkers.get_mut(&walker) {
            conversation.sequence += 1;
            conversation.answer = None;
        }
    }

    /// Who waits under this number to have an offer answered, and which one.
    pub(crate) fn undecided(&self, walker: u32) -> Option<(Caller, u64)> {
        let Conversation { incarnation, sequence, answer } = self.walkers.get(&walker)?;
        let caller = Caller { session: self.session, walker, incarnation: *incarnation };
        (*sequence > 0 && answer.is_none()).then_some((caller, *sequence))
    }

    /// The walker's offer has been decided, and this is the answer.
    pub(crate) fn answered(&mut self, walker: u32, answer: Vec<u8>) {
        if let Some(conversation) = self.walkers.get_mut(&walker) {
            conversation.answer = Some(answer);
        }
    }

    fn find(&self, caller: Caller) -> Result<&Conversation, Stranger> {
        let Caller { session, walker, incarnation } = caller;
        if session != self.session {
            return Err(Stranger::Session { found: session, expected: self.session });
        }
        let conversation = self.walkers.get(&walker).ok_or(Stranger::Walker(walker))?;
        let expected = conversation.incarnation;
        if incarnation != expected {
            return Err(Stranger::Incarnation { walker, found: incarnation, expected });
        }
        Ok(conversation)
    }
}

impl Conversation {
    /// `None` if a walker that keeps to the rules does not say this.
    fn next(&self, sequence: u64) -> Option<Next<'_>> {
        if sequence > 0 && sequence == self.sequence {
            return Some(self.answer.as_deref().map_or(Next::Wait, Next::Again));
        }
        let answered = self.sequence == 0 || self.answer.is_some();
        (answered && self.sequence.checked_add(1) == Some(sequence)).then_some(Next::Unknown)
    }

    fn out_of_order(&self, caller: Caller, found: u64) -> Stranger {
        Stranger::Sequence { walker: caller.walker, found, last: self.sequence }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CALLER: Caller = Caller { session: 7, walker: 3, incarnation: 1 };

    fn expecting() -> Conversations {
        let mut conversations = Conversations::new(7);
        conversations.expect(3, 1);
        conversations
    }

    #[test]
    fn an_offer_is_taken_once_and_answered_as_often_as_it_is_made() {
        let mut all = expecting();
        assert_eq!(all.ask(CALLER, 1), Ok(Next::Unknown), "an offer that was lost");
        for sequence in 1..4 {
            assert_eq!(all.offer(CALLER, sequence), Ok(Next::Take));
            // Damaged content: nothing has changed.
            assert_eq!(all.offer(CALLER, sequence), Ok(Next::Take));
            all.take(3);
            assert_eq!(all.offer(CALLER, sequence), Ok(Next::Wait));
            assert_eq!(all.ask(CALLER, sequence), Ok(Next::Wait));
            assert_eq!(all.undecided(3), Some((CALLER, sequence)));
            all.answered(3, vec![sequence as u8]);
            assert_eq!(all.undecided(3), None);
            assert_eq!(all.offer(CALLER, sequence), Ok(Next::Again(&[sequence as u8])));
            assert_eq!(all.ask(CALLER, sequence), Ok(Next::Again(&[sequence as u8])));
        }
    }

    #[test]
    fn offers_out_of_order_are_refused() {
        let mut all = expecting();
        let refused = |all: &Conversations, found, last| {
            let stranger = Err(Stranger::Sequence { walker: 3, found, last });
            assert_eq!(all.offer(CALLER, found), stranger);
            assert_eq!(all.ask(CALLER, found), stranger);
        };
        refused(&all, 0, 0);
        refused(&all, 2, 0);
        all.take(3);
        // The first is not answered: nobody can know what comes after it.
        refused(&all, 2, 1);
        all.answered(3, Vec::new());
        all.take(3);
        for found in [0, 1, 3, u64::MAX] {
            refused(&all, found, 2);
        }
    }

    #[test]
    fn only_who_is_expected_is_heard() {
        let mut all = expecting();
        assert_eq!(all.check(CALLER), Ok(()));
        let of = |session, walker, incarnation| Caller { session, walker, incarnation };
        assert_eq!(all.check(of(8, 3, 1)), Err(Stranger::Session { found: 8, expected: 7 }));
        assert_eq!(all.check(of(7, 4, 1)), Err(Stranger::Walker(4)));
        all.take(3);
        all.expect(3, 2);
        assert_eq!(all.check(CALLER), Err(Stranger::Incarnation { walker: 3, found: 1, expected: 2 }));
        assert_eq!(all.offer(of(7, 3, 2), 1), Ok(Next::Take), "a new process counts from the beginning");
        all.forget(3);
        assert_eq!(all.check(of(7, 3, 2)), Err(Stranger::Walker(3)));
    }
}
