//! Upper bounds of what atoms or structures are worth, for lazy evaluation (Minoux, Optimization Techniques 1978).
//!
//! Values only fall while structures are picked, so an old value is an upper bound of the new one. Only the largest bounds are
//! computed again, until the largest of all is up to date: it is then the largest value.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// An upper bound of a value.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bound {
    /// The value when it was computed.
    pub value: f64,
    /// Of equal values, that with the largest preference comes first.
    pub preference: f64,
    /// Index of the atom or structure. Of several that are equal otherwise, the first comes first.
    pub index: usize,
    /// Version of what the value depends on, when it was computed.
    pub version: usize,
}

/// Bounds, the largest of which is at hand.
#[derive(Debug, Default)]
pub(super) struct LazyHeap(BinaryHeap<Bound>);

impl LazyHeap {
    /// Adds a bound.
    pub fn push(&mut self, bound: Bound) {
        self.0.push(bound);
    }

    /// Removes the largest bound.
    pub fn pop(&mut self) -> Option<Bound> {
        self.0.pop()
    }

    /// The largest bound.
    pub fn largest(&self) -> Option<Bound> {
        self.0.peek().copied()
    }

    /// Removes bounds that are out of date and larger than all that are up to date, at most `count`, and returns their indices, the
    /// largest first. If there is none, the largest bound is up to date.
    ///
    /// `version` is the present version of an index, or `None` if it counts no longer; its bound is then dropped.
    pub fn take_outdated(&mut self, count: usize, version: impl Fn(usize) -> Option<usize>) -> Vec<usize> {
        let mut outdated = Vec::new();
        while outdated.len() < count
            && let Some(&top) = self.0.peek()
        {
            let present = version(top.index);
            if present == Some(top.version) {
                break;
            }
            self.0.pop();
            if present.is_some() {
                outdated.push(top.index);
            }
        }
        outdated
    }
}

/// By value, then preference, then the first index.
impl Ord for Bound {
    fn cmp(&self, other: &Self) -> Ordering {
        self.value
            .total_cmp(&other.value)
            .then_with(|| self.preference.total_cmp(&other.preference))
            .then_with(|| other.index.cmp(&self.index))
    }
}

impl PartialOrd for Bound {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Bound {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Bound {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_bounds_come_first_and_outdated_ones_are_taken_out() {
        let mut heap = LazyHeap::default();
        for (index, (value, preference)) in
            [(1.0, 0.0), (3.0, 1.0), (3.0, 2.0), (2.0, 0.0), (2.0, 0.0), (4.0, 0.0)].into_iter().enumerate()
        {
            heap.push(Bound { value, preference, index, version: index % 2 });
        }
        // Index 5 counts no longer; 2 and 1 are out of date, 3 is not.
        let version = |index: usize| [Some(0), Some(7), Some(7), Some(1), Some(7), None][index];
        assert_eq!(heap.take_outdated(1, version), [2]);
        assert_eq!(heap.take_outdated(9, version), [1]);
        assert!(heap.take_outdated(9, version).is_empty());
        assert_eq!(heap.largest().map(|bound| bound.index), Some(3));
        let order: Vec<_> = std::iter::from_fn(|| heap.pop()).map(|bound| bound.index).collect();
        assert_eq!(order, [3, 4, 0]);
    }
}
