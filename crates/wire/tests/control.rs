//! Control messages come back as they were, and nothing else is taken for one.

mod common;

use common::{candidate, origin, usable_structure};
use proptest::collection::{btree_set, vec};
use proptest::option;
use proptest::prelude::*;
use wire::control::{ControlError, Message, decode, encode};
use wire::messages::{Assignment, Decline, End, Outcome, Progress, Report, Verdict};
use wire::{CampaignId, CandidateBlock, Origin, WalkId};

fn verdict() -> impl Strategy<Value = Verdict> {
    prop_oneof![
        Just(Verdict::Accepted),
        prop::sample::select(Decline::ALL.to_vec()).prop_map(Verdict::Declined)
    ]
}

fn end() -> impl Strategy<Value = End> {
    prop_oneof![
        Just(End::Steps),
        Just(End::Collected),
        ".{0,40}".prop_map(|guard| End::Trapped { guard }),
        ".{0,40}".prop_map(|reason| End::BlewUp { reason }),
        ".{0,40}".prop_map(|reason| End::BadStart { reason }),
    ]
}

fn progress() -> impl Strategy<Value = Progress> {
    let numbers = [(); 4].map(|()| -1e3..1e9);
    (any::<u64>(), any::<u32>(), numbers, any::<u64>(), any::<u32>(), any::<Option<(u64, u64)>>()).prop_map(
        |(step, segment, [tau, temperature, relative_volume, gamma_max], refused, returns, last_return)| {
            Progress {
                step,
                segment,
                tau,
                temperature,
                relative_volume,
                gamma_max,
                refused,
                returns,
                last_return,
            }
        },
    )
}

fn assignment() -> impl Strategy<Value = Assignment> {
    let ids = (any::<[u8; 16]>(), any::<u32>(), any::<u32>(), any::<u64>(), any::<u64>());
    let rest = (option::of(vec(any::<u8>(), 0..300)), option::of(verdict()), btree_set(any::<u64>(), 0..6));
    (ids, origin(), usable_structure(), rest).prop_map(|(ids, origin, seed_structure, rest)| {
        let (campaign, walk, random_walk, turn, until) = ids;
        let (checkpoint, verdict, wanted) = rest;
        let (campaign, walk, random_walk) = (CampaignId(campaign), WalkId(walk), WalkId(random_walk));
        let wanted = if origin == Origin::Control { wanted.into_iter().collect() } else { Vec::new() };
        Assignment {
            campaign,
            walk,
            turn,
            origin,
            random_walk,
            seed_structure,
            checkpoint,
            verdict,
            until,
            wanted,
        }
    })
}

fn report() -> impl Strategy<Value = Report> {
    let outcome = prop_oneof![
        candidate().prop_map(|candidate| Outcome::Candidate(CandidateBlock::encode(&candidate))),
        Just(Outcome::Turn),
        Just(Outcome::Paused),
        end().prop_map(Outcome::Ended),
    ];
    (any::<u32>(), any::<u64>(), outcome, vec(any::<u8>(), 0..300), progress()).prop_map(
        |(walk, turn, outcome, checkpoint, progress)| {
            let walk = match &outcome {
                Outcome::Candidate(block) => block.view().id().walk,
                _ => WalkId(walk),
            };
            Report { walk, turn, outcome, checkpoint, progress }
        },
    )
}

fn message() -> impl Strategy<Value = Message> {
    prop_oneof![
        assignment().prop_map(Message::Assignment),
        report().prop_map(Message::Report),
        (any::<u32>(), progress()).prop_map(|(walk, progress)| Message::Progress(WalkId(walk), progress)),
    ]
}

/// The block that travels beside a message.
fn beside(message: &Message) -> Option<CandidateBlock> {
    match message {
        Message::Report(Report { outcome: Outcome::Candidate(block), .. }) => Some(block.clone()),
        _ => None,
    }
}

/// What a sender would send of any content, right or wrong.
fn sealed(content: &[u8]) -> Vec<u8> {
    [b"CALM\x01".as_slice(), &crc32fast::hash(content).to_le_bytes(), content].concat()
}

fn is_about_the_candidate(found: &Result<Message, ControlError>) -> bool {
    matches!(found, Err(ControlError::Candidate { .. }))
}

