//! The bounds against worked examples, their properties, and their coverage on synthetic campaigns with known truth.

use proptest::prelude::*;

use super::*;
use crate::Bins;
use crate::random::mixed;

const NINETY: ConformalSettings =
    ConformalSettings { level: 0.9, least: 20, window: 50, step: 0.05, counted: 200 };

/// A window without correction that needs one structure.
fn window_of(level: f64, structures: &[Vec<f64>]) -> ConformalWindow {
    let settings = ConformalSettings { level, least: 1, window: 1000, step: 0.0, counted: 200 };
    let mut window = ConformalWindow::new(settings);
    (0..).zip(structures).for_each(|(number, errors)| window.learn(number, errors));
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
    (0..250_u32).for_each(|k| window.learn(k.into(), &[f64::from(k), f64::from(k)]));
    // 200 … 249: the 0.9 · 51 = 45.9th.
    assert_eq!((window.structures(), window.bound()), (50, Some(245.0)));
    // Errors that only rise are never below the bound.
    assert_eq!(window.coverage(), Some((0.0, 200)));
    window.learn(250, &[]);
    assert_eq!(window.structures(), 50);
}

#[test]
fn a_window_is_outdated_when_most_of_it_is_older_than_another_full_one() {
    let window = |numbers: std::ops::Range<u64>| {
        let mut window = ConformalWindow::new(NINETY);
        numbers.for_each(|number| window.learn(number, &[1.0]));
        window
    };
    let old = window(0..25);
    assert!(!old.is_outdated_by(&window(100..149)), "49 structures could still be as few as 20");
    assert!(old.is_outdated_by(&window(100..150)) && old.is_outdated_by(&window(13..63)));
    assert!(!old.is_outdated_by(&window(12..62)), "13 of 25 are not older");
    assert!(!window(0..80).is_outdated_by(&old), "it is newer");
    assert!(!window(0..0).is_outdated_by(&window(0..50)));
}

#[test]
fn a_group_has_its_own_bound_where_it_has_enough_structures() {
    let mut map = ConformalMap::new(Bins::for_grades(), NINETY);
    let atom = |grade, error, group| GradedError { grade, error, group };
    for k in 0..30_u64 {
        let rare = (k % 3 == 0).then(|| atom(0.7, 9.0, "Cu"));
        let atoms = [atom(0.7, 1.0, "Al"), atom(1.2, f64::NAN, "Al"), atom(f64::NAN, 1.0, "Al")];
        assert_eq!(map.bound(0.7, Some(&"Al")).is_some(), k >= 20, "{k}");
        map.learn(k, &atoms.into_iter().chain(rare).collect::<Vec<_>>());
    }
    assert_eq!((map.bound(0.7, Some(&"Al")), map.structures()), (Some(1.0), 30));
    // 30 copper atoms would be enough; 10 structures are not.
    assert_eq!((map.bound(0.7, Some(&"Cu")), map.bound(0.7, None)), (map.bound(0.7, None), Some(9.0)));
    assert_eq!((map.bound(1.2, None), map.bound(f64::NAN, None)), (None, None));
    assert!(map.window(1).is_some() && map.window(3).is_none());
    assert_eq!(map.coverage(), Some(RollingCoverage { share: 1.0, structures: 10, unbounded: 0.0 }));
}

