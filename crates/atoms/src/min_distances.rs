//! Shortest allowed distances between atoms: the guard of walks against atoms that are too close.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{ElementPair, ShortestDistances};

/// How the shortest allowed distances of a walk follow from its seed structure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "rule", rename_all = "snake_case")]
pub enum MinDistanceRule {
    /// For each pair of elements.
    PerPair(PerPair),
    /// One distance for all pairs (paper).
    Uniform(Uniform),
}

/// Pairs that are bonded in the seed structure, d⁰ < `bond_cutoff` Σr, keep d ≥ `bonded` d⁰; all others keep
/// d ≥ `nonbonded` Σr. d⁰ is the shortest distance of the pair of elements there, Σr the sum of their covalent radii.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PerPair {
    /// Shortest allowed distance of a bonded pair, as a fraction of d⁰, its shortest distance in the seed structure.
    pub bonded: f64,
    /// Shortest allowed distance of a pair that is not bonded, as a fraction of Σr, the sum of the covalent radii.
    pub nonbonded: f64,
    /// Longest bond, as a multiple of Σr, the sum of the covalent radii.
    pub bond_cutoff: f64,
    /// Shortest allowed distances of single pairs, Å, instead of these rules.
    #[schemars(
        with = "BTreeMap<String, f64>",
        extend(
            "additionalProperties" = false,
            "patternProperties" = { "^[A-Z][a-z]?-[A-Z][a-z]?$": { "type": "number", "exclusiveMinimum": 0 } },
        )
    )]
    pub pairs: BTreeMap<ElementPair, f64>,
}

/// max(`min_distance`, `fraction` d_nn⁰) for all pairs, where d_nn⁰ is the seed structure's shortest distance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Uniform {
    /// Shortest allowed distance, Å (paper: 1.2).
    pub min_distance: f64,
    /// Fraction of the shortest distance (paper: 0.75).
    pub fraction: f64,
}

/// The shortest allowed distance of each pair of elements of a walk, Å.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MinDistances(BTreeMap<ElementPair, f64>);

/// Atoms that are too close.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CloseContact {
    /// Their elements.
    pub pair: ElementPair,
    /// Å.
    pub distance: f64,
    /// Shortest allowed distance, Å.
    pub limit: f64,
}

/// A distance below this multiple of the sum of covalent radii is no bond of any structure: H₂, the shortest bond, has
/// 1.2.
const IMPOSSIBLE: f64 = 0.5;

impl Default for MinDistanceRule {
    fn default() -> Self {
        Self::PerPair(PerPair::default())
    }
}

impl Default for PerPair {
    fn default() -> Self {
        Self { bonded: 0.75, nonbonded: 0.65, bond_cutoff: 1.3, pairs: BTreeMap::new() }
    }
}

impl Default for Uniform {
    fn default() -> Self {
        Self { min_distance: 1.2, fraction: 0.75 }
    }
}

impl MinDistanceRule {
    /// The limits of walks from a seed structure with these shortest distances.
    pub fn limits(&self, seed: &ShortestDistances) -> MinDistances {
        let limit = |(pair, d): (ElementPair, f64)| match self {
            Self::PerPair(rule) => (pair, rule.limit(pair, d)),
            Self::Uniform(rule) => (pair, rule.limit(seed.shortest())),
        };
        MinDistances(seed.iter().map(limit).collect())
    }

    /// Why no walk can start from a seed structure with these shortest distances.
    pub fn prevents_start(&self, seed: &ShortestDistances) -> Option<CloseContact> {
        let limit = |pair: ElementPair| match self {
            Self::PerPair(rule) => {
                rule.pairs.get(&pair).copied().unwrap_or(IMPOSSIBLE * pair.covalent_radii())
            }
            Self::Uniform(rule) => rule.min_distance,
        };
        let contact = |(pair, distance)| CloseContact { pair, distance, limit: limit(pair) };
        seed.iter().map(contact).find(|contact| contact.distance < contact.limit)
    }
}

impl PerPair {
    fn limit(&self, pair: ElementPair, seed: f64) -> f64 {
        let radii = pair.covalent_radii();
        match self.pairs.get(&pair) {
            Some(limit) => *limit,
            None if seed < self.bond_cutoff * radii => self.bonded * seed,
            None => self.nonbonded * radii,
        }
    }
}

impl Uniform {
    fn limit(&self, shortest: f64) -> f64 {
        match shortest.is_finite() {
            true => self.min_distance.max(self.fraction * shortest),
            false => self.min_distance,
        }
    }
}

