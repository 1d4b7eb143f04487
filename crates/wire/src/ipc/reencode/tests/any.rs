//! Strategies for arbitrary messages, encoded as by their senders.

use std::borrow::Cow;

use proptest::collection::{btree_set, vec};
use proptest::option;
use proptest::prelude::*;

use super::common::{candidate, origin, usable_structure};
use super::encode_message;
use crate::block::Candidate;
use crate::conditions::{CellConditions, ConstantPressure, WalkConditions};
use crate::ids::{CampaignId, Origin, WalkId};
use crate::messages::{
    Assignment, AssignmentReport, AssignmentStart, DeclineReason, Outcome, Verdict, WalkEnd, WalkProgress,
};
use crate::protocol::message::{Answer, AnswerBody, Envelope, Payload, SenderId};
use crate::walk_frame::WalkFrame;
use crate::walk_trace::TracePoint;

fn verdict() -> impl Strategy<Value = Verdict> {
    prop_oneof![
        Just(Verdict::Accepted),
        prop::sample::select(DeclineReason::ALL.to_vec()).prop_map(Verdict::Declined)
    ]
}

fn end() -> impl Strategy<Value = WalkEnd> {
    prop_oneof![
        Just(WalkEnd::Completed),
        Just(WalkEnd::VolumeBoundary),
        Just(WalkEnd::QuotaReached),
        Just(WalkEnd::Budget),
        Just(WalkEnd::Superseded),
        Just(WalkEnd::NothingNew),
        ".{0,40}".prop_map(|guard| WalkEnd::Trapped { guard }),
        ".{0,40}".prop_map(|reason| WalkEnd::Diverged { reason }),
        ".{0,40}".prop_map(|reason| WalkEnd::InvalidStart { reason }),
    ]
}

