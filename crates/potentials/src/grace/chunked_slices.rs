//! Slices with elements per place that threads can split by chunks of atoms.

use std::ops::Range;

use super::batches::Chunk;

/// Data that can be split at a chunk boundary.
pub(super) trait SplitByChunk: Sized + Send {
    /// The part before a chunk, and the rest.
    fn split(self, chunk: &Chunk) -> (Self, Self);
}

/// How many elements a place has.
#[derive(Clone, Copy, Debug)]
pub(super) enum PlaceLayout<'a> {
    /// The same number for each place.
    Even(usize),
    /// The elements of a place start at its offset times a factor.
    Ragged(&'a [usize], usize),
}

impl PlaceLayout<'_> {
    #[inline(always)]
    fn begin(&self, place: usize) -> usize {
        match self {
            Self::Even(n) => place * n,
            Self::Ragged(offsets, n) => offsets[place] * n,
        }
    }
}

/// A mutable slice over some places.
#[derive(Debug)]
pub(super) struct ChunkedSlice<'a, T> {
    layout: PlaceLayout<'a>,
    /// Index of its first element in the whole array.
    begin: usize,
    numbers: &'a mut [T],
}

impl<'a, T> ChunkedSlice<'a, T> {
    /// From an array that starts with the elements of the place `first`.
    #[inline(always)]
    pub fn new(layout: PlaceLayout<'a>, first: usize, numbers: &'a mut [T]) -> Self {
        Self { layout, begin: layout.begin(first), numbers }
    }

    /// A slice without elements.
    pub fn empty() -> Self {
        Self::new(PlaceLayout::Even(0), 0, &mut [])
    }

    /// The elements of these places.
    #[inline(always)]
    pub fn slice(&mut self, places: &Range<usize>) -> &mut [T] {
        &mut self.numbers
            [self.layout.begin(places.start) - self.begin..self.layout.begin(places.end) - self.begin]
    }
}

impl<T: Send> SplitByChunk for ChunkedSlice<'_, T> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let begin = self.layout.begin(chunk.places.start);
        let Self { layout, begin: start, numbers } = self;
        let (first, second) = numbers.split_at_mut(begin - start);
        (Self { layout, begin: start, numbers: first }, Self { layout, begin, numbers: second })
    }
}

/// A read-only slice over some places with a fixed number of elements each.
#[derive(Clone, Copy, Debug)]
pub(super) struct SharedSlice<'a, T> {
    of_one: usize,
    first: usize,
    numbers: &'a [T],
}

impl<'a, T> SharedSlice<'a, T> {
    /// From an array that starts with the elements of the place `first`.
    pub fn new(of_one: usize, first: usize, numbers: &'a [T]) -> Self {
        Self { of_one, first, numbers }
    }

    /// The elements of these places; empty if the slice is.
    #[inline(always)]
    pub fn slice(self, places: &Range<usize>) -> &'a [T] {
        let index = |place: usize| (place - self.first) * self.of_one;
        self.numbers.get(index(places.start)..index(places.end)).unwrap_or_default()
    }
}

/// One item per chunk.
#[derive(Debug)]
pub(super) struct PerChunk<'a, T> {
    first: usize,
    items: &'a mut [T],
}

impl<'a, T> PerChunk<'a, T> {
    /// The items of these chunks from the list for all chunks, which may be empty.
    pub fn within(chunks: &[Chunk], items: &'a mut [T]) -> Self {
        let first = chunks.first().map_or(0, |chunk| chunk.number);
        let end = (first + chunks.len()).min(items.len());
        Self { first, items: &mut items[first.min(end)..end] }
    }

    /// The item of the only remaining chunk.
    pub fn only(&mut self) -> Option<&mut T> {
        self.items.first_mut()
    }
}

impl<T: Send> SplitByChunk for PerChunk<'_, T> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let middle = (chunk.number - self.first).min(self.items.len());
        let (first, second) = self.items.split_at_mut(middle);
        (Self { first: self.first, items: first }, Self { first: chunk.number, items: second })
    }
}

impl<A: SplitByChunk> SplitByChunk for Option<A> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        self.map(|part| part.split(chunk)).unzip()
    }
}

impl<A: SplitByChunk, B: SplitByChunk> SplitByChunk for (A, B) {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let (a, b) = (self.0.split(chunk), self.1.split(chunk));
        ((a.0, b.0), (a.1, b.1))
    }
}

impl<A: SplitByChunk> SplitByChunk for [A; 2] {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let [a, b] = self.map(|part| part.split(chunk));
        ([a.0, b.0], [a.1, b.1])
    }
}
