//! Who is to be heard, and how far the entry with each walker has come. No port, no clock.

use std::collections::BTreeMap;

use super::message::SenderId;

/// The sequences of a session.
#[derive(Debug)]
pub(crate) struct SequenceTracker {
    session: u64,
    walkers: BTreeMap<u32, WalkerSequence>,
}

#[derive(Debug)]
struct WalkerSequence {
    incarnation: u32,
    /// The last offer that was taken; 0 before the first.
    sequence: u64,
    /// The answer to it, as it was sent; none while it is being decided.
    answer: Option<Vec<u8>>,
}

/// What to do about an offer or a question.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum OfferStatus<'a> {
    /// A new offer, to be decided.
    New,
    /// It is being decided.
    Pending,
    /// It has been answered: the same answer again.
    Answered(&'a [u8]),
    /// It never came.
    Unknown,
}

/// Why a message is not listened to.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum SenderMismatch {
    #[error("a message of session {found:016x}; this is session {expected:016x}")]
    Session { found: u64, expected: u64 },
    #[error("a message of walker {0}, which is not expected")]
    Walker(u32),
    #[error("a message of incarnation {found} of walker {walker}; expected {expected}")]
    Incarnation { walker: u32, found: u32, expected: u32 },
    #[error("offer {found} of walker {walker}, whose last was {last}")]
    Sequence { walker: u32, found: u64, last: u64 },
}

impl SequenceTracker {
    pub(crate) fn new(session: u64) -> Self {
        Self { session, walkers: BTreeMap::new() }
    }

    /// From now on this incarnation of the walker is heard and no other.
    pub(crate) fn expect(&mut self, walker: u32, incarnation: u32) {
        self.walkers.insert(walker, WalkerSequence { incarnation, sequence: 0, answer: None });
    }

    /// The incarnation of the walker that is heard.
    pub(crate) fn incarnation(&self, walker: u32) -> Option<u32> {
        self.walkers.get(&walker).map(|entry| entry.incarnation)
    }

    /// The walker is heard no more.
    pub(crate) fn remove(&mut self, walker: u32) {
        self.walkers.remove(&walker);
    }

    /// Whether a message comes from whom it should.
    pub(crate) fn check_sender(&self, sender: SenderId) -> Result<(), SenderMismatch> {
        self.find(sender).map(|_| ())
    }

    /// What to do about an offer. It counts as taken after [`SequenceTracker::begin`] only, so that one whose content turns
    /// out to be damaged changes nothing.
    pub(crate) fn offer(&self, sender: SenderId, sequence: u64) -> Result<OfferStatus<'_>, SenderMismatch> {
        let entry = self.find(sender)?;
        match entry.status(sequence) {
            Some(OfferStatus::Unknown) => Ok(OfferStatus::New),
            Some(status) => Ok(status),
            None => Err(entry.out_of_order(sender, sequence)),
        }
    }

    /// What to answer to a question.
    pub(crate) fn poll(&self, sender: SenderId, sequence: u64) -> Result<OfferStatus<'_>, SenderMismatch> {
        let entry = self.find(sender)?;
        entry.status(sequence).ok_or_else(|| entry.out_of_order(sender, sequence))
    }

    /// The walker's next offer is being decided.
    pub(crate) fn begin(&mut self, walker: u32) {
        if let Some(entry) = self.walkers.get_mut(&walker) {
            entry.sequence += 1;
            entry.answer = None;
        }
    }

    /// Who waits under this number to have an offer answered, and which one.
    pub(crate) fn pending(&self, walker: u32) -> Option<(SenderId, u64)> {
        let WalkerSequence { incarnation, sequence, answer } = self.walkers.get(&walker)?;
        let sender = SenderId { session: self.session, walker, incarnation: *incarnation };
        (*sequence > 0 && answer.is_none()).then_some((sender, *sequence))
    }

    /// The walker's offer has been decided, and this is the answer.
    pub(crate) fn set_answer(&mut self, walker: u32, answer: Vec<u8>) {
        if let Some(entry) = self.walkers.get_mut(&walker) {
            entry.answer = Some(answer);
        }
    }

    fn find(&self, sender: SenderId) -> Result<&WalkerSequence, SenderMismatch> {
        let SenderId { session, walker, incarnation } = sender;
        if session != self.session {
            return Err(SenderMismatch::Session { found: session, expected: self.session });
        }
        let entry = self.walkers.get(&walker).ok_or(SenderMismatch::Walker(walker))?;
        let expected = entry.incarnation;
        if incarnation != expected {
            return Err(SenderMismatch::Incarnation { walker, found: incarnation, expected });
        }
        Ok(entry)
    }
}

