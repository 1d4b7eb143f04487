//! What the guard and the repulsion at short range mean for the pairs of elements in the seed structures.

use std::collections::BTreeMap;

use atoms::ElementPair;
use potentials::ZblWindow;

use super::load::{Loader, SourcedStructure};
use crate::config::{Config, Warning, place};

/// A pair of elements that are neighbours in a seed structure.
#[derive(Clone, Debug)]
pub struct PairRange {
    /// The elements.
    pub pair: ElementPair,
    /// Their shortest distance in all seed structures, Å.
    pub shortest: f64,
    /// Name of the seed structure with that distance.
    pub seed_structure: String,
    /// The lowest of the limits of `guard.min_distances` in walks from all seed structures, Å.
    pub limit: f64,
    /// The window of the repulsion.
    pub zbl: Option<ZblWindow>,
}

/// All pairs with a distance within the cutoff of the model, in their order.
pub fn pair_ranges(config: &Config, seeds: &[SourcedStructure]) -> Vec<PairRange> {
    let mut ranges: BTreeMap<ElementPair, PairRange> = BTreeMap::new();
    for SourcedStructure { seed, geometry, .. } in seeds {
        let limits: BTreeMap<_, _> = config.guard.min_distances.limits(&geometry.shortest).iter().collect();
        for (pair, distance) in geometry.shortest.iter().filter(|(_, distance)| distance.is_finite()) {
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
                range.seed_structure.clone_from(&seed.name);
            }
        }
    }
    ranges.into_values().collect()
}

impl PairRange {
    /// A warning if the repulsion reaches into bonds.
    pub fn warning(&self) -> Option<String> {
        let Self { pair, shortest, seed_structure, zbl, .. } = self;
        let window = zbl.filter(|window| window.outer > *shortest)?;
        Some(format!(
            "the repulsion of {pair} reaches to {:.3} Å and changes distances of {shortest:.3} Å in seed structure \
             '{seed_structure}'; give this pair a shorter window in guard.zbl.pairs",
            window.outer
        ))
    }
}

impl Loader<'_> {
    /// Warns of pairs of elements whose repulsion reaches into bonds of the seed structures.
    pub fn repulsion_in_bonds(&self, ranges: &[PairRange]) -> Vec<Warning> {
        let warning = |message| Warning {
            at: place(self.path, self.text, "guard.zbl"),
            key: "guard.zbl".to_owned(),
            message,
        };
        ranges.iter().filter_map(PairRange::warning).map(warning).collect()
    }
}