proptest! {
    #[test]
    fn messages_come_back(message in message()) {
        let bytes = encode(&message);
        prop_assert_eq!(decode(&bytes, beside(&message)), Ok(message));
    }

    #[test]
    fn a_changed_byte_is_refused(
        message in message(), at in any::<prop::sample::Index>(), change in 1..=255_u8,
    ) {
        let mut bytes = encode(&message);
        let at = at.index(bytes.len());
        bytes[at] ^= change;
        prop_assert!(decode(&bytes, beside(&message)).is_err(), "byte {}", at);
    }

    #[test]
    fn missing_and_added_bytes_are_refused(
        message in message(), at in any::<prop::sample::Index>(), added in vec(any::<u8>(), 1..20),
    ) {
        let bytes = encode(&message);
        prop_assert!(decode(&bytes[..at.index(bytes.len())], beside(&message)).is_err());
        prop_assert!(decode(&[bytes.as_slice(), &added].concat(), beside(&message)).is_err());
        let content = [&bytes[9..], &added].concat();
        let trailing = ControlError::Trailing(added.len());
        prop_assert_eq!(decode(&sealed(&content), beside(&message)), Err(trailing));
        let shorter = &bytes[9..bytes.len() - 1];
        let found = decode(&sealed(shorter), beside(&message));
        prop_assert!(matches!(found, Err(ControlError::Content(_))), "{found:?}");
    }

    #[test]
    fn random_bytes_do_no_harm(bytes in vec(any::<u8>(), 0..300)) {
        prop_assert!(decode(&bytes, None).is_err());
        // With the checksum that fits, what can be decoded is a message, and comes back.
        if let Ok(message) = decode(&sealed(&bytes), None) {
            prop_assert!(decode(&encode(&message), None).is_ok());
        }
    }

    /// Damage that the checksum does not see, as from a program with an error.
    #[test]
    fn a_wrong_program_does_no_harm(
        message in message(), at in any::<prop::sample::Index>(), byte in any::<u8>(),
    ) {
        let mut content = encode(&message).split_off(9);
        let at = at.index(content.len());
        content[at] = byte;
        if let Ok(Message::Assignment(assignment)) = decode(&sealed(&content), beside(&message)) {
            prop_assert_eq!(assignment.seed_structure.validate(), Ok(()));
        }
    }

    #[test]
    fn a_report_needs_the_candidate_that_it_names(report in report(), other in candidate()) {
        let bytes = encode(&Message::Report(report.clone()));
        let other = CandidateBlock::encode(&other);
        let beside = beside(&Message::Report(report));
        prop_assume!(beside.as_ref() != Some(&other));
        prop_assert!(is_about_the_candidate(&decode(&bytes, Some(other))));
        prop_assert_eq!(is_about_the_candidate(&decode(&bytes, None)), beside.is_some());
    }

    #[test]
    fn a_report_about_the_candidate_of_another_walk_is_refused(candidate in candidate()) {
        let block = CandidateBlock::encode(&candidate);
        let outcome = Outcome::Candidate(block.clone());
        let walk = WalkId(candidate.id.walk.0 ^ 1);
        let report = Report { walk, turn: 0, outcome, checkpoint: Vec::new(), progress: Progress::default() };
        let found = decode(&encode(&Message::Report(report)), Some(block));
        prop_assert!(is_about_the_candidate(&found));
    }

    #[test]
    fn assignments_that_cannot_be_worked_on_are_refused(assignment in assignment()) {
        let refused = |assignment: &Assignment| {
            decode(&encode(&Message::Assignment(assignment.clone())), None).unwrap_err().to_string()
        };
        let mut broken = assignment.clone();
        broken.seed_structure.positions[0][1] = f64::NAN;
        prop_assert!(refused(&broken).ends_with("atom 0 has a position that is not finite"));
        broken.seed_structure.positions.clear();
        prop_assert!(refused(&broken).contains("species but 0 positions"));
        broken.seed_structure.species.clear();
        prop_assert!(refused(&broken).ends_with("the structure has no atoms"));
        let biased = Assignment { origin: Origin::Biased, wanted: vec![1], ..assignment.clone() };
        prop_assert!(refused(&biased).ends_with("expected none of a biased walk"));
        for wanted in [vec![2, 1], vec![1, 1]] {
            let control = Assignment { origin: Origin::Control, wanted, ..assignment.clone() };
            prop_assert!(refused(&control).ends_with("expected ascending steps"));
        }
    }
}

#[test]
fn what_is_wrong_is_said() {
    let bytes = encode(&Message::Progress(WalkId(3), Progress::default()));
    let error = |bytes: &[u8]| decode(bytes, None).unwrap_err();
    assert_eq!(error(&[]), ControlError::Short(0));
    assert_eq!(error(&bytes[..8]), ControlError::Short(8));
    let changed = |at: usize| {
        let mut bytes = bytes.clone();
        bytes[at] ^= 1;
        error(&bytes)
    };
    assert_eq!(changed(0), ControlError::Magic(*b"BALM"));
    assert_eq!(changed(4), ControlError::Version(0));
    assert!(matches!(changed(5), ControlError::Checksum { .. }));
    assert!(matches!(changed(9), ControlError::Checksum { .. }));
}

/// A length before a text or a list is not trusted.
#[test]
fn absurd_lengths_are_refused() {
    // Report, walk 0, turn 0, ended, blew up, and a reason of 2⁶³ bytes.
    let content = [&[1, 0, 0, 3, 3][..], &[0xff; 9], &[1]].concat();
    assert!(matches!(decode(&sealed(&content), None), Err(ControlError::Content(_))));
    // Assignment with 2⁶³ species.
    let content = [&[0][..], &[0; 16], &[0, 0, 0, 0], &[0xff; 9], &[1]].concat();
    assert!(matches!(decode(&sealed(&content), None), Err(ControlError::Content(_))));
}
