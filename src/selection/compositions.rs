//! How many atoms of each element the structures of a pool have.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};

/// Distinct compositions, numbered from 0 in the order in which they were found. Each takes 8 bytes for each of its elements, and
/// about 50 bytes.
#[derive(Default)]
pub struct Compositions {
    /// Element index and number of atoms of each composition, one composition after another, by element index.
    counts: Vec<(u32, u32)>,
    /// Where each composition ends in `counts`.
    ends: Vec<usize>,
    /// The number of the first composition with a hash.
    numbers: HashMap<u64, u32>,
}

impl Compositions {
    /// The number of the composition of a structure with atoms of these elements, by element index.
    pub fn number(&mut self, elements: &[usize]) -> u32 {
        let mut sorted = elements.to_vec();
        sorted.sort_unstable();
        let same = sorted.chunk_by(|a, b| a == b);
        let counts: Vec<(u32, u32)> = same.map(|atoms| (atoms[0] as u32, atoms.len() as u32)).collect();
        let mut hasher = DefaultHasher::new();
        counts.hash(&mut hasher);
        let next = self.ends.len() as u32;
        let number = *self.numbers.entry(hasher.finish()).or_insert(next);
        if number != next && self.counts(number) == counts {
            return number;
        }
        // If another composition has this hash, the new one is stored each time that it is found.
        self.counts.extend(counts);
        self.ends.push(self.counts.len());
        next
    }

    /// Element index and number of atoms of each element of a composition, by element index.
    pub fn counts(&self, number: u32) -> &[(u32, u32)] {
        let number = number as usize;
        let begin = number.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.counts[begin..self.ends[number]]
    }

    /// Number of atoms of an element in a composition.
    pub fn atoms(&self, number: u32, element: usize) -> u64 {
        let counts = self.counts(number);
        let place = counts.binary_search_by_key(&element, |(element, _)| *element as usize);
        place.map_or(0, |place| counts[place].1.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_composition_is_stored_once_with_the_elements_that_it_has() {
        let mut compositions = Compositions::default();
        assert_eq!(compositions.number(&[88, 3, 88]), 0);
        assert_eq!(compositions.number(&[3, 3]), 1);
        assert_eq!(compositions.number(&[88, 88, 3]), 0);
        assert_eq!(compositions.number(&[3]), 2);
        assert_eq!((compositions.counts(0), compositions.counts(1)), (&[(3, 1), (88, 2)][..], &[(3, 2)][..]));
        assert_eq!([3, 88, 4].map(|element| compositions.atoms(0, element)), [1, 2, 0]);
        assert_eq!(compositions.atoms(2, 3), 1);
        assert_eq!((compositions.counts.len(), compositions.ends.len()), (4, 3));
    }
}
