//! The learning rate.

/// A learning rate that falls by half a cosine from the first update to the last (Loshchilov & Hutter, ICLR 2017, without
/// restarts).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CosineDecay {
    /// At the first update.
    pub first: f64,
    /// At the last update.
    pub last: f64,
}

impl CosineDecay {
    /// The rate of update number `update` (from 0) of `updates`. A single update has the first rate.
    pub fn rate(&self, update: u64, updates: u64) -> f64 {
        let share = update as f64 / updates.saturating_sub(1).max(1) as f64;
        self.last + 0.5 * (self.first - self.last) * (1.0 + (std::f64::consts::PI * share).cos())
    }
}

/// Share of the learning rate at update number `update` (from 0) of a warm-up of `updates`, after which it is 1.
pub fn warm_up_share(update: u64, updates: u64) -> f64 {
    if update < updates { (update + 1) as f64 / updates as f64 } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warm_up_rises_to_1() {
        let shares = [0, 1, 3, 4, 1000].map(|update| warm_up_share(update, 4));
        assert_eq!(shares, [0.25, 0.5, 1.0, 1.0, 1.0]);
        assert_eq!(warm_up_share(0, 0), 1.0);
    }

    #[test]
    fn the_rate_falls_by_half_a_cosine() {
        let decay = CosineDecay { first: 0.01, last: 0.002 };
        for (update, expected) in
            [(0, 0.01), (100, 0.006), (200, 0.002), (50, 0.006 + 0.004 * 0.5_f64.sqrt())]
        {
            assert!((decay.rate(update, 201) - expected).abs() < 1e-15, "{update}");
        }
        for updates in [0, 1] {
            assert_eq!(decay.rate(0, updates), 0.01);
        }
    }
}
