//! What walkers and server say to each other, as control messages (see [`crate::control`]).
//!
//! A walker counts its offers: 1, 2, 3 … An offer is what came of a turn (nothing at first) and asks for the next. The
//! answer is the acknowledgement: the report is committed. Until it comes the walker asks every so often, and learns
//! that its offer waits for a decision, what the answer was, or that the offer never came and must be sent again.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::control::{ControlError, EncodedReport, checked_assignment, unseal};
use crate::ids::WalkId;
use crate::messages::{Assignment, Progress};

/// Who speaks: a process that is to be heard, and no other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Caller {
    /// Of this run of the orchestrator.
    pub session: u64,
    /// The walker's number.
    pub walker: u32,
    /// Counts the processes that were this walker.
    pub incarnation: u32,
}

/// From a walker.
#[derive(Serialize, Deserialize)]
pub(super) struct Letter<'a> {
    pub caller: Caller,
    #[serde(borrow)]
    pub words: Words<'a>,
}

#[derive(Serialize, Deserialize)]
pub(super) enum Words<'a> {
    /// What came of the last turn, and: what next?
    Offer {
        sequence: u64,
        #[serde(borrow)]
        report: Option<EncodedReport<'a>>,
    },
    /// What became of that offer?
    Ask { sequence: u64 },
    /// Where a walk stands.
    Progress(WalkId, Cow<'a, Progress>),
}

/// To a walker, about its offer `sequence`.
#[derive(Serialize, Deserialize)]
pub(super) struct Answer<'a> {
    pub sequence: u64,
    pub decision: Decision<'a>,
}

#[derive(Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "there is never more than one")]
pub(super) enum Decision<'a> {
    /// Committed; this is the next turn.
    Turn { mixture_version: u64, assignment: Cow<'a, Assignment> },
    /// Committed if it could be; there is no more work.
    Home,
    /// Still being decided.
    Wait,
    /// It never came: offer it again.
    Unknown,
}

impl Answer<'static> {
    /// Decodes and checks an answer.
    pub(super) fn decode(bytes: &[u8]) -> Result<Self, ControlError> {
        let Answer { sequence, decision } = unseal(bytes)?;
        let decision = match decision {
            Decision::Turn { mixture_version, assignment } => {
                let assignment = Cow::Owned(checked_assignment(assignment.into_owned())?);
                Decision::Turn { mixture_version, assignment }
            }
            Decision::Home => Decision::Home,
            Decision::Wait => Decision::Wait,
            Decision::Unknown => Decision::Unknown,
        };
        Ok(Self { sequence, decision })
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;
    use zerocopy::IntoBytes;

    use super::*;
    use crate::block::{BlockError, CandidateView};
    use crate::control::seal;
    use crate::ipc::frame;
    use crate::messages::{End, Outcome, Report};

    const CALLER: Caller = Caller { session: 1 << 60, walker: 3, incarnation: 2 };

    /// All that is done to a request before anything is believed.
    fn read(request: &[u8]) -> Result<(), String> {
        let (control, block) = frame::split(request).map_err(|e| e.to_string())?;
        let letter: Letter<'_> = unseal(control).map_err(|e| e.to_string())?;
        if !block.is_empty() {
            match CandidateView::new(block) {
                // Memory of a test is not always aligned as shared memory is.
                Ok(_) | Err(BlockError::Unaligned) => {}
                Err(e) => return Err(e.to_string()),
            }
        }
        if let Words::Offer { report: Some(report), .. } = letter.words {
            report.complete(None).map_err(|e| e.to_string())?;
        }
        Ok(())
    }

    /// A request, in memory aligned to 8.
    fn request(reason: String, checkpoint: Vec<u8>, sequence: u64) -> Vec<u64> {
        let (walk, outcome) = (WalkId(5), Outcome::<()>::Ended(End::BlewUp { reason }));
        let report = Report { walk, turn: 9, outcome, checkpoint, progress: Progress::default() };
        let report = Some(EncodedReport::new(&report, |()| unreachable!("no candidate")));
        let control = seal(&Letter { caller: CALLER, words: Words::Offer { sequence, report } });
        let mut words = vec![0_u64; frame::length(control.len(), None) / 8];
        frame::fill(words.as_mut_bytes(), &control, None);
        words
    }

    proptest! {
        #[test]
        fn a_damaged_request_is_refused(
            reason in ".{0,40}", checkpoint in vec(any::<u8>(), 0..200), sequence in any::<u64>(),
            at in any::<prop::sample::Index>(), change in 1..=255_u8, cut in any::<prop::sample::Index>(),
        ) {
            let mut words = request(reason, checkpoint, sequence);
            prop_assert_eq!(read(words.as_bytes()), Ok(()));
            let bytes = words.as_mut_bytes();
            let (length, control) = (bytes.len(), u64::from_le_bytes(*bytes.first_chunk().unwrap()));
            prop_assert!(read(&bytes[..cut.index(length)]).is_err(), "cut off");
            // What fills up to a multiple of 8 is not looked at.
            let at = at.index(8 + control as usize);
            bytes[at] ^= change;
            prop_assert!(read(bytes).is_err(), "byte {}", at);
        }

        #[test]
        fn any_request_does_no_harm(bytes in vec(any::<u8>(), 0..400), control in 0..400_u64) {
            prop_assert!(read(&bytes).is_err());
            let _ = read(&[&control.to_le_bytes(), bytes.as_slice()].concat());
            // With the checksum that fits.
            let content = [b"CALM\x01".as_slice(), &crc32fast::hash(&bytes).to_le_bytes(), &bytes].concat();
            let sealed = [&(content.len() as u64).to_le_bytes(), content.as_slice(), &[0; 8]].concat();
            let _ = read(&sealed);
            let _ = Answer::decode(&content);
        }

        /// As from a program with an error: the checksum fits, the content does not.
        #[test]
        fn a_wrong_program_does_no_harm(
            reason in ".{0,40}", at in any::<prop::sample::Index>(), byte in any::<u8>(),
        ) {
            let words = request(reason, vec![1; 20], 1);
            let (control, _) = frame::split(words.as_bytes()).unwrap();
            let mut content = control[9..].to_vec();
            let at = at.index(content.len());
            content[at] = byte;
            let sealed = [b"CALM\x01".as_slice(), &crc32fast::hash(&content).to_le_bytes(), &content].concat();
            let padding = vec![0; sealed.len().next_multiple_of(8) - sealed.len()];
            let _ = read(&[&(sealed.len() as u64).to_le_bytes(), sealed.as_slice(), &padding].concat());
            let _ = Answer::decode(&sealed);
        }
    }
}