fn progress() -> impl Strategy<Value = WalkProgress> {
    let numbers = [(); 4].map(|()| -1e3..1e9);
    let counts = (any::<u64>(), any::<u32>(), any::<Option<(u64, u64)>>());
    let reference = (any::<Option<u64>>(), option::of(1.0..1e6));
    (any::<u64>(), any::<u32>(), numbers, counts, reference).prop_map(
        |(step, segment, [tau, temperature, relative_volume, gamma_max], counts, reference)| {
            let (rejected, rollbacks, last_rollback) = counts;
            let (reference_step, reference_volume) = reference;
            WalkProgress {
                step,
                segment,
                tau,
                temperature,
                relative_volume,
                gamma_max,
                rejected,
                rollbacks,
                last_rollback,
                reference_step,
                reference_volume,
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
        conditions(),
    );
    (ids, origin(), usable_structure(), rest).prop_map(|(ids, origin, seed_structure, rest)| {
        let (campaign, walk, random_walk, number, last_step) = ids;
        let (checkpoint, verdict, frame_steps, threshold_factor, conditions) = rest;
        let (campaign, walk, random_walk) = (CampaignId(campaign), WalkId(walk), WalkId(random_walk));
        let frame_steps =
            if origin == Origin::Control { frame_steps.into_iter().collect() } else { Vec::new() };
        Assignment {
            campaign,
            walk,
            number,
            origin,
            random_walk,
            seed_structure,
            conditions,
            checkpoint,
            verdict,
            last_step,
            frame_steps,
            threshold_factor,
        }
    })
}

fn conditions() -> impl Strategy<Value = WalkConditions> {
    let ramp = (0.1..9.0, 0.1..9.0).prop_map(|(from, to)| CellConditions::VolumeRamp { from, to });
    let constant = (-1e5..1e5, 0.1..9.0, any::<bool>()).prop_map(|(pressure, start_volume, cell_bias)| {
        CellConditions::ConstantPressure(ConstantPressure { pressure, start_volume, cell_bias })
    });
    let cell = prop_oneof![Just(CellConditions::Fixed), ramp, constant];
    ("[a-z]{0,9}", 1.0..9000.0, 0.0..9.0, cell, any::<u32>(), any::<u32>()).prop_map(
        |(group, temperature, tau, cell, repeat, version)| WalkConditions {
            group,
            temperature,
            tau,
            cell,
            repeat,
            version,
        },
    )
}

pub fn report() -> impl Strategy<Value = AssignmentReport<Candidate>> {
    let outcome = prop_oneof![
        candidate().prop_map(Outcome::Candidate),
        Just(Outcome::StepsDone),
        Just(Outcome::Interrupted),
        end().prop_map(Outcome::Ended),
    ];
    let names = (any::<u32>(), any::<u64>(), option::of(start()));
    let points = (vec(trace_point(), 0..5), vec(walk_frame(), 0..3));
    (names, outcome, vec(any::<u8>(), 0..300), progress(), points).prop_map(
        |((walk, assignment, start), outcome, checkpoint, progress, (trace, frames))| {
            let walk = match &outcome {
                Outcome::Candidate(candidate) => candidate.id.walk,
                _ => WalkId(walk),
            };
            AssignmentReport { walk, assignment, start, outcome, checkpoint, progress, trace, frames }
        },
    )
}

fn start() -> impl Strategy<Value = AssignmentStart> {
    (progress(), any::<u64>(), 1.0..9.0, option::of(verdict())).prop_map(
        |(progress, mixture_version, threshold_factor, verdict)| AssignmentStart {
            position: progress.position(),
            mixture_version,
            threshold_factor,
            verdict,
        },
    )
}

fn walk_frame() -> impl Strategy<Value = WalkFrame> {
    let numbers = [(); 11].map(|()| -1e3..1e9);
    (any::<u32>(), any::<u64>(), numbers, vec(any::<[i64; 3]>(), 0..5)).prop_map(
        |(segment, step, [time, temperature, cell @ ..], positions)| WalkFrame {
            segment,
            step,
            time,
            temperature,
            cell: std::array::from_fn(|row| std::array::from_fn(|axis| cell[3 * row + axis])),
            positions,
        },
    )
}

fn trace_point() -> impl Strategy<Value = TracePoint> {
    let place = (any::<u64>(), any::<u32>(), any::<u64>());
    let (missing, number) = (|| option::of(-1e3..1e9), || -1e3..1e9);
    let state = (number(), number(), missing(), number(), option::of([(); 6].map(|()| 0.0..180.0)));
    let bias = (missing(), missing(), number(), number(), number(), number(), missing());
    (place, state, bias).prop_map(|(place, state, bias)| {
        let (number, segment, step) = place;
        let (time, temperature, pressure, relative_volume, cell) = state;
        let (conserved_energy, gamma_max, bias_scale, cell_gain, bias_share, bias_work, gamma_max_original) =
            bias;
        TracePoint {
            number,
            segment,
            step,
            time,
            temperature,
            pressure,
            relative_volume,
            cell,
            conserved_energy,
            gamma_max,
            bias_scale,
            cell_gain,
            bias_share,
            bias_work,
            gamma_max_original,
        }
    })
}

pub fn sender() -> impl Strategy<Value = SenderId> {
    (any::<u64>(), any::<u32>(), any::<u32>()).prop_map(|(session, walker, incarnation)| SenderId {
        session,
        walker,
        incarnation,
    })
}

/// An offer as a walker sends it.
pub fn offered(sender: SenderId, sequence: u64, report: Option<&AssignmentReport<Candidate>>) -> Vec<u8> {
    let (payload, candidate) = Payload::offer(sequence, report);
    encode_message(&Envelope { sender, payload }, candidate)
}

pub fn offer() -> impl Strategy<Value = Vec<u8>> {
    (sender(), any::<u64>(), option::weighted(0.8, report()))
        .prop_map(|(sender, sequence, report)| offered(sender, sequence, report.as_ref()))
}

pub fn request() -> impl Strategy<Value = Vec<u8>> {
    let poll = (sender(), any::<u64>()).prop_map(|(sender, sequence)| {
        encode_message(&Envelope { sender, payload: Payload::Poll { sequence } }, None)
    });
    let news = (sender(), any::<u32>(), progress()).prop_map(|(sender, walk, progress)| {
        let payload = Payload::Progress(WalkId(walk), Cow::Owned(progress));
        encode_message(&Envelope { sender, payload }, None)
    });
    prop_oneof![4 => offer(), 1 => poll, 1 => news]
}

/// An assignment as the server sends it.
pub fn given(sequence: u64, mixture_version: u64, assignment: &Assignment) -> Vec<u8> {
    let assignment = Cow::Borrowed(assignment);
    encode_message(&Answer { sequence, body: AnswerBody::Assignment { mixture_version, assignment } }, None)
}

pub fn answer() -> impl Strategy<Value = Vec<u8>> {
    let assigned = (any::<u64>(), any::<u64>(), assignment())
        .prop_map(|(sequence, version, assignment)| given(sequence, version, &assignment));
    let other = (any::<u64>(), 0..3).prop_map(|(sequence, which)| {
        let body = match which {
            0 => AnswerBody::Shutdown,
            1 => AnswerBody::Pending,
            _ => AnswerBody::Unknown,
        };
        encode_message(&Answer { sequence, body }, None)
    });
    prop_oneof![3 => assigned, 1 => other]
}
