//! A bounded sample of groups of items.

use crate::random::mixed;

/// Keeps all items of a group or none: all groups up to the capacity, then each with probability ½, ¼ and so on. Which groups are
/// kept depends only on their numbers and on how many items came.
#[derive(Clone, Debug)]
pub struct GroupSample<T> {
    kept: Vec<(u32, T)>,
    room: usize,
    /// A group is kept if its level is at least this.
    least: u32,
    seen: u64,
}

impl<T> GroupSample<T> {
    /// A sample of at most `room` items (at least one).
    pub fn new(room: usize) -> Self {
        Self { kept: Vec::new(), room: room.max(1), least: 0, seen: 0 }
    }

    /// Offers the next item of a group.
    pub fn add(&mut self, group: u64, item: T) {
        let level = mixed(group).trailing_zeros();
        self.seen += 1;
        if level < self.least {
            return;
        }
        self.kept.push((level, item));
        while self.kept.len() > self.room && self.least <= u64::BITS {
            self.thin(self.least + 1);
        }
    }

    /// Keeps of both samples the groups that each of them keeps by itself, so that ratios of their items stay right. Call it after each
    /// item of either.
    pub fn thin_together<U>(&mut self, other: &mut GroupSample<U>) {
        let least = self.least.max(other.least);
        self.thin(least);
        other.thin(least);
    }

    fn thin(&mut self, least: u32) {
        if least > self.least {
            self.least = least;
            self.kept.retain(|(level, _)| *level >= least);
        }
    }

    /// The items of the kept groups, in order.
    pub fn items(&self) -> impl ExactSizeIterator<Item = &T> {
        self.kept.iter().map(|(_, item)| item)
    }

    /// Number of items offered.
    pub fn total(&self) -> u64 {
        self.seen
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn groups_are_kept_whole_or_not_at_all() {
        let mut few = GroupSample::new(100);
        (0..100).for_each(|k| few.add(k % 7, k));
        assert!(few.items().copied().eq(0..100));
        let mut many = GroupSample::new(3000);
        // 2000 groups of 4 to 6 items, which do not come together.
        let items: Vec<(u64, u64)> = (0..6).flat_map(|k| (0..2000).map(move |group| (group, k))).collect();
        let items = items.into_iter().filter(|(group, k)| *k < 4 + group % 3);
        items.for_each(|(group, k)| many.add(group, (group, k)));
        assert!(many.total() == 9999 && (700..=3000).contains(&many.items().len()));
        let mut counts: BTreeMap<u64, u64> = BTreeMap::new();
        many.items().for_each(|(group, _)| *counts.entry(*group).or_default() += 1);
        assert!(counts.iter().all(|(group, number)| *number == 4 + group % 3));
        // A sample without preference has numbers with the mean 1000 ± 5 · 577 / √n.
        let mean = counts.keys().sum::<u64>() as f64 / counts.len() as f64;
        assert!((mean - 1000.0).abs() < 5.0 * 577.0 / (counts.len() as f64).sqrt(), "{mean}");
    }

    /// Of two samples of the same groups, one with many items of each, the other with few.
    #[test]
    fn samples_that_are_thinned_together_keep_the_same_groups() {
        let (mut many, mut few) = (GroupSample::new(800), GroupSample::new(800));
        for group in 0..1000_u64 {
            for item in 0..4 {
                many.add(group, (group, item));
                many.thin_together(&mut few);
            }
            few.add(group, group);
            few.thin_together(&mut many);
        }
        assert_eq!((many.total(), few.total()), (4000, 1000));
        assert!(many.items().len() <= 800 && many.items().len() > 200);
        let groups = many.items().filter(|(_, item)| *item == 0).map(|(group, _)| group);
        assert!(groups.eq(few.items()), "four items for each of the other sample");
    }

    #[test]
    fn a_group_larger_than_the_room_ends() {
        let mut sample = GroupSample::new(2);
        (0..10).for_each(|k| sample.add(1, k));
        assert!(sample.items().len() <= 2 && sample.total() == 10);
    }
}
