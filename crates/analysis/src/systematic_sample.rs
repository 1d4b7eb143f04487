//! A bounded sample of a stream of unknown length.

use crate::random::mixed;

/// Keeps items of a stream with equal probability: all of them up to the capacity, then a half, a quarter, and
/// so on. The choice depends only on the index in the stream, so parallel streams keep the same indices.
#[derive(Clone, Debug)]
pub struct SystematicSample<T> {
    kept: Vec<T>,
    /// The level of the index of each, at most 64.
    levels: Vec<u8>,
    room: usize,
    /// An item is kept if the level of its index is at least this.
    least: u8,
    seen: u64,
}

impl<T> SystematicSample<T> {
    /// A sample of at most `room` items (at least one).
    pub fn new(room: usize) -> Self {
        Self { kept: Vec::new(), levels: Vec::new(), room: room.max(1), least: 0, seen: 0 }
    }

    /// Offers the next item.
    pub fn add(&mut self, item: T) {
        self.add_with(|| item);
    }

    /// Offers the next item, which is made only if it is kept.
    pub fn add_with(&mut self, item: impl FnOnce() -> T) {
        let level = mixed(self.seen).trailing_zeros() as u8;
        self.seen += 1;
        while level >= self.least {
            if self.kept.len() < self.room {
                self.kept.push(item());
                return self.levels.push(level);
            }
            self.halve();
        }
    }

    /// Drops the items of the least level.
    fn halve(&mut self) {
        self.least += 1;
        let mut stays = self.levels.iter().map(|level| *level >= self.least);
        self.kept.retain(|_| stays.next() == Some(true));
        self.levels.retain(|level| *level >= self.least);
    }

    /// The sampled items, in order.
    pub fn items(&self) -> impl ExactSizeIterator<Item = &T> {
        self.kept.iter()
    }

    /// Number of items offered.
    pub fn total(&self) -> u64 {
        self.seen
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_are_kept_by_the_level_of_their_index() {
        for room in [1, 7, 4096] {
            let mut thinned = SystematicSample::new(room);
            (0..100_000_u64).for_each(|k| thinned.add(k));
            let from = |least: u8| (0..100_000).filter(move |k| mixed(*k).trailing_zeros() as u8 >= least);
            assert!(thinned.items().copied().eq(from(thinned.least)));
            assert!(from(thinned.least - 1).count() > room, "no more are dropped than must be");
        }
    }

    #[test]
    fn a_short_stream_is_kept_whole() {
        let mut thinned = SystematicSample::new(100);
        (0..100).for_each(|k| thinned.add(k));
        assert!(thinned.items().copied().eq(0..100) && thinned.total() == 100);
    }

    #[test]
    fn a_long_one_is_kept_evenly() {
        let mut thinned = SystematicSample::new(4096);
        (0..1_000_000).for_each(|k| thinned.add(k));
        let kept: Vec<i64> = thinned.items().copied().collect();
        // Between an eighth of the capacity and all of it: each halving keeps about half.
        assert!((1024..=4096).contains(&kept.len()) && thinned.total() == 1_000_000);
        // The mean of n uniform draws from 0..N is within five standard deviations, N / √(12 n).
        let n = kept.len() as f64;
        let mean = kept.iter().sum::<i64>() as f64 / n;
        assert!((mean - 5e5).abs() < 5.0 * 1e6 / (12.0 * n).sqrt(), "{mean}");
        assert!(kept.is_sorted());
    }

    #[test]
    fn no_room_is_room_for_one() {
        let mut thinned = SystematicSample::new(0);
        (0..1000).for_each(|k| thinned.add(k));
        assert!(thinned.items().len() <= 1 && thinned.total() == 1000);
    }
}