impl MinDistances {
    /// The first pair of elements with atoms closer than its limit.
    pub fn violation(&self, shortest: &ShortestDistances) -> Option<CloseContact> {
        let contact = |(pair, distance)| {
            Some(CloseContact { pair, distance, limit: *self.0.get(&pair)? }).filter(|c| c.distance < c.limit)
        };
        shortest.iter().find_map(contact)
    }

    /// Each pair of elements with its limit, Å.
    pub fn iter(&self) -> impl Iterator<Item = (ElementPair, f64)> + '_ {
        self.0.iter().map(|(pair, limit)| (*pair, *limit))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cell, NeighbourList, Structure};

    /// Hydrogen in and beside nickel: an H₂ molecule, and an atom at a Ni–H distance.
    fn seed(hydrogen: f64) -> ShortestDistances {
        let species = ["Ni", "Ni", "H", "H"].map(|symbol| symbol.parse().unwrap()).to_vec();
        let positions = vec![[0.0; 3], [2.49, 0.0, 0.0], [0.0, 1.8, 0.0], [0.0, 1.8, hydrogen]];
        let cell = Cell::orthorhombic(20.0, 20.0, 20.0);
        let structure = Structure { species, positions, cell, periodic: [false; 3] };
        let mut neighbours = NeighbourList::new(6.0, 0.0);
        neighbours.update(&structure).unwrap();
        ShortestDistances::from_neighbours(&structure, &neighbours)
    }

    fn limit(limits: &MinDistances, pair: &str) -> f64 {
        let pair = ElementPair::try_from(pair.to_owned()).unwrap();
        limits.iter().find(|(found, _)| *found == pair).unwrap().1
    }

    #[test]
    fn bonds_and_other_pairs_have_limits_of_their_own() {
        let rule = MinDistanceRule::default();
        let limits = rule.limits(&seed(0.74));
        assert!((limit(&limits, "H-H") - 0.75 * 0.74).abs() < 1e-12);
        assert!((limit(&limits, "Ni-H") - 0.75 * 1.8).abs() < 1e-12, "1.8 Å is below 1.3 · 1.55 Å");
        assert!((limit(&limits, "Ni-Ni") - 0.75 * 2.49).abs() < 1e-12);
        // Hydrogen atoms that are far apart may form a molecule during the walk.
        let limits = rule.limits(&seed(3.0));
        assert!((limit(&limits, "H-H") - 0.65 * 0.62).abs() < 1e-12);
        assert_eq!(limits.violation(&seed(0.74)), None);
        let contact = limits.violation(&seed(0.35)).unwrap();
        assert!(contact.pair.to_string() == "H-H" && contact.distance < contact.limit);
    }

    #[test]
    fn single_pairs_can_be_set() {
        let pairs = BTreeMap::from([(ElementPair::try_from("H-Ni".to_owned()).unwrap(), 1.2)]);
        let rule = MinDistanceRule::PerPair(PerPair { pairs, ..PerPair::default() });
        assert_eq!(limit(&rule.limits(&seed(0.74)), "Ni-H"), 1.2);
        assert_eq!(rule.prevents_start(&seed(0.74)), None);
        assert_eq!(rule.prevents_start(&seed(0.30)).unwrap().pair.to_string(), "H-H");
    }

    #[test]
    fn the_papers_rule_is_one_distance_for_all() {
        let rule = MinDistanceRule::Uniform(Uniform::default());
        let limits = rule.limits(&seed(2.0));
        assert!(limits.iter().all(|(_, limit)| (limit - 0.75 * 1.8).abs() < 1e-12));
        assert!(rule.limits(&seed(1.5)).iter().all(|(_, limit)| limit == 1.2));
        assert_eq!(rule.prevents_start(&seed(2.0)), None);
        assert_eq!(
            rule.prevents_start(&seed(0.74)).unwrap().limit,
            1.2,
            "the paper's rule knows no hydrogen"
        );
    }

    #[test]
    fn rules_are_written_as_in_a_configuration() {
        let rule: MinDistanceRule =
            serde_json::from_str(r#"{ "rule": "per_pair", "pairs": { "O-H": 0.7 } }"#).unwrap();
        let MinDistanceRule::PerPair(found) = &rule else { panic!("{rule:?}") };
        assert_eq!((found.bonded, found.pairs.len()), (0.75, 1));
        let text = serde_json::to_string(&rule).unwrap();
        assert_eq!(serde_json::from_str::<MinDistanceRule>(&text).unwrap(), rule);
        assert!(serde_json::from_str::<MinDistanceRule>(r#"{ "rule": "uniform", "bonded": 1 }"#).is_err());
    }
}
