//! The random numbers of the build: a function of what they are for, without global state.

/// SplitMix64 (Steele, Lea & Flood, OOPSLA 2014), whose n-th number is a function of its key and n.
#[derive(Debug, Clone)]
pub(super) struct Random {
    state: u64,
}

impl Random {
    /// The sequence that belongs to these words, such as random seed, shard, element and K.
    pub fn new(words: &[u64]) -> Self {
        let state = words.iter().fold(0, |state, &word| mix(state ^ mix(word.wrapping_add(GOLDEN))));
        Self { state }
    }

    /// A number in [0, 1), 53 bits.
    pub fn uniform(&mut self) -> f64 {
        self.state = self.state.wrapping_add(GOLDEN);
        (mix(self.state) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// An index drawn with probability proportional to its share, given as the cumulative sums of all shares. `None`
    /// if their total is not positive.
    pub fn index(&mut self, cumulative: &[f64]) -> Option<usize> {
        let total = cumulative.last().copied().filter(|total| *total > 0.0)?;
        let drawn = self.uniform() * total;
        // Rounding may give `drawn` = total; the last share above zero then is the drawn one.
        let index = cumulative.partition_point(|sum| *sum <= drawn);
        Some(index.min(cumulative.partition_point(|sum| *sum < total)))
    }
}

/// A number that looks random, as a function of these words.
pub(crate) fn random_key(words: &[u64]) -> u64 {
    mix(Random::new(words).state)
}

/// The numbers 0 to `count` − 1 in random order (Fisher–Yates), as a function of random seed and shard.
pub fn shuffled(seed: u64, shard: u64, count: usize) -> Vec<usize> {
    let mut random = Random::new(&[seed, shard, SHUFFLE]);
    let mut order: Vec<usize> = (0..count).collect();
    for last in (1..count).rev() {
        order.swap(last, (random.uniform() * (last + 1) as f64) as usize);
    }
    order
}

/// Stands for the order of the structures among the words that choose random numbers.
const SHUFFLE: u64 = u64::MAX;

/// 2⁶⁴ divided by the golden ratio.
const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_of_the_published_generator() {
        let mut random = Random { state: 1234567 };
        let expected = [6457827717110365317_u64, 3203168211198807973, 9817491932198370423];
        for number in expected {
            assert_eq!(random.uniform(), (number >> 11) as f64 / (1_u64 << 53) as f64);
        }
    }

    #[test]
    fn each_use_has_its_own_numbers() {
        let mut first: Vec<f64> = Vec::new();
        for words in [&[1, 2][..], &[2, 1], &[1, 2, 0], &[0, 1, 2], &[1]] {
            first.push(Random::new(words).uniform());
        }
        first.sort_by(f64::total_cmp);
        assert!(first.windows(2).all(|pair| pair[0] != pair[1]));
    }

    #[test]
    fn orders_are_permutations_of_their_own() {
        let orders = [shuffled(1, 0, 100), shuffled(1, 1, 100), shuffled(2, 0, 100)];
        for order in &orders {
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..100));
            assert!(order.iter().enumerate().filter(|(place, item)| place == *item).count() < 10);
        }
        assert!(orders[0] != orders[1] && orders[0] != orders[2]);
        assert_eq!((shuffled(1, 0, 100), shuffled(1, 0, 0)), (orders[0].clone(), vec![]));
        // Each of the six orders of three items, within five standard deviations of a binomial distribution with p = 1/6.
        let draws = 6000;
        let first = (0..draws).filter(|&shard| shuffled(9, shard, 3) == [2, 0, 1]).count();
        assert!((first as f64 - 1000.0).abs() < 5.0 * (draws as f64 * 5.0 / 36.0).sqrt(), "{first}");
    }

    #[test]
    fn indices_follow_their_shares() {
        let mut random = Random::new(&[7]);
        let mut drawn = [0.0; 4];
        let draws = 40_000;
        for _ in 0..draws {
            drawn[random.index(&[0.0, 1.0, 1.0, 4.0]).unwrap()] += 1.0;
        }
        assert_eq!((drawn[0], drawn[2]), (0.0, 0.0));
        // Five standard deviations of a binomial distribution with p = 1/4.
        assert!((drawn[1] / draws as f64 - 0.25).abs() < 5.0 * (0.1875 / draws as f64).sqrt());
        assert_eq!(random.index(&[0.0, 0.0]), None);
        assert_eq!(random.index(&[]), None);
    }
}
