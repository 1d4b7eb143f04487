//! Age of the walker's mixture at the time of the decision.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Key under which the histogram of mixture ages ([`Staleness`], JSON) is committed.
pub const STALENESS: &str = "staleness";

/// Ages up to this value are counted exactly; larger ones are binned by their leading binary digits. The histogram
/// stays small, and the error is at most 1/30.
const EXACT: u64 = 1 << 6;

/// Histogram of ages in versions: the selector's mixture version at the decision minus that of the walker.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Staleness {
    /// Number of decisions by age.
    counts: BTreeMap<u64, u64>,
    largest: u64,
}

impl Staleness {
    /// Adds a decision.
    pub fn add(&mut self, versions: u64) {
        let digits = (versions / EXACT).checked_ilog2().map_or(0, |digits| digits + 1);
        *self.counts.entry(versions >> digits << digits).or_default() += 1;
        self.largest = self.largest.max(versions);
    }

    /// Number of decisions.
    pub fn decisions(&self) -> u64 {
        self.counts.values().sum()
    }

    /// Fraction of decisions for which the walker had the newest mixture; NaN without any.
    pub fn share_of_newest(&self) -> f64 {
        self.counts.get(&0).copied().unwrap_or(0) as f64 / self.decisions() as f64
    }

    /// The smallest age that is at least as large as this fraction of all ages; 0 without any.
    pub fn quantile(&self, share: f64) -> u64 {
        let rank = share * self.decisions() as f64;
        let mut below = 0;
        let reaches = |(_, count): &(&u64, &u64)| {
            below += **count;
            below as f64 >= rank
        };
        self.counts.iter().find(reaches).map_or(0, |(age, _)| *age)
    }

    /// The largest age, exact.
    pub fn largest(&self) -> u64 {
        self.largest
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn from_ages(ages: &[u64]) -> Staleness {
        let mut staleness = Staleness::default();
        ages.iter().for_each(|age| staleness.add(*age));
        staleness
    }

    #[test]
    fn small_ages_are_exact() {
        let ages: Vec<u64> = (0..100).map(|k| if k < 60 { 0 } else { k - 59 }).collect();
        let staleness = from_ages(&ages);
        assert_eq!((staleness.decisions(), staleness.share_of_newest()), (100, 0.6));
        let quantiles = [0.5, 0.6, 0.61, 0.9, 1.0].map(|share| staleness.quantile(share));
        assert_eq!((quantiles, staleness.largest()), ([0, 0, 1, 30, 40], 40));
        let none = Staleness::default();
        assert!(none.share_of_newest().is_nan() && none.quantile(0.9) == 0);
    }

    proptest! {
        #[test]
        fn quantiles_are_accurate_to_a_thirtieth(
            mut ages in prop::collection::vec(prop_oneof![0..200_u64, any::<u64>()], 1..200), share in 0.0..=1.0_f64,
        ) {
            let staleness = from_ages(&ages);
            ages.sort_unstable();
            let rank = ((share * ages.len() as f64).ceil() as usize).max(1);
            let (exact, found) = (ages[rank - 1], staleness.quantile(share));
            prop_assert!(found <= exact && exact - found <= exact / 32, "{found} for {exact}");
            prop_assert_eq!(staleness.largest(), ages[ages.len() - 1]);
            prop_assert!(staleness.counts.len() <= 64 + 32 * 58);
            let text = serde_json::to_string(&staleness).unwrap();
            prop_assert_eq!(serde_json::from_str::<Staleness>(&text).unwrap(), staleness);
        }
    }
}
