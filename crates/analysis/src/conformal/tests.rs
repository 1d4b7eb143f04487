//! The bounds against worked examples, their properties, and their coverage on synthetic campaigns with known truth.

use proptest::prelude::*;

use super::*;
use crate::Bins;
use crate::random::mixed;

const NINETY: ConformalSettings =
    ConformalSettings { level: 0.9, least: 20, window: 100, step: 0.03, counted: 200 };

/// A window without correction that needs one structure.
fn window_of(level: f64, structures: &[Vec<f64>]) -> ConformalWindow {
    let settings = ConformalSettings { level, least: 1, window: 1000, step: 0.0, counted: 200 };
    let mut window = ConformalWindow::new(settings);
    structures.iter().for_each(|errors| window.learn(errors));
    window
}

#[test]
fn structures_have_weight_one() {
    // Cumulative weights of 1, 2, 3, 5 and 7: 1/3, 5/3, 2, 5/2, 3. The bound is where they reach q (3 + 1).
    let structures = [vec![2.0, 1.0, 3.0], vec![2.0], vec![7.0, 5.0]];
    for (level, expected) in [
        (0.3, Some(2.0)),
        (0.5, Some(3.0)),
        (0.6, Some(5.0)),
        (0.74, Some(7.0)),
        (0.75, Some(7.0)),
        (0.76, None),
    ] {
        assert_eq!(window_of(level, &structures).bound(), expected, "{level}");
    }
    let mean = window_of(0.5, &structures).mean().unwrap();
    assert!((mean - (2.0 + 2.0 + 6.0) / 3.0).abs() < 1e-12);
}

#[test]
fn a_level_needs_that_many_structures() {
    for (level, expected) in [(0.5, 1), (0.8, 4), (0.9, 9), (0.95, 19), (0.99, 99)] {
        assert_eq!(ConformalSettings { level, least: 1, ..NINETY }.least(), expected);
        let structures: Vec<_> = (0..expected).map(|k| vec![k as f64]).collect();
        assert_eq!(window_of(level, &structures).bound(), Some(expected as f64 - 1.0), "{level}");
        assert_eq!(window_of(level, &structures[1..]).bound(), None);
    }
    assert_eq!(NINETY.least(), 20);
}

#[test]
fn the_newest_structures_count() {
    let mut window = ConformalWindow::new(ConformalSettings { step: 0.0, ..NINETY });
    (0..250).for_each(|k| window.learn(&[f64::from(k), f64::from(k)]));
    // 150 … 249: the 0.9 · 101 = 90.9th.
    assert_eq!((window.structures(), window.bound()), (100, Some(240.0)));
    // Errors that only rise are never below the bound.
    assert_eq!(window.coverage(), Some((0.0, 200)));
    window.learn(&[]);
    assert_eq!(window.structures(), 100);
}

#[test]
fn a_group_has_its_own_bound_where_it_has_enough_structures() {
    let mut map = ConformalMap::new(Bins::for_grades(), NINETY);
    let atom = |grade, error, group| GradedError { grade, error, group };
    for k in 0..30 {
        let rare = (k % 3 == 0).then(|| atom(0.7, 9.0, "Cu"));
        let atoms = [atom(0.7, 1.0, "Al"), atom(1.2, f64::NAN, "Al"), atom(f64::NAN, 1.0, "Al")];
        assert_eq!(map.bound(0.7, Some(&"Al")).is_some(), k >= 20, "{k}");
        map.learn(&atoms.into_iter().chain(rare).collect::<Vec<_>>());
    }
    assert_eq!((map.bound(0.7, Some(&"Al")), map.structures()), (Some(1.0), 30));
    // 30 copper atoms would be enough; 10 structures are not.
    assert_eq!((map.bound(0.7, Some(&"Cu")), map.bound(0.7, None)), (map.bound(0.7, None), Some(9.0)));
    assert_eq!((map.bound(1.2, None), map.bound(f64::NAN, None), map.expected(1.2)), (None, None, None));
    assert_eq!(map.coverage(), Some(RollingCoverage { share: 1.0, structures: 10 }));
}

/// Numbers of a synthetic campaign, a function of its seed and how many were drawn.
struct Numbers(u64, u64);

