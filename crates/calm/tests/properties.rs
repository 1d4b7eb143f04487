//! Properties over random mixtures and batches.

use std::sync::Arc;

use calm::{
    AlphaScan, Batch, Component, CovarianceUpdate, CovarianceUpdateKind, Grades, Mixture, Statistics,
    regularised_inverse,
};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use crate::common;
use crate::common::Random;

/// A mixture of one component whose covariance has the given widths along random directions, and a batch.
fn case(seed: u64, dimension: usize, atoms: usize, distance: f64) -> (Mixture, Vec<f64>) {
    let mut random = Random(seed);
    let count = 2 * dimension + 3;
    let mut scatter = vec![0.0; dimension * dimension];
    for _ in 0..count {
        let z: Vec<f64> = (0..dimension).map(|index| random.next() * 0.3_f64.powi(index as i32)).collect();
        for (index, sum) in scatter.iter_mut().enumerate() {
            *sum += z[index / dimension] * z[index % dimension];
        }
    }
    let covariance: Vec<f64> = scatter.iter().map(|value| value / count as f64).collect();
    let inverse = regularised_inverse(&covariance, dimension).unwrap();
    let statistics = Statistics { scatter, count: count as f64, effective_count: count as f64 };
    let centroid = random.take(dimension);
    let features = (0..atoms)
        .flat_map(|_| centroid.iter().map(|z| z + distance * random.next()).collect::<Vec<_>>())
        .collect();
    let component = Component::new(centroid, inverse, 1.5, Some(statistics)).unwrap();
    (Mixture::new(0, vec![vec![Arc::new(component)]]).unwrap(), features)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, rng_seed: RngSeed::Fixed(1), ..ProptestConfig::default() })]

    #[test]
    fn an_update_keeps_the_inverse_symmetric_and_positive(
        seed: u64, dimension in 1..12_usize, atoms in 1..20_usize, distance in 0.001..10.0_f64, alpha in 0.01..1.0_f64,
    ) {
        let (mixture, features) = case(seed, dimension, atoms, distance);
        let batch = Batch::new(&mixture, &vec![0; atoms], &features).unwrap();
        for update in [CovarianceUpdate::Convex { alpha }, CovarianceUpdate::Additive { alpha }] {
            let changed = batch.updated(update).unwrap();
            let component = &changed[0].component;
            let inverse = component.inverse();
            for row in 0..dimension {
                for column in 0..dimension {
                    prop_assert_eq!(inverse[row * dimension + column], inverse[column * dimension + row]);
                }
            }
            let mut random = Random(seed ^ 1);
            let next = mixture.with_changes(&changed).unwrap();
            let mut grades = Grades::default();
            for _ in 0..20 {
                // An error here would mean that σ² is not positive.
                grades.evaluate(&next, &[0], &random.take(dimension), None).unwrap();
            }
        }
    }

    #[test]
    fn the_ladder_is_the_direct_update(
        seed: u64, dimension in 1..12_usize, atoms in 1..20_usize, distance in 0.001..10.0_f64, alpha in 0.01..0.99_f64,
    ) {
        let (mixture, features) = case(seed, dimension, atoms, distance);
        let batch = Batch::new(&mixture, &vec![0; atoms], &features).unwrap();
        for (combination, update) in [
            (CovarianceUpdateKind::Convex, CovarianceUpdate::Convex { alpha }),
            (CovarianceUpdateKind::Additive, CovarianceUpdate::Additive { alpha }),
        ] {
            let direct = batch.gamma_under(&batch.updated(update).unwrap());
            if let Some(fast) = AlphaScan::new(&batch, combination).gamma(alpha) {
                let deviation = common::deviation(&fast, &direct);
                prop_assert!(deviation < 1e-7, "{combination:?}: {deviation:e}");
            }
        }
    }

    #[test]
    fn bytes_keep_every_bit(seed: u64, dimension in 1..12_usize, with_statistics: bool) {
        let component = component(seed, dimension, with_statistics);
        let bytes = component.to_bytes();
        let back = Component::from_bytes(&bytes).unwrap();
        prop_assert_eq!(&back, &component);
        prop_assert_eq!(back.to_bytes(), bytes);
    }

    #[test]
    fn damaged_bytes_never_panic(
        seed: u64, dimension in 1..12_usize, with_statistics: bool, place: prop::sample::Index, value: u8, cut: prop::sample::Index,
    ) {
        let mut bytes = component(seed, dimension, with_statistics).to_bytes();
        let shorter = &bytes[..cut.index(bytes.len())];
        prop_assert!(Component::from_bytes(shorter).is_err());
        let place = place.index(bytes.len());
        bytes[place] = value;
        if let Ok(component) = Component::from_bytes(&bytes) {
            prop_assert_eq!(component.to_bytes(), bytes);
        }
    }

    #[test]
    fn any_bytes_never_panic(bytes: Vec<u8>) {
        prop_assert!(Component::from_bytes(&bytes).is_err());
    }
}

fn component(seed: u64, dimension: usize, with_statistics: bool) -> Component {
    let mut random = Random(seed);
    let statistics = with_statistics.then(|| Statistics {
        scatter: random.take(dimension * dimension),
        count: random.next().abs(),
        effective_count: random.next().abs(),
    });
    let (centroid, inverse) = (random.take(dimension), random.take(dimension * dimension));
    Component::new(centroid, inverse, random.next().abs(), statistics).unwrap()
}
