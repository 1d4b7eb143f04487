//! Which atoms are evaluated together.

use std::ops::Range;

use super::instructions::Instructions;
use super::tape::Batch;

/// Most atoms of a batch.
const MOST: usize = 16;

/// What the tape of a batch may take in memory, bytes; with its cotangents it should stay in the second cache.
const TAPE_BYTES: usize = 1 << 19;

/// The atoms of a structure, those of an element behind one another, and divided into batches.
#[derive(Clone, Debug, Default)]
pub(super) struct Batches {
    /// The atom at each place.
    pub order: Vec<u32>,
    /// Places, and the element of all atoms there.
    pub batches: Vec<(Range<usize>, usize)>,
}

impl Batches {
    /// For atoms of the elements given, each of which takes so many bytes of tape.
    pub fn update(&mut self, elements: &[usize], tape_bytes: usize) {
        let size = (TAPE_BYTES / tape_bytes.max(1)).clamp(1, MOST);
        self.order.clear();
        self.order.extend(0..elements.len() as u32);
        self.order.sort_unstable_by_key(|atom| (elements[*atom as usize], *atom));
        self.batches.clear();
        let mut start = 0;
        for atoms in self.order.chunk_by(|a, b| elements[*a as usize] == elements[*b as usize]) {
            for batch in atoms.chunks(size) {
                self.batches.push((start..start + batch.len(), elements[batch[0] as usize]));
                start += batch.len();
            }
        }
    }

    #[inline(always)]
    pub fn placed(&self, batch: usize, instructions: Instructions) -> Placed<'_> {
        let (places, element) = &self.batches[batch];
        let batch = Batch { element: *element, atoms: places.len(), instructions };
        Placed { batch, first: places.start, order: &self.order }
    }
}

/// A batch, and where it stands.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed<'a> {
    pub batch: Batch,
    /// Its first place.
    pub first: usize,
    /// The atom at each place of the whole structure.
    order: &'a [u32],
}

impl Placed<'_> {
    /// Places and atoms.
    #[inline(always)]
    pub fn atoms(&self) -> impl Iterator<Item = (usize, usize)> {
        let order = self.order;
        (self.first..self.first + self.batch.atoms).map(move |place| (place, order[place] as usize))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_atom_is_in_one_batch_of_its_element() {
        let elements: Vec<usize> = (0..50).map(|k| [2, 0, 2, 2, 0][k % 5]).collect();
        for tape_bytes in [1, TAPE_BYTES / 4, TAPE_BYTES * 2] {
            let mut batches = Batches::default();
            batches.update(&elements, tape_bytes);
            let mut seen = batches.order.clone();
            seen.sort_unstable();
            assert!(seen.iter().copied().eq(0..50));
            let mut end = 0;
            for (places, element) in &batches.batches {
                assert_eq!(places.start, end);
                assert!(places.len() * tape_bytes <= TAPE_BYTES.max(tape_bytes) && places.len() <= MOST);
                assert!(
                    batches.order[places.clone()].iter().all(|atom| elements[*atom as usize] == *element)
                );
                end = places.end;
            }
            assert_eq!(end, 50);
        }
    }
}
