//! What the guard and the repulsion at short range mean for the pairs of elements in the seed structures.

use std::collections::BTreeMap;

use atoms::ElementPair;
use potentials::ZblWindow;

use super::loader::Loader;
use super::seed_structures::SourcedStructure;
use crate::config::{Config, Warning, location};

/// Number of pairs that a warning names.
const MAX_SHOWN: usize = 5;

/// A pair of elements that occur together in a seed structure.
#[derive(Clone, Debug)]
pub struct PairRange {
    /// The elements.
    pub pair: ElementPair,
    /// Their shortest distance in all seed structures, Å; infinite if they are farther apart than the cutoff everywhere.
    pub shortest: f64,
    /// Name of the seed structure with that distance; empty if it is infinite.
    pub seed_structure: String,
    /// The lowest of the limits of `guard.min_distances` in walks from all seed structures, Å.
    pub limit: f64,
    /// The window of the repulsion.
    pub zbl: Option<ZblWindow>,
}

/// All pairs of elements that occur together in a seed structure, those nearest to guard or repulsion first. Atoms that
/// start farther apart than the cutoff may meet in a walk.
pub fn pair_ranges(config: &Config, seeds: &[SourcedStructure]) -> Vec<PairRange> {
    let mut ranges: BTreeMap<ElementPair, PairRange> = BTreeMap::new();
    for SourcedStructure { plan, geometry, .. } in seeds {
        let limits: BTreeMap<_, _> = config.guard.min_distances.limits(&geometry.shortest).iter().collect();
        for (pair, distance) in geometry.shortest.iter() {
            let range = ranges.entry(pair).or_insert_with(|| PairRange {
                pair,
                shortest: f64::INFINITY,
                seed_structure: String::new(),
                limit: f64::INFINITY,
                zbl: config.guard.zbl.as_ref().map(|windows| windows.window(pair)),
            });
            range.limit = limits.get(&pair).map_or(range.limit, |limit| limit.min(range.limit));
            if distance < range.shortest {
                range.shortest = distance;
                range.seed_structure.clone_from(&plan.name);
            }
        }
    }
    let mut ranges: Vec<_> = ranges.into_values().collect();
    ranges.sort_by(|a, b| a.relative().total_cmp(&b.relative()));
    ranges
}

impl PairRange {
    /// The shortest distance divided by the largest distance at which guard or repulsion acts.
    pub fn relative(&self) -> f64 {
        self.shortest / self.zbl.map_or(self.limit, |window| window.outer.max(self.limit))
    }

    /// Whether the repulsion reaches into bonds.
    fn is_repelled(&self) -> bool {
        self.zbl.is_some_and(|window| window.outer > self.shortest)
    }
}

impl Loader<'_> {
    /// Warns of pairs of elements whose repulsion reaches into bonds of the seed structures, the worst ones by name.
    pub fn repulsion_in_bonds(&self, ranges: &[PairRange]) -> Option<Warning> {
        let mut repelled: Vec<_> = ranges.iter().filter(|range| range.is_repelled()).collect();
        repelled.sort_by(|a, b| a.relative().total_cmp(&b.relative()));
        let worst = |range: &&PairRange| {
            let PairRange { pair, shortest, seed_structure, zbl, .. } = range;
            let outer = zbl.map_or(0.0, |window| window.outer);
            format!(
                "{pair} reaches to {outer:.3} Å and changes distances of {shortest:.3} Å in '{seed_structure}'"
            )
        };
        let shown: Vec<_> = repelled.iter().take(MAX_SHOWN).map(worst).collect();
        let more = match repelled.len().saturating_sub(MAX_SHOWN) {
            0 => String::new(),
            more => format!("; and {more} more pairs (calmwalk validate shows them)"),
        };
        (!repelled.is_empty()).then(|| Warning {
            at: location(self.path, self.text, "guard.zbl"),
            key: "guard.zbl".to_owned(),
            message: format!(
                "the repulsion reaches into bonds of seed structures: {}{more}; give these pairs shorter windows in \
                 guard.zbl.pairs",
                shown.join("; ")
            ),
        })
    }
}
