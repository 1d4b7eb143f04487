//! Minimum bond lengths for pairs of elements.

use std::collections::BTreeMap;

use atoms::cell::norm;
use atoms::{ElementPair, NeighbourList, Structure};

/// The first bond shorter than the limit of its pair, with periodic images; or why that cannot be checked.
pub(super) fn too_short(structure: &Structure, shortest: &BTreeMap<ElementPair, f64>) -> Option<String> {
    let cutoff = shortest.values().copied().reduce(f64::max)?;
    let mut neighbours = NeighbourList::new(cutoff, 0.0);
    if let Err(error) = neighbours.update(structure) {
        return Some(error.to_string());
    }
    for i in 0..structure.len() {
        for neighbour in neighbours.neighbours_of(i) {
            let pair = ElementPair::new(structure.species[i], structure.species[neighbour.atom as usize]);
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