impl WalkerSequence {
    /// `None` if a walker that keeps to the rules does not say this.
    fn status(&self, sequence: u64) -> Option<OfferStatus<'_>> {
        if sequence > 0 && sequence == self.sequence {
            return Some(self.answer.as_deref().map_or(OfferStatus::Pending, OfferStatus::Answered));
        }
        let answered = self.sequence == 0 || self.answer.is_some();
        (answered && self.sequence.checked_add(1) == Some(sequence)).then_some(OfferStatus::Unknown)
    }

    fn out_of_order(&self, sender: SenderId, found: u64) -> SenderMismatch {
        SenderMismatch::Sequence { walker: sender.walker, found, last: self.sequence }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SENDER: SenderId = SenderId { session: 7, walker: 3, incarnation: 1 };

    fn expecting() -> SequenceTracker {
        let mut sequences = SequenceTracker::new(7);
        sequences.expect(3, 1);
        sequences
    }

    #[test]
    fn an_offer_is_taken_once_and_answered_as_often_as_it_is_made() {
        let mut all = expecting();
        assert_eq!(all.poll(SENDER, 1), Ok(OfferStatus::Unknown), "an offer that was lost");
        for sequence in 1..4 {
            assert_eq!(all.offer(SENDER, sequence), Ok(OfferStatus::New));
            // Damaged content: nothing has changed.
            assert_eq!(all.offer(SENDER, sequence), Ok(OfferStatus::New));
            all.begin(3);
            assert_eq!(all.offer(SENDER, sequence), Ok(OfferStatus::Pending));
            assert_eq!(all.poll(SENDER, sequence), Ok(OfferStatus::Pending));
            assert_eq!(all.pending(3), Some((SENDER, sequence)));
            all.set_answer(3, vec![sequence as u8]);
            assert_eq!(all.pending(3), None);
            assert_eq!(all.offer(SENDER, sequence), Ok(OfferStatus::Answered(&[sequence as u8])));
            assert_eq!(all.poll(SENDER, sequence), Ok(OfferStatus::Answered(&[sequence as u8])));
        }
    }

    #[test]
    fn offers_out_of_order_are_refused() {
        let mut all = expecting();
        let refused = |all: &SequenceTracker, found, last| {
            let stranger = Err(SenderMismatch::Sequence { walker: 3, found, last });
            assert_eq!(all.offer(SENDER, found), stranger);
            assert_eq!(all.poll(SENDER, found), stranger);
        };
        refused(&all, 0, 0);
        refused(&all, 2, 0);
        all.begin(3);
        // The first is not answered: nobody can know what comes after it.
        refused(&all, 2, 1);
        all.set_answer(3, Vec::new());
        all.begin(3);
        for found in [0, 1, 3, u64::MAX] {
            refused(&all, found, 2);
        }
    }

    #[test]
    fn only_who_is_expected_is_heard() {
        let mut all = expecting();
        assert_eq!(all.check_sender(SENDER), Ok(()));
        let of = |session, walker, incarnation| SenderId { session, walker, incarnation };
        assert_eq!(all.check_sender(of(8, 3, 1)), Err(SenderMismatch::Session { found: 8, expected: 7 }));
        assert_eq!(all.check_sender(of(7, 4, 1)), Err(SenderMismatch::Walker(4)));
        all.begin(3);
        all.expect(3, 2);
        assert_eq!(
            all.check_sender(SENDER),
            Err(SenderMismatch::Incarnation { walker: 3, found: 1, expected: 2 })
        );
        assert_eq!(
            all.offer(of(7, 3, 2), 1),
            Ok(OfferStatus::New),
            "a new process counts from the beginning"
        );
        all.remove(3);
        assert_eq!(all.check_sender(of(7, 3, 2)), Err(SenderMismatch::Walker(3)));
    }
}
