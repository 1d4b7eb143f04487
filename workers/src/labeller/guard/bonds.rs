//! Minimum bond lengths for pairs of elements.

use std::collections::BTreeMap;
use std::fmt;

use atoms::cell::norm;
use atoms::{NeighbourList, Species, Structure};
use serde::{Deserialize, Serialize};

/// Two elements, in either order: `Al-O` is `O-Al`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Pair(Species, Species);

impl Pair {
    fn new(a: Species, b: Species) -> Self {
        Self(a.min(b), a.max(b))
    }
}

impl TryFrom<String> for Pair {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let parse = |(a, b): (&str, &str)| Some(Self::new(a.parse().ok()?, b.parse().ok()?));
        text.split_once('-')
            .and_then(parse)
            .ok_or_else(|| format!("'{text}' is not a pair of elements (expected one such as Si-O)"))
    }
}

impl From<Pair> for String {
    fn from(pair: Pair) -> Self {
        pair.to_string()
    }
}

impl fmt::Display for Pair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.0, self.1)
    }
}

/// The first bond shorter than the limit of its pair, with periodic images; or why that cannot be checked.
pub(super) fn too_short(structure: &Structure, shortest: &BTreeMap<Pair, f64>) -> Option<String> {
    let cutoff = shortest.values().copied().reduce(f64::max)?;
    let mut neighbours = NeighbourList::new(cutoff, 0.0);
    if let Err(error) = neighbours.update(structure) {
        return Some(error.to_string());
    }
    for i in 0..structure.len() {
        for neighbour in neighbours.neighbours_of(i) {
            let pair = Pair::new(structure.species[i], structure.species[neighbour.atom as usize]);
            let length = norm(neighbour.displacement(structure, i));
            if let Some(least) = shortest.get(&pair).filter(|least| length < **least) {
                return Some(format!(
                    "atoms {i} and {} are {length:.3} Å apart, where label.guard.min_bond_lengths of {pair} is {least}",
                    neighbour.atom
                ));
            }
        }
    }
    None
}
