//! Mixtures whose numbers encode their version.

use std::sync::Arc;

use calm::{ChangedComponent, Component, Mixture};

/// Number of features; makes a block larger than a page.
pub const DIMENSION: usize = 24;
/// Components of each element.
pub const SHAPE: [usize; 3] = [3, 1, 2];

/// Random numbers (splitmix64), the same in every run.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub fn below(&mut self, limit: usize) -> usize {
        (self.next() % limit as u64) as usize
    }
}

/// A component in which every number is `stamp`.
pub fn stamped(stamp: u64) -> Arc<Component> {
    let number = stamp as f64;
    let (centroid, inverse) = (vec![number; DIMENSION], vec![number; DIMENSION * DIMENSION]);
    Arc::new(Component::new(centroid, inverse, number, None).unwrap())
}

/// Version 0, all stamps 0.
pub fn first() -> Arc<Mixture> {
    let elements = SHAPE.map(|count| (0..count).map(|_| stamped(0)).collect());
    Arc::new(Mixture::new(0, elements.to_vec()).unwrap())
}

/// Whether a component changes in a version; about every second one does.
pub fn changes(version: u64, place: usize) -> bool {
    version > 0 && Random(version * 64 + place as u64).below(2) == 0
}

/// The version that introduced a component of `version`.
pub fn stamp(version: u64, place: usize) -> u64 {
    (0..=version).rev().find(|&version| changes(version, place)).unwrap_or(0)
}

/// The version after `mixture`.
pub fn next(mixture: &Mixture) -> Arc<Mixture> {
    let version = mixture.version() + 1;
    let changed = mixture.iter().enumerate().filter(|(place, _)| changes(version, *place));
    let changed: Vec<_> = changed
        .map(|(_, (element, slot, _))| ChangedComponent { element, slot, component: stamped(version) })
        .collect();
    Arc::new(mixture.with_changes(&changed).unwrap())
}

/// Checks every number of a mixture.
pub fn check(mixture: &Mixture) {
    assert_eq!(mixture.iter().count(), SHAPE.iter().sum::<usize>());
    for (place, (element, slot, component)) in mixture.iter().enumerate() {
        let (version, expected) = (mixture.version(), stamp(mixture.version(), place) as f64);
        let threshold = component.threshold();
        let numbers = component.inverse().iter().chain(component.centroid());
        let mut numbers = numbers.chain(std::iter::once(&threshold)).enumerate();
        if let Some((index, found)) = numbers.find(|&(_, number)| *number != expected) {
            panic!(
                "version {version}, component {slot} of {element}: number {index} is {found}, not {expected}"
            );
        }
        let lengths = (component.inverse().len(), component.centroid().len());
        assert_eq!(lengths, (DIMENSION * DIMENSION, DIMENSION));
    }
}