#[test]
fn atoms_without_a_bound_are_counted() {
    let settings = ConformalSettings { counted: 4, ..NINETY };
    let mut map = ConformalMap::new(Bins::for_grades(), settings);
    let atoms = |grades: &[f64]| -> Vec<_> {
        grades.iter().map(|grade| GradedError { grade: *grade, error: 1.0, group: 0 }).collect()
    };
    (0..20).for_each(|number| map.learn(number, &atoms(&[0.1])));
    assert_eq!(map.coverage(), None, "no bound was there before any of them");
    let half = RollingCoverage { share: 1.0, structures: 2, unbounded: 0.25 };
    (20..22).for_each(|number| map.learn(number, &atoms(if number == 20 { &[0.1, 9.0] } else { &[0.1] })));
    assert_eq!(map.coverage(), Some(half));
    // A structure without any bound counts among them, but tests nothing. Two atoms of three, none of one, none of one.
    map.learn(22, &atoms(&[9.0]));
    assert_eq!(map.coverage(), Some(RollingCoverage { unbounded: 0.5, ..half }));
    (23..26).for_each(|number| map.learn(number, &atoms(&[0.1])));
    // The newest four with a bound: since the oldest of them, one of five has none.
    assert_eq!(map.coverage(), Some(RollingCoverage { structures: 4, unbounded: 0.2, ..half }));
    assert_eq!(map.outcomes(), [1.0; 5]);
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

/// How the collection of a synthetic campaign changes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Collection {
    /// Not at all.
    Same,
    /// Grades rise by a factor 2.5 over the campaign, and the errors at a grade fall by a factor 4.
    FallingErrors,
    /// The same, but errors rise by that factor.
    RisingErrors,
    /// What is collected depends on what was collected before ([`adaptive`]).
    Adaptive,
    /// The same, and what is labelled depends on the map.
    ByValue,
}

const LABELS: u64 = 250;

/// A campaign of 250 labels. The errors of a structure's atoms share a factor, and so do their grades.
fn campaign(seed: u64, collection: Collection, settings: ConformalSettings) -> ConformalMap<u8> {
    let slope = match collection {
        Collection::Adaptive | Collection::ByValue => return adaptive(seed, collection, settings),
        Collection::Same => 0.0,
        Collection::FallingErrors => -4_f64.ln(),
        Collection::RisingErrors => 4_f64.ln(),
    };
    let (mut numbers, mut map) = (Numbers(seed, 0), ConformalMap::new(Bins::for_grades(), settings));
    for label in 0..LABELS {
        let drifts = f64::from(u8::from(collection != Collection::Same));
        let time = drifts * (label as f64 / LABELS as f64 - 0.5);
        let center = 0.2 + 0.9 * time + 0.3 * numbers.normal();
        let factor = slope * time + 0.5 * numbers.normal();
        map.learn(label, &structure(&mut numbers, center, factor));
    }
    map
}

/// 4 to 12 atoms whose ln γ scatters about `center`, and whose errors rise with γ and have a factor e^`factor`.
fn structure(numbers: &mut Numbers, center: f64, factor: f64) -> Vec<GradedError<u8>> {
    let atoms = 4 + (9.0 * numbers.uniform()) as usize;
    let mut atom = || {
        let grade = (center + 0.5 * numbers.normal()).exp();
        let error = (0.1 + 0.2 * grade) * (factor + 0.5 * numbers.normal()).exp();
        GradedError { grade, error, group: 0 }
    };
    (0..atoms).map(|_| atom()).collect()
}

/// A region of configuration space.
struct Region {
    /// Mean of ln γ under the original mixture.
    center: f64,
    /// ln of the factor of its errors.
    factor: f64,
    /// Structures that were collected in it.
    collected: u32,
}

/// Ten walks that collect a structure only if the mixture, which learns from each one, does not cover its region yet: with n structures
/// from there, its largest grade falls by 1 + n/5. Otherwise the walk may move on to a region with larger grades and other errors.
/// By value, ten structures wait, and the one with the largest expected error by the map so far is labelled.
fn adaptive(seed: u64, collection: Collection, settings: ConformalSettings) -> ConformalMap<u8> {
    let (mut numbers, mut map) = (Numbers(seed, 0), ConformalMap::new(Bins::for_grades(), settings));
    let region =
        |numbers: &mut Numbers, center: f64| Region { center, factor: 0.4 * numbers.normal(), collected: 0 };
    let mut walks: Vec<_> = (0..10).map(|_| region(&mut numbers, -0.3)).collect();
    let waiting_most = if collection == Collection::ByValue { 10 } else { 1 };
    let mut waiting: Vec<Vec<GradedError<u8>>> = Vec::new();
    for step in 0.. {
        let walk = &mut walks[step % 10];
        let (center, factor) = (walk.center + 0.3 * numbers.normal(), walk.factor + 0.4 * numbers.normal());
        let found = structure(&mut numbers, center, factor);
        let largest = found.iter().map(|atom| atom.grade).fold(0.0, f64::max);
        if largest / (1.0 + 0.2 * f64::from(walk.collected)) > 1.0 {
            walk.collected += 1;
            waiting.push(found);
        } else if numbers.uniform() < 0.3 {
            *walk = region(&mut numbers, (walk.center + 0.15).min(1.2));
        }
        if waiting.len() == waiting_most {
            let value = |atoms: &Vec<GradedError<u8>>| {
                let expected = |atom: &GradedError<u8>| map.window(map.bins().index_of(atom.grade))?.mean();
                let known: Vec<_> = atoms.iter().filter_map(expected).collect();
                known.iter().sum::<f64>() / known.len().max(1) as f64
            };
            let best = (0..waiting_most).max_by(|a, b| value(&waiting[*a]).total_cmp(&value(&waiting[*b])));
            let labelled = waiting.swap_remove(best.unwrap());
            map.learn(map.structures(), &labelled);
        }
        if map.structures() == LABELS {
            return map;
        }
    }
    unreachable!("walks go on")
}

