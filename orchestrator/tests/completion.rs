//! Walks that avoid what cannot be labelled: a labeller that fails as the paper's did, and the share of collected structures
//! that it completes.
//!
//! Calculations fail with a probability that depends on the volume, p = 1 / (1 + exp(k (V/V₀ − v₀))). k and v₀ are such that 187 of
//! 225 frames of biased walks with volumes of 1 to 1.4 and 143 of 156 frames of control walks with volumes of 1 to 1.34
//! complete on average, as many as in the paper.

use monitor::completion_model::{CompletionExample, CompletionModel};
use orchestrator::selector::{CampaignMode, Selector, SelectorSettings, UpdateProtocol};
use wire::CompletionPredictors;
use wire::messages::Outcome;

use crate::common::{
    SHORTEST, at, begin, decided, expanded_block, kinds, next_assignment, report, settings, structure,
};

const BIASED_FRAMES: usize = 225;
const CONTROL_FRAMES: usize = 156;
/// Widths of the ranges of V/V₀, from 1 on.
const BIASED_EXPANSION: f64 = 0.4;
const CONTROL_EXPANSION: f64 = 0.34;
/// k and v₀.
const STEEPNESS: f64 = 23.620_361_07;
const HALF_VOLUME: f64 = 1.342_021_87;

/// Bins of γ, in each of which most structures complete.
const BINS: [(f64, f64); 3] = [(1.6, 2.2), (2.2, 2.8), (2.8, 4.0)];

fn probability(relative_volume: f64) -> f64 {
    1.0 / (1.0 + (STEEPNESS * (relative_volume - HALF_VOLUME)).exp())
}

/// Random numbers between 0 and 1 (SplitMix64).
struct Draws(u64);

impl Draws {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A frame: its volume, and its grade, which rises with the volume.
    fn frame(&mut self, expansion: f64) -> Frame {
        let relative_volume = 1.0 + expansion * self.next();
        let gamma = 1.6 + 2.0 * (relative_volume - 1.0) + 1.5 * self.next();
        Frame { gamma, relative_volume, completed: self.next() < probability(relative_volume) }
    }
}

#[derive(Clone, Copy, Debug)]
struct Frame {
    gamma: f64,
    relative_volume: f64,
    /// Whether its calculation completes.
    completed: bool,
}

impl Frame {
    fn example(&self) -> CompletionExample {
        let structure = structure(0, SHORTEST);
        let predictors =
            CompletionPredictors::of_structure(&structure, self.gamma, Some(self.relative_volume)).unwrap();
        CompletionExample { predictors, completed: self.completed, seed_structure: 0, walk: 0 }
    }
}

/// Collects as many structures as the paper's biased walks; each is labelled at once. With a rule, the selector gets the model of all labels
/// so far before the next candidate. Returns the structures and the number of candidates.
fn collect(seed: u64, min_probability: Option<f64>) -> (Vec<Frame>, u64) {
    let settings = SelectorSettings {
        update: UpdateProtocol::Never,
        max_per_walk: u32::MAX,
        ..settings(CampaignMode::Live)
    };
    let mut selector = begin(&settings, 1);
    min_probability.into_iter().for_each(|least| selector.decline_unlikely(least));
    let mut draws = Draws(seed);
    let (mut collected, mut examples, mut controls, mut candidates) = (Vec::new(), Vec::new(), 0, 0);
    while collected.len() < BIASED_FRAMES {
        let frame = draws.frame(BIASED_EXPANSION);
        candidates += 1;
        if !is_accepted(&mut selector, candidates, &frame) {
            continue;
        }
        collected.push(frame);
        examples.push(frame.example());
        while controls * BIASED_FRAMES < collected.len() * CONTROL_FRAMES {
            examples.push(draws.frame(CONTROL_EXPANSION).example());
            controls += 1;
        }
        if min_probability.is_some() {
            let model = CompletionModel::fit(&examples).unwrap();
            selector.set_completion_model(model.coefficients);
        }
    }
    (collected, candidates)
}

/// Offers a structure to the selector.
fn is_accepted(selector: &mut Selector, number: u64, frame: &Frame) -> bool {
    let assignment = next_assignment(selector);
    let (progress, z) = (at(number), [0.0, frame.gamma, 0.0]);
    let structure = structure(number, SHORTEST);
    let block =
        expanded_block(&assignment, selector.mixture(), &progress, structure, z, frame.relative_volume);
    let commit = decided(selector, report(&assignment, Outcome::Candidate(block), progress));
    match kinds(&commit)[0].as_str() {
        "accepted" => true,
        "declined unlikely_to_complete" => false,
        other => panic!("{other}: {commit:?}"),
    }
}

fn share<'a>(frames: impl IntoIterator<Item = &'a Frame>) -> (f64, usize) {
    let (number, completed) = frames
        .into_iter()
        .fold((0, 0), |(number, completed), frame| (number + 1, completed + usize::from(frame.completed)));
    (completed as f64 / number as f64, number)
}

#[test]
fn the_labeller_completes_as_many_as_the_papers() {
    let expected = |number: usize, expansion: f64| -> f64 {
        let volume = |k: usize| 1.0 + expansion * (k as f64 + 0.5) / number as f64;
        (0..number).map(|k| probability(volume(k))).sum()
    };
    assert!((expected(BIASED_FRAMES, BIASED_EXPANSION) - 187.0).abs() < 0.01);
    assert!((expected(CONTROL_FRAMES, CONTROL_EXPANSION) - 143.0).abs() < 0.01);
}

#[test]
fn most_collected_structures_complete_if_unlikely_ones_are_declined() {
    for seed in 1..4 {
        let ((today, _), (chosen, candidates)) = (collect(seed, None), collect(seed, Some(0.9)));
        let (all_today, all_chosen) = (share(&today).0, share(&chosen).0);
        assert!((0.77..0.89).contains(&all_today), "{all_today}");
        assert!(all_chosen >= 0.92, "{all_chosen}");
        // A third of the volumes is avoided, not more.
        assert!(candidates < 2 * BIASED_FRAMES as u64, "{candidates}");
        let mut matched = 0.0;
        for (from, to) in BINS {
            let inside = |frame: &&Frame| (from..to).contains(&frame.gamma);
            let (number, (after, of_chosen)) =
                (share(today.iter().filter(inside)).1, share(chosen.iter().filter(inside)));
            assert!(of_chosen >= 20 && after >= 0.92, "γ from {from}: {after} of {of_chosen}");
            matched += after * number as f64 / BIASED_FRAMES as f64;
        }
        assert!(matched >= 0.92, "with the grades of today's structures: {matched}");
    }
}