impl Numbers {
    fn uniform(&mut self) -> f64 {
        self.1 += 1;
        ((mixed(mixed(self.0) ^ self.1) >> 11) as f64 + 0.5) / 2_f64.powi(53)
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// A campaign of 250 labels. The errors of a structure's atoms share a factor, and so do their grades. If collection adapts,
/// grades rise by a factor 2.5 over the campaign, and the errors of one grade fall by a factor 4 or rise by it, in turn.
fn campaign(seed: u64, adapts: bool, settings: ConformalSettings) -> ConformalMap<u8> {
    let (mut numbers, mut map) = (Numbers(seed, 0), ConformalMap::new(Bins::for_grades(), settings));
    let slope = if seed.is_multiple_of(2) { -4_f64.ln() } else { 4_f64.ln() };
    for label in 0..250 {
        let time = if adapts { f64::from(label) / 250.0 - 0.5 } else { 0.0 };
        let (of_grades, of_errors) = (0.3 * numbers.normal(), 0.5 * numbers.normal());
        let atoms = 4 + (9.0 * numbers.uniform()) as usize;
        let atom = |numbers: &mut Numbers| {
            let grade = (0.2 + 0.9 * time + of_grades + 0.5 * numbers.normal()).exp();
            let error = (0.1 + 0.2 * grade) * (slope * time + of_errors + 0.5 * numbers.normal()).exp();
            GradedError { grade, error, group: 0 }
        };
        map.learn(&(0..atoms).map(|_| atom(&mut numbers)).collect::<Vec<_>>());
    }
    map
}

/// Mean coverage over synthetic campaigns, and the smallest and largest of a bin.
fn coverage(campaigns: u64, adapts: bool, settings: ConformalSettings) -> (f64, [f64; 2]) {
    let (mut sum, mut of_bins) = (0.0, vec![(0.0, 0.0); Bins::for_grades().count()]);
    for seed in 0..campaigns {
        let map = campaign(seed, adapts, settings);
        sum += map.coverage().unwrap().share;
        for (_, bin, window) in map.windows().filter(|(group, ..)| group.is_none()) {
            if let Some((share, counted)) = window.coverage() {
                of_bins[bin].0 += share * counted as f64;
                of_bins[bin].1 += counted as f64;
            }
        }
    }
    let shares =
        of_bins.iter().filter(|(_, counted)| *counted > 0.0).map(|(covered, counted)| covered / counted);
    let ends = shares.fold([1.0, 0.0], |[low, high]: [f64; 2], share| [low.min(share), high.max(share)]);
    (sum / campaigns as f64, ends)
}

#[test]
fn ninety_percent_of_errors_are_below_the_bound() {
    for adapts in [false, true] {
        let (share, [low, high]) = coverage(1000, adapts, NINETY);
        assert!((0.88..=0.92).contains(&share), "adapts: {adapts}, {share}");
        assert!(low > 0.86 && high < 0.94, "adapts: {adapts}, bins from {low} to {high}");
    }
}

/// What the window and the correction are for: without them, bounds hold too rarely or too often when collection adapts.
#[test]
fn without_correction_the_bound_lags_behind() {
    let settings = ConformalSettings { step: 0.0, window: 1000, ..NINETY };
    let shares = [0, 1].map(|odd| {
        let of = |k: u64| campaign(2 * k + odd, true, settings).coverage().unwrap().share;
        (0..20).map(of).sum::<f64>() / 20.0
    });
    assert!(shares[0] > 0.94 && shares[1] < 0.86, "{shares:?}");
}

/// Errors of structures.
fn some_structures() -> impl Strategy<Value = Vec<Vec<f64>>> {
    prop::collection::vec(prop::collection::vec(0.0..10.0, 1..6), 1..60)
}

proptest! {
    #[test]
    fn a_bound_rises_with_its_level(structures in some_structures(), levels in prop::array::uniform2(0.05..0.95)) {
        let [low, high] = if levels[0] <= levels[1] { levels } else { [levels[1], levels[0]] };
        let bounds = [low, high].map(|level| window_of(level, &structures).threshold().unwrap_or(f64::INFINITY));
        prop_assert!(bounds[0] <= bounds[1], "{bounds:?}");
    }

    #[test]
    fn the_order_within_a_window_is_free(structures in some_structures(), level in 0.05..0.95) {
        let backwards: Vec<_> = structures.iter().rev().cloned().collect();
        prop_assert_eq!(window_of(level, &structures).bound(), window_of(level, &backwards).bound());
    }

    #[test]
    fn atoms_of_a_structure_share_its_weight(structures in some_structures(), level in 0.05..0.95, copies in 2_usize..4) {
        let copied: Vec<_> = structures.iter().map(|errors| errors.repeat(copies)).collect();
        prop_assert_eq!(window_of(level, &structures).bound(), window_of(level, &copied).bound());
    }

    /// Whatever the errors are, bounds miss no more often than Gibbs & Candès' Proposition 4.1 says.
    #[test]
    fn the_correction_limits_misses(errors in prop::collection::vec(0.0_f64..10.0, 100..600), trend in -0.1_f64..0.1) {
        let mut window = ConformalWindow::new(NINETY);
        let (mut missed, mut compared) = (0.0, 0.0);
        for (number, error) in errors.iter().enumerate() {
            let error = error * (trend * number as f64).exp();
            if let Some(bound) = window.threshold() {
                missed += f64::from(error > bound);
                compared += 1.0;
            }
            window.learn(&[error]);
        }
        let target = 1.0 - NINETY.level;
        prop_assert!(missed <= target * compared + (target + NINETY.step) / NINETY.step + 1e-9, "{} of {}", missed, compared);
    }
}
