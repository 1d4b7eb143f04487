//! Active sets against determinants and pseudo-inverses.

use calm::baselines::{Baseline, BaselineKind, BaselineSettings, Builder, DOptimality};
use proptest::prelude::*;

use super::{Frame, built, frames, gram, joined, mixture, solve};
use crate::common::Random;

const CONSTRUCTIONS: [BaselineKind; 3] =
    [BaselineKind::DOptimalityElement, BaselineKind::DOptimalityCentred, BaselineKind::DOptimalityComponent];

fn active(baseline: &Baseline) -> &DOptimality {
    let Baseline::DOptimality(found) = baseline else { panic!("active sets") };
    found
}

/// √det(A Aᵀ), the volume that rows span.
fn volume(rows: &[&[f64]]) -> f64 {
    solve(gram(rows), vec![0.0; rows.len()]).1.max(0.0).sqrt()
}

/// One element, features as rows of one structure each.
fn single(rows: &[f64], dimension: usize) -> Vec<Frame> {
    rows.chunks_exact(dimension).map(|row| (vec![0], row.to_vec())).collect()
}

fn of_element(rows: &[f64], dimension: usize, settings: &BaselineSettings) -> Baseline {
    built(
        BaselineKind::DOptimalityElement,
        settings,
        &single(rows, dimension),
        dimension,
        &mixture(1, dimension, 1),
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn no_training_atom_exceeds_the_tolerance(
        seed in 0..u64::MAX, dimension in 1..9_usize, elements in 1..3_usize, count in 1..120_usize,
    ) {
        let (frames, mixture) = (frames(seed, dimension, elements, count), mixture(seed, dimension, elements));
        let (of, features) = joined(&frames);
        for kind in CONSTRUCTIONS {
            let settings = BaselineSettings::default();
            let baseline = built(kind, &settings, &frames, dimension, &mixture);
            prop_assert!(active(&baseline).is_converged());
            let worst = baseline.score(&of, &features).unwrap().into_iter().fold(0.0, f64::max);
            prop_assert!(worst <= 1.0 + settings.tolerance + 1e-9, "{kind}: {worst}");
        }
    }

    /// Exchanging any one active row for any other atom does not raise the volume by more than the tolerance.
    #[test]
    fn the_active_rows_are_dominant(seed in 0..u64::MAX, dimension in 1..5_usize, atoms in 5..30_usize) {
        let rows = Random(seed).take(dimension * atoms);
        let settings = BaselineSettings::default();
        let baseline = of_element(&rows, dimension, &settings);
        let set: Vec<&[f64]> = active(&baseline).active_rows(0).unwrap().chunks_exact(dimension).collect();
        let reached = volume(&set);
        let (mut largest, mut greedy) = (0.0_f64, Vec::<&[f64]>::new());
        for _ in 0..dimension {
            let with = |row| volume(&greedy.iter().copied().chain([row]).collect::<Vec<_>>());
            let next = rows.chunks_exact(dimension).max_by(|a, b| with(a).total_cmp(&with(b))).unwrap();
            greedy.push(next);
        }
        for row in rows.chunks_exact(dimension) {
            for slot in 0..set.len() {
                let mut other = set.clone();
                other[slot] = row;
                largest = largest.max(volume(&other));
            }
        }
        prop_assert!(largest <= (1.0 + settings.tolerance) * reached * (1.0 + 1e-6), "{largest} {reached}");
        // MaxVol begins with the greedy choice.
        prop_assert!(reached >= volume(&greedy) * (1.0 - 1e-6));
    }

    /// Of all sets, none has more than r^(r/2) (1 + tolerance)^r times the volume (Goreinov et al. 2010).
    #[test]
    fn the_volume_is_near_the_largest(seed in 0..u64::MAX, atoms in 4..14_usize) {
        let rows = Random(seed).take(3 * atoms);
        let rows: Vec<&[f64]> = rows.chunks_exact(3).collect();
        let baseline = of_element(&rows.concat(), 3, &BaselineSettings::default());
        let set: Vec<&[f64]> = active(&baseline).active_rows(0).unwrap().chunks_exact(3).collect();
        let mut largest = 0.0_f64;
        for a in 0..atoms {
            for b in 0..a {
                (0..b).for_each(|c| largest = largest.max(volume(&[rows[a], rows[b], rows[c]])));
            }
        }
        prop_assert!(largest <= 27_f64.sqrt() * 1.01_f64.powi(3) * volume(&set));
    }
}

/// max |x A⁺| with A⁺ = Aᵀ(A Aᵀ)⁻¹.
fn dense_score(set: &[&[f64]], x: &[f64]) -> f64 {
    let right = set.iter().map(|row| super::dot(row, x)).collect();
    solve(gram(set), right).0.into_iter().fold(0.0, |largest: f64, c| largest.max(c.abs()))
}

#[test]
fn scores_are_those_of_the_pseudo_inverse() {
    for (dimension, atoms) in [(6, 200), (6, 6), (6, 4), (12, 5), (1, 3)] {
        let rows = Random(dimension as u64).take(dimension * atoms);
        let baseline = of_element(&rows, dimension, &BaselineSettings::default());
        assert_eq!(active(&baseline).ranks(), [dimension.min(atoms)]);
        let set: Vec<&[f64]> = active(&baseline).active_rows(0).unwrap().chunks_exact(dimension).collect();
        let others = Random(99).take(dimension * 50);
        let scores = baseline.score(&[0; 50], &others).unwrap();
        for (x, score) in others.chunks_exact(dimension).zip(scores) {
            let expected = dense_score(&set, x);
            assert!((score - expected).abs() < 1e-9 * (1.0 + expected), "{score} {expected}");
        }
    }
}

#[test]
fn dependent_features_give_fewer_active_rows() {
    // Seven features of rank three, and rounding.
    let (dimension, rank, atoms) = (7, 3, 400);
    let directions = Random(3).take(rank * dimension);
    let mut random = Random(4);
    let mut rows = Vec::new();
    for _ in 0..atoms {
        let factors = random.take(rank);
        rows.extend((0..dimension).map(|axis| {
            let along = |k: usize| factors[k] * directions[k * dimension + axis];
            along(0) + along(1) + along(2) + 1e-13 * random.next()
        }));
    }
    let baseline = of_element(&rows, dimension, &BaselineSettings::default());
    assert_eq!((active(&baseline).ranks(), active(&baseline).is_converged()), (vec![rank], true));
    let worst = baseline.score(&vec![0; atoms], &rows).unwrap().into_iter().fold(0.0, f64::max);
    assert!(worst < 1.011, "{worst}");
    // With a tolerance below the noise, all directions count.
    let fine = BaselineSettings { rank_tolerance: 2e-14, ..BaselineSettings::default() };
    assert_eq!(active(&of_element(&rows, dimension, &fine)).ranks(), [dimension]);
}

#[test]
fn batches_do_not_change_bits() {
    let (dimension, elements) = (5, 2);
    let (frames, mixture) = (frames(8, dimension, elements, 150), mixture(8, dimension, elements));
    for kind in CONSTRUCTIONS {
        let one = built(kind, &BaselineSettings::default(), &frames, dimension, &mixture);
        let all = built(kind, &BaselineSettings::default(), &[joined(&frames)], dimension, &mixture);
        assert_eq!(one, all);
    }
}

#[test]
fn sweeps_are_limited() {
    let (dimension, rows) = (6, Random(5).take(6 * 3000));
    let settings = BaselineSettings { max_sweeps: 1, ..BaselineSettings::default() };
    assert!(!active(&of_element(&rows, dimension, &settings)).is_converged());
    assert!(active(&of_element(&rows, dimension, &BaselineSettings::default())).is_converged());
}

#[test]
fn an_element_without_atoms_is_infinitely_far_away() {
    let mixture = mixture(2, 3, 2);
    for kind in CONSTRUCTIONS {
        let baseline =
            built(kind, &BaselineSettings::default(), &[(vec![0; 9], Random(1).take(27))], 3, &mixture);
        let scores = baseline.score(&[0, 1], &[0.5; 6]).unwrap();
        assert!(scores[0].is_finite() && scores[1] == f64::INFINITY, "{kind} {scores:?}");
        let mut empty = Builder::new(kind, &BaselineSettings::default(), 3, 2, Some(&mixture)).unwrap();
        empty.end_sweep();
        assert_eq!(empty.finish().unwrap_err().to_string(), "the training data have no atoms");
    }
}
