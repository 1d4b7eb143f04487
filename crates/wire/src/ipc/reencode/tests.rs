//! Messages between walker and orchestrator survive a round trip, and invalid bytes are rejected.

use atoms::Structure;
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

use super::*;
use crate::control::ControlError;
use crate::ids::{Origin, WalkId};
use crate::messages::{Assignment, AssignmentReport, Outcome, WalkEnd, WalkProgress};
use crate::protocol::frame::FrameError;
use crate::protocol::message::{AnswerBody, SenderId};
use any::{answer, assignment, given, offer, offered, report, request, sender};
use common::candidate;

mod any;
#[path = "../../../tests/common/mod.rs"]
#[allow(dead_code, reason = "the tests of the package use the rest")]
mod common;

/// Offset of the content: the length field and the header of the control message.
const CONTENT: usize = 8 + 9;

type Reader = fn(&[u8]) -> Result<Vec<u8>, RejectedMessage>;

/// A message, and the function that reads it.
fn message() -> impl Strategy<Value = (Vec<u8>, Reader)> {
    let request = request().prop_map(|bytes| (bytes, super::request as Reader));
    prop_oneof![request, answer().prop_map(|bytes| (bytes, super::answer as Reader))]
}

/// The content of a message, without padding.
fn content(message: &[u8]) -> &[u8] {
    &frame::split(message).unwrap().0[9..]
}

/// Arbitrary content as a control message.
fn encoded(content: &[u8]) -> Vec<u8> {
    let control = [b"CALM\x06".as_slice(), &crc32fast::hash(content).to_le_bytes(), content].concat();
    frame::to_words(&control, None).as_bytes().to_vec()
}

/// The message with another block.
fn with_block(message: &[u8], block: &[u8]) -> Vec<u8> {
    let (control, _) = frame::split(message).unwrap();
    [frame::to_words(control, None).as_bytes(), block].concat()
}

fn is_about_the_candidate(found: &Result<Vec<u8>, RejectedMessage>) -> bool {
    matches!(
        found,
        Err(RejectedMessage::Control(ControlError::Candidate { .. } | ControlError::UnexpectedCandidate(_)))
    )
}

