//! Random numbers as a function of what they are for.

/// The number SplitMix64 (Steele, Lea & Flood, OOPSLA 2014) has at this place of its sequence from 0.
pub fn mixed(place: u64) -> u64 {
    let mut x = place.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// The numbers of one draw, which a random seed and the number of the draw choose.
#[derive(Clone, Copy, Debug)]
pub struct Draw(u64);

impl Draw {
    pub fn new(seed: u64, draw: u32) -> Self {
        Self(mixed(mixed(seed) ^ u64::from(draw)))
    }

    /// Number `index` of the draw, uniform below `bound` (up to 2⁻⁶⁴ `bound`), which must be positive.
    pub fn below(self, index: usize, bound: usize) -> usize {
        let bits = mixed(self.0 ^ mixed(index as u64));
        ((u128::from(bits) * bound as u128) >> 64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sequence_is_the_published_one() {
        // SplitMix64 from 0: https://prng.di.unimi.it/splitmix64.c
        assert_eq!([0, 1].map(mixed), [0xe220_a839_7b1d_cdaf, 0x6e78_9e6a_a1b9_65f4]);
    }

    #[test]
    fn numbers_are_uniform() {
        // Within five standard deviations of a binomial distribution with p = 1/7, for each number and each use of it.
        let expected = 70_000.0 / 7.0;
        for by_draw in [false, true] {
            let mut counts = [0.0; 7];
            for k in 0..70_000 {
                let (draw, index) = if by_draw { (k, 3) } else { (3, k) };
                counts[Draw::new(5, draw as u32).below(index, 7)] += 1.0;
            }
            let spread = 5.0 * f64::sqrt(expected * 6.0 / 7.0);
            assert!(counts.iter().all(|count: &f64| (count - expected).abs() < spread), "{counts:?}");
        }
    }
}
