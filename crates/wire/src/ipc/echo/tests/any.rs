//! Messages of any content, written as their senders write them.

use std::borrow::Cow;

use proptest::collection::{btree_set, vec};
use proptest::option;
use proptest::prelude::*;

use super::common::{candidate, origin, usable_structure};
use super::written;
use crate::block::Candidate;
use crate::exchange::message::{Answer, Caller, Decision, Letter, Words};
use crate::ids::{CampaignId, Origin, WalkId};
use crate::messages::{Assignment, Decline, End, Outcome, Progress, Report, Verdict};

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

pub fn assignment() -> impl Strategy<Value = Assignment> {
    let ids = (any::<[u8; 16]>(), any::<u32>(), any::<u32>(), any::<u64>(), any::<u64>());
    let rest = (
        option::of(vec(any::<u8>(), 0..300)),
        option::of(verdict()),
        btree_set(any::<u64>(), 0..6),
        1.0..9.0,
    );
    (ids, origin(), usable_structure(), rest).prop_map(|(ids, origin, seed_structure, rest)| {
        let (campaign, walk, random_walk, turn, until) = ids;
        let (checkpoint, verdict, wanted, raised) = rest;
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
            raised,
        }
    })
}

pub fn report() -> impl Strategy<Value = Report<Candidate>> {
    let outcome = prop_oneof![
        candidate().prop_map(Outcome::Candidate),
        Just(Outcome::Turn),
        Just(Outcome::Paused),
        end().prop_map(Outcome::Ended),
    ];
    (any::<u32>(), any::<u64>(), outcome, vec(any::<u8>(), 0..300), progress()).prop_map(
        |(walk, turn, outcome, checkpoint, progress)| {
            let walk = match &outcome {
                Outcome::Candidate(candidate) => candidate.id.walk,
                _ => WalkId(walk),
            };
            Report { walk, turn, outcome, checkpoint, progress }
        },
    )
}

pub fn caller() -> impl Strategy<Value = Caller> {
    (any::<u64>(), any::<u32>(), any::<u32>()).prop_map(|(session, walker, incarnation)| Caller {
        session,
        walker,
        incarnation,
    })
}

/// An offer as a walker sends it.
pub fn offered(caller: Caller, sequence: u64, report: Option<&Report<Candidate>>) -> Vec<u8> {
    let (words, candidate) = Words::offer(sequence, report);
    written(&Letter { caller, words }, candidate)
}

pub fn offer() -> impl Strategy<Value = Vec<u8>> {
    (caller(), any::<u64>(), option::weighted(0.8, report()))
        .prop_map(|(caller, sequence, report)| offered(caller, sequence, report.as_ref()))
}

pub fn request() -> impl Strategy<Value = Vec<u8>> {
    let question = (caller(), any::<u64>())
        .prop_map(|(caller, sequence)| written(&Letter { caller, words: Words::Ask { sequence } }, None));
    let news = (caller(), any::<u32>(), progress()).prop_map(|(caller, walk, progress)| {
        let words = Words::Progress(WalkId(walk), Cow::Owned(progress));
        written(&Letter { caller, words }, None)
    });
    prop_oneof![4 => offer(), 1 => question, 1 => news]
}

/// A turn as the server gives it.
pub fn given(sequence: u64, mixture_version: u64, assignment: &Assignment) -> Vec<u8> {
    let assignment = Cow::Borrowed(assignment);
    written(&Answer { sequence, decision: Decision::Turn { mixture_version, assignment } }, None)
}

pub fn answer() -> impl Strategy<Value = Vec<u8>> {
    let turn = (any::<u64>(), any::<u64>(), assignment())
        .prop_map(|(sequence, version, assignment)| given(sequence, version, &assignment));
    let other = (any::<u64>(), 0..3).prop_map(|(sequence, which)| {
        let decision = match which {
            0 => Decision::Home,
            1 => Decision::Wait,
            _ => Decision::Unknown,
        };
        written(&Answer { sequence, decision }, None)
    });
    prop_oneof![3 => turn, 1 => other]
}