proptest! {
    #[test]
    fn messages_survive_a_round_trip((bytes, read) in message()) {
        prop_assert_eq!(read(&bytes).map_err(|e| e.to_string()), Ok(bytes));
    }

    #[test]
    fn reports_arrive_with_their_candidates(report in report()) {
        let (payload, candidate) = Payload::offer(1, Some(&report));
        let control = encode(&payload);
        let Payload::Offer { report: Some(found), .. } = decode(&control).unwrap() else { panic!("an offer") };
        let found = attach_candidate(Some(found), candidate.map(CandidateBlock::encode)).unwrap();
        // Candidates may contain NaN, so their blocks are compared.
        prop_assert_eq!(found, Some(report.map_candidate(|candidate| CandidateBlock::encode(&candidate))));
    }

    #[test]
    fn assignments_arrive(assignment in assignment(), sequence in any::<u64>(), version in any::<u64>()) {
        let bytes = given(sequence, version, &assignment);
        let answer = Answer::decode(frame::split(&bytes).unwrap().0).unwrap();
        let AnswerBody::Assignment { mixture_version, assignment: found } = answer.body else { panic!("an assignment") };
        prop_assert_eq!((answer.sequence, mixture_version, found.as_ref()), (sequence, version, &assignment));
    }

    #[test]
    fn changed_bytes_are_rejected(
        (mut bytes, read) in message(), at in any::<prop::sample::Index>(), change in 1..=255_u8,
    ) {
        let (control, block) = frame::split(&bytes).unwrap();
        // Padding to a multiple of 8 is ignored.
        let (end, filled) = (8 + control.len(), bytes.len() - block.len());
        let at = at.index(end + block.len());
        let at = if at < end { at } else { at - end + filled };
        bytes[at] ^= change;
        prop_assert!(read(&bytes).is_err(), "byte {}", at);
    }

    #[test]
    fn missing_and_extra_bytes_are_rejected(
        (bytes, read) in message(), at in any::<prop::sample::Index>(), added in vec(any::<u8>(), 1..20),
    ) {
        prop_assert!(read(&bytes[..at.index(bytes.len())]).is_err());
        let content = content(&bytes);
        let found = read(&encoded(&[content, &added].concat()));
        let trailing = |error: &RejectedMessage| matches!(error, RejectedMessage::Control(ControlError::Trailing(n)) if *n == added.len());
        prop_assert!(found.as_ref().is_err_and(trailing), "{found:?}");
        let found = read(&encoded(&content[..content.len() - 1]));
        prop_assert!(matches!(found, Err(RejectedMessage::Control(ControlError::Content(_)))), "{found:?}");
    }

    #[test]
    fn unexpected_bytes_after_an_offer_are_rejected(bytes in offer(), added in vec(any::<u8>(), 1..20)) {
        let found = super::request(&[bytes.as_slice(), &added].concat());
        prop_assert!(matches!(found, Err(RejectedMessage::Block(_))), "{found:?}");
    }

    #[test]
    fn random_bytes_do_no_harm(bytes in vec(any::<u8>(), 0..400), length in 0..400_u64) {
        prop_assert_eq!(reencode(&bytes), [None, None]);
        prop_assert_eq!(reencode(&[&length.to_le_bytes(), bytes.as_slice()].concat()), [None, None]);
        // With a valid checksum, whatever can be decoded survives a round trip.
        for (role, reencoded) in reencode(&encoded(&bytes)).into_iter().enumerate() {
            let Some(reencoded) = reencoded else { continue };
            prop_assert_eq!(&reencode(&reencoded)[role], &Some(reencoded));
        }
    }

    /// Damage that the checksum does not detect, for example by a bug in the sender.
    #[test]
    fn wrong_senders_do_no_harm(
        (bytes, read) in message(), at in any::<prop::sample::Index>(), byte in any::<u8>(),
    ) {
        let mut content = content(&bytes).to_vec();
        let at = at.index(content.len());
        content[at] = byte;
        let (_, block) = frame::split(&bytes).unwrap();
        let spoiled = with_block(&encoded(&content), block);
        if let Ok(reencoded) = read(&spoiled) {
            prop_assert_eq!(read(&reencoded).map_err(|e| e.to_string()), Ok(reencoded));
        }
        let spoiled = Answer::decode(frame::split(&spoiled).unwrap().0);
        if let Ok(Answer { body: AnswerBody::Assignment { assignment, .. }, .. }) = spoiled {
            prop_assert_eq!(assignment.seed_structure.validate(), Ok(()));
        }
    }

    #[test]
    fn an_offer_needs_the_candidate_that_it_names(
        sender in sender(), report in option::weighted(0.8, report()), other in candidate(),
    ) {
        let bytes = offered(sender, 1, report.as_ref());
        let own = frame::split(&bytes).unwrap().1;
        let other = CandidateBlock::encode(&other);
        prop_assume!(own != other.as_bytes());
        prop_assert!(is_about_the_candidate(&super::request(&with_block(&bytes, other.as_bytes()))));
        prop_assert_eq!(is_about_the_candidate(&super::request(&with_block(&bytes, &[]))), !own.is_empty());
    }

    #[test]
    fn reports_with_candidates_of_other_walks_are_rejected(sender in sender(), candidate in candidate()) {
        let walk = WalkId(candidate.id.walk.0 ^ 1);
        let (outcome, checkpoint) = (Outcome::Candidate(candidate), Vec::new());
        let report = AssignmentReport { walk, assignment: 0, start: None, outcome, checkpoint, progress: WalkProgress::default(), trace: vec![], frames: vec![] };
        prop_assert!(is_about_the_candidate(&super::request(&offered(sender, 1, Some(&report)))));
    }

    #[test]
    fn excessive_lengths_of_assignments_are_rejected(mut assignment in assignment()) {
        assignment.conditions.group = "a group".to_owned();
        assignment.checkpoint = Some(b"checkpoint".to_vec());
        let given = given(1, 1, &assignment);
        prop_assert!(super::answer(&given).is_ok());
        prop_assert!(is_refused_with_excessive_length(super::answer, &given, b"a group"));
        prop_assert!(is_refused_with_excessive_length(super::answer, &given, b"checkpoint"));
    }

    #[test]
    fn invalid_assignments_are_rejected(assignment in assignment()) {
        let refused = |assignment: &Assignment| super::answer(&given(1, 1, assignment)).unwrap_err().to_string();
        let with = |seed_structure| Assignment { seed_structure, ..assignment.clone() };
        let mut broken = assignment.seed_structure.clone();
        broken.positions[0][1] = f64::NAN;
        prop_assert!(refused(&with(broken.clone())).ends_with("atom 0 has a position that is not finite"));
        broken.positions.clear();
        prop_assert!(refused(&with(broken.clone())).contains("species but 0 positions"));
        let empty = Structure { species: Vec::new(), ..broken };
        prop_assert!(refused(&with(empty)).ends_with("the structure has no atoms"));
        let biased = Assignment { origin: Origin::Biased, frame_steps: vec![1], ..assignment.clone() };
        prop_assert!(refused(&biased).ends_with("expected none of a biased walk"));
        for frame_steps in [vec![2, 1], vec![1, 1]] {
            let control = Assignment { origin: Origin::Control, frame_steps, ..assignment.clone() };
            prop_assert!(refused(&control).ends_with("expected ascending steps"));
        }
        for threshold_factor in [0.5, f64::NAN, f64::INFINITY] {
            let message = refused(&Assignment { threshold_factor, ..assignment.clone() });
            prop_assert!(message.ends_with("expected a finite number, 1 or more"), "{}", message);
        }
    }
}