/// Of synthetic campaigns.
#[derive(Debug)]
struct MeanCoverage {
    /// Mean coverage.
    share: f64,
    /// Smallest and largest of a bin.
    bins: [f64; 2],
    /// Mean share of the atoms without a bound.
    unbounded: f64,
}

fn coverage(campaigns: u64, collection: Collection, settings: ConformalSettings) -> MeanCoverage {
    let (mut share, mut unbounded, mut of_bins) = (0.0, 0.0, vec![(0.0, 0.0); Bins::for_grades().count()]);
    for seed in 0..campaigns {
        let map = campaign(seed, collection, settings);
        let found = map.coverage().unwrap();
        share += found.share / campaigns as f64;
        unbounded += found.unbounded / campaigns as f64;
        for (_, bin, window) in map.windows().filter(|(group, ..)| group.is_none()) {
            if let Some((share, counted)) = window.coverage() {
                of_bins[bin].0 += share * counted as f64;
                of_bins[bin].1 += counted as f64;
            }
        }
    }
    // Bins that few campaigns have reached say nothing.
    let counted = of_bins.iter().filter(|(_, counted)| *counted >= 10.0 * campaigns as f64);
    let shares = counted.map(|(covered, counted)| covered / counted);
    let bins = shares.fold([1.0, 0.0], |[low, high]: [f64; 2], share| [low.min(share), high.max(share)]);
    MeanCoverage { share, bins, unbounded }
}

/// Checks that 90 % of the errors are below their bounds. docs/labels.md has these numbers.
fn check_coverage(collection: Collection) {
    let found = coverage(1000, collection, NINETY);
    let MeanCoverage { share, bins: [low, high], unbounded } = found;
    assert!((0.88..=0.92).contains(&share) && unbounded < 0.1, "{found:?}");
    assert!(low > 0.86 && high < 0.94, "{found:?}");
    println!("{collection:?}: {found:?}");
}

#[test]
fn bounds_hold_where_nothing_changes() {
    check_coverage(Collection::Same);
}

#[test]
fn bounds_hold_while_errors_fall() {
    check_coverage(Collection::FallingErrors);
}

#[test]
fn bounds_hold_while_errors_rise() {
    check_coverage(Collection::RisingErrors);
}

#[test]
fn bounds_hold_where_a_mixture_learns_what_is_collected() {
    check_coverage(Collection::Adaptive);
}

#[test]
fn bounds_from_labels_by_value_hold_for_labels_by_value() {
    check_coverage(Collection::ByValue);
}

/// What the window and the correction are for: without them, bounds hold too rarely or too often when collection adapts.
#[test]
fn without_correction_the_bound_lags_behind() {
    let settings = ConformalSettings { step: 0.0, window: 1000, ..NINETY };
    let [falling, rising] = [Collection::FallingErrors, Collection::RisingErrors]
        .map(|collection| coverage(20, collection, settings).share);
    assert!(falling > 0.94 && rising < 0.86, "{falling} {rising}");
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
            window.learn(number as u64, &[error]);
        }
        let target = 1.0 - NINETY.level;
        prop_assert!(missed <= target * compared + (target + NINETY.step) / NINETY.step + 1e-9, "{} of {}", missed, compared);
    }
}
