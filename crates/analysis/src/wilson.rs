//! Confidence interval of a proportion.

/// 97.5 % quantile of the normal distribution.
const NORMAL_97_5: f64 = 1.959_963_984_540_054;

/// Wilson's 95 % confidence interval of a probability after `successes` in `all` trials. It stays within 0 and
/// 1 and is informative after a single trial. `None` without trials.
pub fn wilson_interval(successes: u64, all: u64) -> Option<(f64, f64)> {
    if all == 0 {
        return None;
    }
    let (n, share) = (all as f64, successes as f64 / all as f64);
    let z2 = NORMAL_97_5 * NORMAL_97_5;
    let centre = (share + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = NORMAL_97_5 / (1.0 + z2 / n) * (share * (1.0 - share) / n + z2 / (4.0 * n * n)).sqrt();
    Some(((centre - half).max(0.0), (centre + half).min(1.0)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_paper_has_labelled_so_many() {
        // The roots of (p − 187/225)² = z² p (1 − p) / 225.
        let (low, high) = wilson_interval(187, 225).unwrap();
        assert!((low - 0.776_694).abs() < 1e-6 && (high - 0.874_411).abs() < 1e-6, "{low} {high}");
        // A single failure: at most z²/(1 + z²) = 0.793.
        let (low, high) = wilson_interval(0, 1).unwrap();
        assert!(low == 0.0 && (high - 0.793_45).abs() < 1e-4, "{high}");
        assert_eq!(wilson_interval(0, 0), None);
    }

    proptest! {
        /// The ends of Wilson's interval are where a normal test rejects the observed proportion.
        #[test]
        fn its_ends_are_refused_just_so((successes, all) in (1_u64..500).prop_flat_map(|n| (0..=n, Just(n)))) {
            let (low, high) = wilson_interval(successes, all).unwrap();
            let share = successes as f64 / all as f64;
            prop_assert!(low <= share + 1e-12 && share <= high + 1e-12);
            for end in [low, high].into_iter().filter(|end| (1e-9..1.0 - 1e-9).contains(end)) {
                let away = (share - end).abs() / (end * (1.0 - end) / all as f64).sqrt();
                prop_assert!((away - NORMAL_97_5).abs() < 1e-6, "{}", away);
            }
        }
    }
}