#[test]
fn errors_are_specific() {
    let bytes = encode_message(&Answer { sequence: 3, body: AnswerBody::Shutdown }, None);
    let changed = |at: usize| {
        let mut bytes = bytes.clone();
        bytes[at] ^= 1;
        match super::answer(&bytes) {
            Err(RejectedMessage::Control(error)) => error,
            found => panic!("{found:?}"),
        }
    };
    assert_eq!(changed(8), ControlError::Magic(*b"BALM"));
    assert_eq!(changed(12), ControlError::Version(7));
    assert!(matches!(changed(13), ControlError::Checksum { .. }));
    assert!(matches!(changed(CONTENT), ControlError::Checksum { .. }));
    let short = |control: &[u8]| super::answer(frame::to_words(control, None).as_bytes());
    for length in [0, 8] {
        let found = short(&bytes[8..8 + length]);
        assert!(
            matches!(found, Err(RejectedMessage::Control(ControlError::Short(n))) if n == length),
            "{found:?}"
        );
    }
    assert!(matches!(super::answer(&bytes[..7]), Err(RejectedMessage::Frame(FrameError::Short(7)))));
}

/// Whether a message is rejected that states 2⁶³ bytes for this text or list, of fewer than 128 bytes.
fn is_refused_with_excessive_length(read: Reader, message: &[u8], text: &[u8]) -> bool {
    let content = content(message);
    let at = content.windows(text.len()).position(|found| found == text).expect("the text");
    let (before, length) = content[..at].split_at(at - 1);
    assert_eq!(length, [u8::try_from(text.len()).expect("short")]);
    let excessive = [&[0xff; 9][..], &[1]].concat();
    let changed = encoded(&[before, &excessive, &content[at..]].concat());
    matches!(read(&changed), Err(RejectedMessage::Control(ControlError::Content(_))))
}

#[test]
fn excessive_lengths_are_rejected() {
    let sender = SenderId { session: 0, walker: 0, incarnation: 0 };
    let outcome = Outcome::Ended(WalkEnd::Diverged { reason: "a reason".to_owned() });
    let (checkpoint, progress) = (b"checkpoint".to_vec(), WalkProgress::default());
    let report = AssignmentReport {
        walk: WalkId(0),
        assignment: 0,
        start: None,
        outcome,
        checkpoint,
        progress,
        trace: vec![],
        frames: vec![],
    };
    let offer = offered(sender, 1, Some(&report));
    assert!(super::request(&offer).is_ok());
    assert!(is_refused_with_excessive_length(super::request, &offer, b"a reason"));
    assert!(is_refused_with_excessive_length(super::request, &offer, b"checkpoint"));
}
