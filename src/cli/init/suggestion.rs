//! Settings that are suggested for a model and its seed structures.

use std::collections::{BTreeMap, BTreeSet};

use atoms::{Repetition, Species, Structure};
use potentials::{RadiiWindows, ZblWindow, ZblWindows};

use super::one_phase;
use crate::campaign::{CampaignDraft, PairRange};

/// Smallest periodic seed structures, as in configs/foundation-campaign.toml: in a smaller cell all copies of an atom move
/// together.
pub const MIN_ATOMS: usize = 16;
/// Å.
pub const MIN_HEIGHT: f64 = 6.0;

/// The paper's τ, for a model with a wide domain: one of at least `WIDE_DOMAIN` elements.
const WIDE_TAU: f64 = 2.0;
/// For a model of few elements: 0.15 to 0.4 drives it far enough, and 2 into compressed pairs.
const NARROW_TAU: f64 = 0.3;
const WIDE_DOMAIN: usize = 5;

/// K. Molecules fall apart at temperatures at which crystals melt.
const CRYSTAL_TEMPERATURES: [f64; 3] = [300.0, 1000.0, 2000.0];
const MOLECULE_TEMPERATURES: [f64; 3] = [300.0, 600.0, 1000.0];

/// V/V₀ at the begin and the end of a walk: the paper's stretching, and compression.
const VOLUME_RAMPS: [[f64; 2]; 2] = [[1.0, 1.4], [1.0, 0.8]];
const CONSTANT_VOLUME: [f64; 2] = [1.0, 1.0];

/// The paper's rule counts atoms and asks for three at least: too many in a smaller molecule.
const MIN_COUNTED_ATOMS: u64 = 6;

/// A window that would reach into bonds of a seed structure ends at this fraction of the shortest one.
const BOND_FRACTION: f64 = 0.95;

/// Most walks of a round.
const MAX_WALKS_PER_ROUND: usize = 32;

/// Values of keys.
#[derive(Clone, Debug, PartialEq)]
pub struct SuggestedSettings {
    /// Whether the walks are those for a model of one phase.
    pub is_one_phase: bool,
    /// Atoms and height, Å, of the supercells that smaller cells become. `None`: no cell is smaller.
    pub supercells: Option<(usize, f64)>,
    /// Scale τ of the uncertainty force.
    pub tau: f64,
    /// K.
    pub temperatures: [f64; 3],
    /// V/V₀ from and to; empty if no structure has a volume.
    pub volume_ramps: Vec<[f64; 2]>,
    /// Whether candidates are found by the number of atoms above a threshold, or by γ_max.
    pub counts_atoms: bool,
    /// Windows of the repulsion. `None`: those by radii reach beyond the cutoff of the model.
    pub zbl: Option<ZblWindows>,
    /// Elements of the seed structures.
    pub elements: BTreeSet<Species>,
    /// Biased walks.
    pub walks: usize,
    /// Biased walks of a round.
    pub walks_per_round: usize,
}

impl SuggestedSettings {
    /// Settings with which any model and structures can be read.
    pub fn first_guess() -> Self {
        Self {
            is_one_phase: false,
            supercells: None,
            tau: WIDE_TAU,
            temperatures: CRYSTAL_TEMPERATURES,
            volume_ramps: Vec::new(),
            counts_atoms: false,
            zbl: None,
            elements: BTreeSet::new(),
            walks: 1,
            walks_per_round: 1,
        }
    }

    /// Settings for the model and the structures of a draft with those of the first guess. `has_artifact`: the mixture is updated.
    pub fn from_draft(draft: &CampaignDraft, has_artifact: bool) -> Self {
        let structures = || draft.seed_structures.iter().map(|named| &named.plan.structure);
        let all: Vec<_> = structures().collect();
        let is_narrow = draft.model.elements().len() < WIDE_DOMAIN;
        let is_one_phase = has_artifact && is_narrow && one_phase::is_one_phase(&all);
        let min_atoms = if is_one_phase { one_phase::MIN_ATOMS } else { MIN_ATOMS };
        let repetition = |structure: &Structure| Repetition::for_size(structure, min_atoms, MIN_HEIGHT);
        let atoms = |structure: &Structure| repetition(structure).cells() * structure.len() as u64;
        let has_volume = |structure: &Structure| structure.periodic != [false; 3];
        let model_elements = draft.model.elements();
        let temperatures =
            if structures().any(has_volume) { CRYSTAL_TEMPERATURES } else { MOLECULE_TEMPERATURES };
        let volume_ramps = volume_ramps(structures().any(has_volume), structures().all(has_volume));
        let walks = match is_one_phase {
            true => one_phase::walks(all.len()),
            false => all.len() * temperatures.len() * volume_ramps.len().max(1),
        };
        let is_small = structures().any(|structure| repetition(structure) != Repetition::ONE);
        Self {
            is_one_phase,
            supercells: is_small.then_some((min_atoms, MIN_HEIGHT)),
            walks,
            tau: if model_elements.len() < WIDE_DOMAIN { NARROW_TAU } else { WIDE_TAU },
            temperatures,
            volume_ramps,
            counts_atoms: structures().all(|structure| atoms(structure) >= MIN_COUNTED_ATOMS),
            zbl: zbl_windows(model_elements, draft.model.cutoff(), &draft.pair_ranges),
            elements: structures().flat_map(|structure| structure.species.iter().copied()).collect(),
            walks_per_round: if is_one_phase { 1 } else { walks.clamp(1, MAX_WALKS_PER_ROUND) },
        }
    }
}

