//! Groups atoms that are evaluated together.

use std::ops::Range;

use super::instructions::Instructions;
use super::tape::AtomBatch;

/// Maximum number of atoms in a batch.
const MAX_BATCH_ATOMS: usize = 16;

/// Memory for the tape of a batch and that of one cotangent, bytes: about the L2 cache.
const TAPE_BYTES: usize = 1 << 20;

/// Approximate number of atoms that a thread processes at once: enough to read the projection rarely, few
/// enough for their tapes to stay in the L3 cache.
const CHUNK_ATOMS: usize = 64;

/// Minimum number of chunks, so that two threads share even a small structure.
const MIN_CHUNKS: usize = 2;

/// Consecutive batches that one thread evaluates.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Chunk {
    /// Index of the chunk.
    pub number: usize,
    pub batches: Range<usize>,
    pub places: Range<usize>,
}

/// The evaluation order of a structure's atoms: grouped by element, divided into batches, and these into
/// chunks. It depends on the elements only. The *place* of an atom is its index in this order.
#[derive(Clone, Debug, Default)]
pub(super) struct Batches {
    /// The atom at each place.
    pub order: Vec<u32>,
    /// The place of each atom.
    pub places: Vec<u32>,
    /// The places of each batch, and the element of its atoms.
    pub batches: Vec<(Range<usize>, usize)>,
    pub chunks: Vec<Chunk>,
}

impl Batches {
    /// Orders atoms of these elements, each of which needs `tape_bytes` of tape.
    pub fn update(&mut self, elements: &[usize], tape_bytes: usize) {
        let size = (TAPE_BYTES / tape_bytes.max(1)).clamp(1, MAX_BATCH_ATOMS);
        self.order.clear();
        self.order.extend(0..elements.len() as u32);
        self.order.sort_unstable_by_key(|atom| (elements[*atom as usize], *atom));
        self.places.resize(elements.len(), 0);
        for (place, atom) in self.order.iter().enumerate() {
            self.places[*atom as usize] = place as u32;
        }
        self.batches.clear();
        let mut start = 0;
        for atoms in self.order.chunk_by(|a, b| elements[*a as usize] == elements[*b as usize]) {
            for batch in atoms.chunks(size) {
                self.batches.push((start..start + batch.len(), elements[batch[0] as usize]));
                start += batch.len();
            }
        }
        self.divide();
    }

    fn divide(&mut self) {
        self.chunks.clear();
        let n = self.order.len();
        let chunks = n.div_ceil(CHUNK_ATOMS).max(MIN_CHUNKS);
        let (mut first, mut start) = (0, 0);
        for (k, (places, _)) in self.batches.iter().enumerate() {
            if places.end * chunks >= n * (self.chunks.len() + 1) {
                let (batches, places) = (first..k + 1, start..places.end);
                (first, start) = (k + 1, places.end);
                self.chunks.push(Chunk { number: self.chunks.len(), batches, places });
            }
        }
    }

    #[inline(always)]
    pub fn placed(&self, batch: usize, instructions: Instructions) -> Placed {
        let (places, element) = &self.batches[batch];
        let batch = AtomBatch { element: *element, atoms: places.len(), instructions };
        Placed { batch, first: places.start }
    }
}

/// A batch with its places.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed {
    pub batch: AtomBatch,
    /// Its first place.
    pub first: usize,
}

impl Placed {
    #[inline(always)]
    pub fn places(&self) -> Range<usize> {
        self.first..self.first + self.batch.atoms
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
                assert!(
                    places.len() * tape_bytes <= TAPE_BYTES.max(tape_bytes)
                        && places.len() <= MAX_BATCH_ATOMS
                );
                assert!(
                    batches.order[places.clone()].iter().all(|atom| elements[*atom as usize] == *element)
                );
                end = places.end;
            }
            assert_eq!(end, 50);
            assert!((0..50).all(|atom| batches.order[batches.places[atom] as usize] as usize == atom));
            let (mut batch, mut place) = (0, 0);
            for (number, chunk) in batches.chunks.iter().enumerate() {
                assert_eq!((chunk.number, chunk.batches.start, chunk.places.start), (number, batch, place));
                assert_eq!(batches.batches[chunk.batches.end - 1].0.end, chunk.places.end);
                (batch, place) = (chunk.batches.end, chunk.places.end);
            }
            assert_eq!((batch, place), (batches.batches.len(), 50));
        }
    }
}
