//! Biased walks compared with their controls, matched by pairs and pooled, with confidence intervals.

mod groups;
mod pairs;
mod ranked_atoms;
#[cfg(test)]
mod tests;
mod units;

use std::collections::HashSet;

use analysis::{Bootstrap, ERROR_THRESHOLDS};
use serde::Serialize;
use wire::{ContentHash, Origin};

use super::frames::{ComparedAtom, ComparedFrame, ComparedFrames, FailedFrame};

pub use groups::{ComparedGroup, ElementRanking, GradeRanking};
pub use pairs::{PairCounts, PairPoint, PairedErrors, PairedQuantity, PairedTests};
pub use units::{ConfidenceEstimate, MIN_UNITS, ResampledUnit, ResamplingUnits};

/// The resampling of all intervals: they hold the true value with a probability of 95 %.
pub const COMPARISON_BOOTSTRAP: Bootstrap = Bootstrap { draws: 1000, level: 0.95, seed: 1 };

/// Biased walks beside their controls: the errors that the potential has for the structures of each, and how well its grades predict
/// them. Everything is of one version of the potential.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WalkComparison {
    /// Nominal coverage of the intervals.
    pub level: f64,
    /// Draws of the bootstrap.
    pub draws: u32,
    /// Its random seed.
    pub rng_seed: u64,
    /// Labelled structures: candidates of biased walks and frames of control walks.
    pub structures: u64,
    /// Of them, those of the walks in the sample that the comparison is of: all, except in very large campaigns.
    pub sampled_structures: u64,
    /// Of these, those that the queue chose by value: they are no random sample of what was found.
    pub chosen_by_value: u64,
    /// Label jobs of the protocol that wait or are in work, of all versions of the potential.
    pub unfinished: u64,
    /// Their atoms with finite grades and errors.
    pub atoms: u64,
    /// Of them, those in the sample for ranks and medians.
    pub sampled_atoms: u64,
    /// Thresholds of the force error, eV/Å, of each list of ROC-AUC.
    pub thresholds: Vec<f64>,
    /// Errors of structures, pair by pair.
    pub pairs: PairedErrors,
    /// The structures of the pairs.
    pub matched: MatchedGroups,
    /// All labelled structures, with a partner or without.
    pub pooled: PooledGroups,
}

/// Both sides of the pairs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MatchedGroups {
    /// The candidates of biased walks.
    pub biased: ComparedGroup,
    /// The frames of their controls.
    pub control: ComparedGroup,
}

/// All labelled structures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PooledGroups {
    /// Of both origins. Structures that walks of both found count once.
    pub all: ComparedGroup,
    /// Of biased walks, without those that control walks found as well.
    pub biased: ComparedGroup,
    /// Of control walks, without those that biased walks found as well.
    pub control: ComparedGroup,
}

impl WalkComparison {
    /// Compares the structures. The intervals cost some 40 ns for each draw, grade and atom, of at most 16,384 atoms of a group: about
    /// ten seconds of one core, shared by all cores, in a large campaign.
    pub(super) fn new(frames: &ComparedFrames, bootstrap: Bootstrap) -> Self {
        let matched = pairs::match_frames(frames);
        let labelled: Vec<&ComparedFrame> = frames.labelled().collect();
        let atoms: Vec<&ComparedAtom> = frames.atoms.items().collect();
        let pooled = |origins: &[Origin], with_shared: bool| {
            let is_in = |origin: Origin, is_shared: bool| {
                // A structure of both origins is there once, as that of the biased walk.
                origins.contains(&origin) && (!is_shared || (with_shared && origin == Origin::Biased))
            };
            let of: Vec<_> =
                labelled.iter().copied().filter(|frame| is_in(frame.place.origin, frame.is_shared)).collect();
            let atoms = atoms.iter().copied().filter(|atom| is_in(atom.place.origin, atom.is_shared));
            ComparedGroup::new(&of, &atoms.collect::<Vec<_>>(), failed(frames, origins), bootstrap)
        };
        let matched_group = |origin: Origin| {
            let place = usize::from(origin == Origin::Control);
            let of: Vec<_> = matched.pairs.iter().map(|pair| pair[place]).collect();
            let places: HashSet<_> = of.iter().map(|frame| (frame.place.walk, frame.at)).collect();
            let is_in = |atom: &&ComparedAtom| {
                atom.place.origin == origin && places.contains(&(atom.place.walk, atom.at))
            };
            let atoms: Vec<_> = atoms.iter().copied().filter(is_in).collect();
            ComparedGroup::new(&of, &atoms, matched.failed(origin), bootstrap)
        };
        Self {
            level: bootstrap.level,
            draws: bootstrap.draws,
            rng_seed: bootstrap.seed,
            structures: frames.labelled_in_all(),
            sampled_structures: labelled.len() as u64,
            chosen_by_value: labelled.iter().filter(|frame| frame.by_value).count() as u64,
            unfinished: frames.unfinished,
            atoms: frames.atoms.total(),
            sampled_atoms: atoms.len() as u64,
            thresholds: ERROR_THRESHOLDS.to_vec(),
            matched: MatchedGroups {
                biased: matched_group(Origin::Biased),
                control: matched_group(Origin::Control),
            },
            pooled: PooledGroups {
                all: pooled(&[Origin::Biased, Origin::Control], true),
                biased: pooled(&[Origin::Biased], false),
                control: pooled(&[Origin::Control], false),
            },
            pairs: PairedErrors::new(&matched, bootstrap),
        }
    }
}

/// Number of structures of these origins whose labels failed. Those that walks of both origins found count for both together only.
fn failed(frames: &ComparedFrames, origins: &[Origin]) -> u64 {
    let is_of =
        |failed: &&FailedFrame| origins.contains(&failed.origin) && (origins.len() > 1 || !failed.is_shared);
    let of = frames.failed().filter(is_of);
    of.map(|failed| failed.content).collect::<HashSet<ContentHash>>().len() as u64
}
