//! Tracks which processes may send messages, and the last offer of each walker. Uses no ports and no clock.

use std::collections::BTreeMap;

use super::message::SenderId;

/// The last offer of each walker in a session.
#[derive(Debug)]
pub(crate) struct SequenceTracker {
    session: u64,
    walkers: BTreeMap<u32, WalkerSequence>,
}

#[derive(Debug)]
struct WalkerSequence {
    incarnation: u32,
    /// Number of the last accepted offer; 0 before the first.
    sequence: u64,
    /// The encoded answer to it; `None` while the decision is pending.
    answer: Option<Vec<u8>>,
}

/// State of an offer.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum OfferStatus<'a> {
    /// A new offer.
    New,
    /// The decision is pending.
    Pending,
    /// Answered before; the same answer is sent again.
    Answered(&'a [u8]),
    /// Never received.
    Unknown,
}

/// Why a message does not come from an expected sender.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum SenderMismatch {
    #[error("message of session {found:016x}, expected session {expected:016x}")]
    Session { found: u64, expected: u64 },
    #[error("message of unexpected walker {0}")]
    Walker(u32),
    #[error("message of incarnation {found} of walker {walker}, expected incarnation {expected}")]
    Incarnation { walker: u32, found: u32, expected: u32 },
    #[error("offer {found} of walker {walker} is out of order: the last was {last}")]
    Sequence { walker: u32, found: u64, last: u64 },
}

impl SequenceTracker {
    pub(crate) fn new(session: u64) -> Self {
        Self { session, walkers: BTreeMap::new() }
    }

    /// Accepts messages only of this incarnation of the walker from now on.
    pub(crate) fn expect(&mut self, walker: u32, incarnation: u32) {
        self.walkers.insert(walker, WalkerSequence { incarnation, sequence: 0, answer: None });
    }

    /// The incarnation of the walker whose messages are accepted.
    pub(crate) fn incarnation(&self, walker: u32) -> Option<u32> {
        self.walkers.get(&walker).map(|entry| entry.incarnation)
    }

    /// Rejects all further messages of the walker.
    pub(crate) fn remove(&mut self, walker: u32) {
        self.walkers.remove(&walker);
    }

    /// Checks that the sender is expected.
    pub(crate) fn check_sender(&self, sender: SenderId) -> Result<(), SenderMismatch> {
        self.find(sender).map(|_| ())
    }

    /// State of an offer that arrived. A new offer counts as received only after [`SequenceTracker::begin`], so an
    /// offer with damaged content changes nothing.
    pub(crate) fn offer(&self, sender: SenderId, sequence: u64) -> Result<OfferStatus<'_>, SenderMismatch> {
        let entry = self.find(sender)?;
        match entry.status(sequence) {
            Some(OfferStatus::Unknown) => Ok(OfferStatus::New),
            Some(status) => Ok(status),
            None => Err(entry.out_of_order(sender, sequence)),
        }
    }

    /// State of an offer that a walker polls.
    pub(crate) fn poll(&self, sender: SenderId, sequence: u64) -> Result<OfferStatus<'_>, SenderMismatch> {
        let entry = self.find(sender)?;
        entry.status(sequence).ok_or_else(|| entry.out_of_order(sender, sequence))
    }

    /// Marks the walker's next offer as pending.
    pub(crate) fn begin(&mut self, walker: u32) {
        if let Some(entry) = self.walkers.get_mut(&walker) {
            entry.sequence += 1;
            entry.answer = None;
        }
    }

    /// Sender and number of the walker's pending offer.
    pub(crate) fn pending(&self, walker: u32) -> Option<(SenderId, u64)> {
        let WalkerSequence { incarnation, sequence, answer } = self.walkers.get(&walker)?;
        let sender = SenderId { session: self.session, walker, incarnation: *incarnation };
        (*sequence > 0 && answer.is_none()).then_some((sender, *sequence))
    }

    /// Stores the answer to the walker's pending offer.
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
    /// `None` if no correct walker would send this number.
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
    fn repeated_offers_are_decided_once_and_answered_each_time() {
        let mut all = expecting();
        assert_eq!(all.poll(SENDER, 1), Ok(OfferStatus::Unknown), "an offer that was lost");
        assert_eq!(all.pending(3), None, "no offer so far");
        assert_eq!((all.incarnation(3), all.incarnation(4)), (Some(1), None));
        for sequence in 1..4 {
            assert_eq!(all.offer(SENDER, sequence), Ok(OfferStatus::New));
            // Damaged content changes nothing.
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
    fn offers_out_of_order_are_rejected() {
        let mut all = expecting();
        let refused = |all: &SequenceTracker, found, last| {
            let stranger = Err(SenderMismatch::Sequence { walker: 3, found, last });
            assert_eq!(all.offer(SENDER, found), stranger);
            assert_eq!(all.poll(SENDER, found), stranger);
        };
        refused(&all, 0, 0);
        refused(&all, 2, 0);
        all.begin(3);
        // The first is not answered: the next offer is unknown.
        refused(&all, 2, 1);
        all.set_answer(3, Vec::new());
        all.begin(3);
        for found in [0, 1, 3, u64::MAX] {
            refused(&all, found, 2);
        }
    }

    #[test]
    fn only_expected_senders_are_accepted() {
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