/// Structures without a volume get walks only under a ramp that keeps it.
fn volume_ramps(some_have_volume: bool, all_have_volume: bool) -> Vec<[f64; 2]> {
    let mut ramps = if some_have_volume { VOLUME_RAMPS.to_vec() } else { Vec::new() };
    if some_have_volume && !all_have_volume {
        ramps.push(CONSTANT_VOLUME);
    }
    ramps
}

/// Windows by covalent radii, shorter where they would reach into bonds of the seed structures. A model of one element has one
/// window, in Å.
fn zbl_windows(elements: &[Species], cutoff: f64, ranges: &[PairRange]) -> Option<ZblWindows> {
    let by_radii = RadiiWindows::default();
    let relative_inner = by_radii.inner / by_radii.outer;
    let windows = ZblWindows::PerPair(by_radii.clone());
    let (widest_pair, widest) = windows.widest(elements).filter(|(_, window)| window.outer <= cutoff)?;
    let shortened = |range: &PairRange| {
        let is_repelled = range.shortest < windows.window(range.pair).outer;
        let outer = hundredths(BOND_FRACTION * range.shortest);
        is_repelled.then(|| (range.pair, ZblWindow { inner: hundredths(relative_inner * outer), outer }))
    };
    let pairs: BTreeMap<_, _> = ranges.iter().filter_map(shortened).collect();
    if elements.len() > 1 {
        return Some(ZblWindows::PerPair(RadiiWindows { pairs, ..by_radii }));
    }
    let window = ZblWindow { inner: hundredths(widest.inner), outer: hundredths(widest.outer) };
    Some(ZblWindows::Uniform(pairs.get(&widest_pair).copied().unwrap_or(window)))
}

/// `x` rounded down to hundredths.
fn hundredths(x: f64) -> f64 {
    (100.0 * x).floor() / 100.0
}

#[cfg(test)]
mod tests {
    use atoms::ElementPair;

    use super::*;

    fn species(symbol: &str) -> Species {
        symbol.parse().unwrap()
    }

    fn range(a: &str, b: &str, shortest: f64) -> PairRange {
        let pair = ElementPair::new(species(a), species(b));
        PairRange { pair, shortest, seed_structure: String::new(), limit: 0.1, zbl: None }
    }

    #[test]
    fn windows_end_before_bonds() {
        // Covalent radii: H 0.31 Å, Al 1.21 Å.
        let found = zbl_windows(&[species("Al")], 6.0, &[range("Al", "Al", 2.8)]);
        assert_eq!(found, Some(ZblWindows::Uniform(ZblWindow { inner: 1.33, outer: 1.81 })));
        let found = zbl_windows(&[species("Al")], 6.0, &[range("Al", "Al", 1.5)]);
        assert_eq!(found, Some(ZblWindows::Uniform(ZblWindow { inner: 1.04, outer: 1.42 })));
        assert_eq!(zbl_windows(&[species("Al")], 1.8, &[]), None);

        let ranges = [range("H", "H", 0.4), range("H", "Al", 1.7), range("Al", "Al", f64::INFINITY)];
        let found = zbl_windows(&[species("H"), species("Al")], 6.0, &ranges);
        let Some(ZblWindows::PerPair(RadiiWindows { inner, outer, pairs })) = found else {
            panic!("windows by radii")
        };
        assert_eq!((inner, outer, pairs.len()), (0.55, 0.75, 1));
        assert_eq!(pairs[&ranges[0].pair], ZblWindow { inner: 0.27, outer: 0.38 });
    }

    #[test]
    fn structures_without_a_volume_keep_it() {
        assert_eq!(volume_ramps(true, true), VOLUME_RAMPS);
        assert_eq!(volume_ramps(true, false).last(), Some(&CONSTANT_VOLUME));
        assert_eq!(volume_ramps(false, false), [[0.0; 2]; 0]);
    }
}
