//! Raises the threshold of the collection rule while the label queue is long.

/// Above this multiple of the limit, the threshold is no longer raised, and walkers wait.
const MAX_FACTOR: u64 = 2;

/// The threshold while structures wait for labels: as configured up to `limit` unfinished jobs, above it multiplied by
///
/// ```text
/// 1 + ((unfinished - limit) / limit)²,     2 at most, at twice the limit
/// ```
///
/// so that it is continuous at the limit, and the structures with the highest grades are collected first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backlog {
    limit: u64,
}

impl Backlog {
    /// Raises the threshold above `limit` unfinished jobs; a limit of 0 counts as 1.
    pub fn new(limit: u64) -> Self {
        Self { limit: limit.max(1) }
    }

    /// Number of unfinished jobs above which walkers wait, which bounds the length of the queue.
    pub fn max_unfinished_jobs(self) -> u64 {
        self.limit.saturating_mul(MAX_FACTOR)
    }

    /// Factor on the threshold for this number of unfinished jobs.
    pub fn factor(self, unfinished: u64) -> f64 {
        let above = unfinished.min(self.max_unfinished_jobs()).saturating_sub(self.limit);
        1.0 + (above as f64 / self.limit as f64).powi(2)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_threshold_rises_from_the_limit_to_twice_the_limit() {
        let factors = [0, 100, 110, 150, 200, 5000].map(|unfinished| Backlog::new(100).factor(unfinished));
        assert_eq!(factors, [1.0, 1.0, 1.01, 1.25, 2.0, 2.0]);
        assert_eq!(Backlog::new(0), Backlog::new(1));
    }

    proptest! {
        #[test]
        fn the_threshold_is_monotonic(limit in any::<u64>(), a in any::<u64>(), b in any::<u64>()) {
            let (backlog, (less, more)) = (Backlog::new(limit), (a.min(b), a.max(b)));
            let (low, high) = (backlog.factor(less), backlog.factor(more));
            prop_assert!((1.0..=2.0).contains(&low) && low <= high && high <= 2.0);
            prop_assert!(less > limit.max(1) || low == 1.0);
        }
    }
}
