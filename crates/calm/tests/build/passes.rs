//! Passes 2 and 3: sums do not depend on batches and workers, moments, and degenerate data.

use calm::Grades;
use calm::build::{
    BuildError, BuiltMixture, CalibrationPass, ElementHistograms, ElementSums, ExactSums, ScatterPass,
    ThresholdRule, components,
};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use super::{Blobs, built, calibrate, projection, scatter, settings, weights};
use crate::common::Random;

/// The total of partial results in order.
fn total<T: Clone>(shards: &[T], merge: impl Fn(&mut T, &T)) -> T {
    let mut all = shards[0].clone();
    shards[1..].iter().for_each(|next| merge(&mut all, next));
    all
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, rng_seed: RngSeed::Fixed(1), ..ProptestConfig::default() })]

    /// Workers have contiguous shards and keep one partial result for each.
    #[test]
    fn any_grouping_of_shards_into_workers_gives_the_same_bytes(
        seed: u64, cuts in proptest::collection::btree_set(1..7_usize, 0..5), sizes in proptest::collection::vec(1..300_usize, 1..4),
    ) {
        let (dimension, shards) = (6, 7);
        let blobs = Blobs::new(seed, dimension, 3, 1400, 5.0);
        let weights = weights(seed ^ 1, blobs.atoms());
        let centroids = blobs.centres.concat();
        let shard = |k: usize, sizes: &[usize]| {
            let (from, to) = (k * 200, (k + 1) * 200);
            scatter(dimension, &centroids, &blobs.features[from * dimension..to * dimension], &weights[from..to], sizes)
        };
        let one_worker: Vec<ElementSums> = (0..shards).map(|k| shard(k, &[64])).collect();
        let mut bounds: Vec<usize> = cuts.into_iter().collect();
        bounds.insert(0, 0);
        bounds.push(shards);
        let workers: Vec<Vec<ElementSums>> =
            bounds.windows(2).map(|pair| (pair[0]..pair[1]).map(|k| shard(k, &sizes)).collect()).collect();
        let merge = |all: &mut ElementSums, next: &ElementSums| all.merge(next).unwrap();
        let (one, several) = (total(&one_worker, merge), total(&workers.concat(), merge));
        prop_assert_eq!(serde_json::to_vec(&one).unwrap(), serde_json::to_vec(&several).unwrap());

        let components = components(&centroids, &one).unwrap();
        let shard = |k: usize, sizes: &[usize]| {
            let (from, to) = (k * 200, (k + 1) * 200);
            calibrate(&components, &blobs.features[from * dimension..to * dimension], &weights[from..to], sizes)
        };
        let merge = |all: &mut ElementHistograms, next: &ElementHistograms| all.merge(next).unwrap();
        let one: Vec<_> = (0..shards).map(|k| shard(k, &[64])).collect();
        let several: Vec<_> = (0..shards).map(|k| shard(k, &sizes)).collect();
        let (one, several) = (total(&one, merge), total(&several, merge));
        prop_assert_eq!(serde_json::to_vec(&one).unwrap(), serde_json::to_vec(&several).unwrap());
        let atoms: u64 = one.components.iter().map(|histogram| histogram.count()).sum();
        prop_assert_eq!(atoms, 1400);
    }
}

/// Exact sums do not depend on the order of the shards, and are those of the shards in their order up to rounding.
#[test]
fn exact_sums_have_the_same_bits_in_any_order() {
    let (dimension, shards) = (6, 9);
    let blobs = Blobs::new(11, dimension, 3, 900, 5.0);
    let (weights, centroids) = (weights(12, blobs.atoms()), blobs.centres.concat());
    let part =
        |k: usize| (&blobs.features[k * 100 * dimension..][..100 * dimension], &weights[k * 100..][..100]);
    let sums: Vec<ElementSums> =
        (0..shards).map(|k| scatter(dimension, &centroids, part(k).0, part(k).1, &[64])).collect();
    let exact = |rows: &mut dyn Iterator<Item = Vec<f64>>| {
        let mut total: Option<ExactSums> = None;
        rows.for_each(|row| total.get_or_insert_with(|| ExactSums::new(row.len())).add(&row).unwrap());
        total.unwrap()
    };
    let forward = exact(&mut sums.iter().map(ElementSums::to_row));
    assert_eq!(forward, exact(&mut sums.iter().rev().map(ElementSums::to_row)));
    let found = ElementSums::from_row(dimension, &forward.totals()).unwrap();
    let merged = total(&sums, |all: &mut ElementSums, next| all.merge(next).unwrap());
    assert_eq!(found.components.len(), merged.components.len());
    for (found, merged) in found.components.iter().zip(&merged.components) {
        assert_eq!(found.count, merged.count);
        assert!((found.effective_count / merged.effective_count - 1.0).abs() < 1e-13);
        crate::common::assert_close("scatter", &found.scatter, &merged.scatter, 1e-13);
    }
    assert!(ElementSums::from_row(dimension, &forward.totals()[1..]).is_err());

    let components = components(&centroids, &merged).unwrap();
    let histograms: Vec<ElementHistograms> =
        (0..shards).map(|k| calibrate(&components, part(k).0, part(k).1, &[64])).collect();
    let forward = exact(&mut histograms.iter().map(ElementHistograms::to_row));
    assert_eq!(forward, exact(&mut histograms.iter().rev().map(ElementHistograms::to_row)));
    let found = ElementHistograms::from_row(&forward.totals()).unwrap();
    let merged = total(&histograms, |all: &mut ElementHistograms, next| all.merge(next).unwrap());
    for (found, merged) in found.components.iter().zip(&merged.components) {
        assert_eq!(found.raw, merged.raw);
        crate::common::assert_close("weights", &found.weighted, &merged.weighted, 1e-13);
    }
}

#[test]
fn sums_are_those_of_their_definition() {
    let dimension = 9;
    let blobs = Blobs::new(3, dimension, 4, 2000, 6.0);
    let weights = weights(4, blobs.atoms());
    let centroids = blobs.centres.concat();
    let found = scatter(dimension, &centroids, &blobs.features, &weights, &[123]);
    let (mut counts, mut effective) = ([0.0; 4], [0.0; 4]);
    let mut sums = vec![vec![0.0; dimension * (dimension + 1) / 2]; 4];
    for (z, w) in blobs.features.chunks_exact(dimension).zip(&weights) {
        let slot = calm::grade::nearest(blobs.centres.iter().map(Vec::as_slice), z);
        counts[slot] += 1.0;
        effective[slot] += w;
        let delta: Vec<f64> = z.iter().zip(&blobs.centres[slot]).map(|(z, c)| z - c).collect();
        let lower = (0..dimension).flat_map(|row| (0..=row).map(move |column| (row, column)));
        for (sum, (row, column)) in sums[slot].iter_mut().zip(lower) {
            *sum += w * delta[row] * delta[column];
        }
    }
    for (slot, component) in found.components.iter().enumerate() {
        assert_eq!(component.count, counts[slot]);
        assert!((component.effective_count / effective[slot] - 1.0).abs() < 1e-13);
        for (found, expected) in component.scatter.iter().zip(&sums[slot]) {
            assert!((found - expected).abs() < 1e-10, "{found} {expected}");
        }
    }
}

/// The mean of σ² over a component's own atoms is tr(S C) = Σ w/(w + ε) over the eigenvalues w of C, plus the floor.
#[test]
fn the_mean_of_squared_distances_is_the_rank() {
    let dimension = 12;
    let mut blobs = Blobs::new(8, dimension, 3, 3000, 20.0);
    // Two directions without data.
    blobs.features.chunks_exact_mut(dimension).for_each(|row| row[3..5].fill(0.25));
    let weights = weights(2, blobs.atoms());
    let mut centroids = blobs.centres.concat();
    centroids.chunks_exact_mut(dimension).for_each(|row| row[3..5].fill(0.25));
    let element = built(dimension, &centroids, &blobs.features, &weights);
    let mixture = BuiltMixture::new(
        vec!["Al".into()],
        projection(dimension),
        None,
        settings(dimension, &[3]),
        vec![Some(element.clone())],
    );
    let artifact = mixture.unwrap().artifact().unwrap();
    let mut grades = Grades::default();
    grades.evaluate(&artifact.mixture, &vec![0; blobs.atoms()], &blobs.features, None).unwrap();
    for (slot, component) in element.components.iter().enumerate() {
        assert_eq!((component.effective_rank, component.truncated), (dimension - 2, 0));
        let own =
            || grades.sigma.iter().zip(&grades.component).zip(&weights).filter(|((_, s), _)| **s == slot);
        let mean = own().map(|((sigma, _), w)| w * sigma * sigma).sum::<f64>() / component.effective_count;
        let trace: f64 = component.inverse.iter().zip(&component.scatter).map(|(a, b)| a * b).sum();
        let trace = trace / component.effective_count;
        // Centroids and matrices in single precision.
        assert!((mean / trace - 1.0).abs() < 1e-5, "{mean} {trace}");
        assert!((trace / (dimension - 2) as f64 - 1.0).abs() < 1e-4, "{trace}");
    }
}

#[test]
fn few_equal_or_weightless_atoms_make_a_mixture() {
    let dimension = 8;
    let mut random = Random(6);
    let few = random.take(3 * dimension);
    let equal = random.take(dimension).repeat(40);
    let many = random.take(200 * dimension);
    let mean = |features: &[f64]| {
        let rows = features.len() / dimension;
        (0..dimension)
            .map(|k| features.iter().skip(k).step_by(dimension).sum::<f64>() / rows as f64)
            .collect::<Vec<_>>()
    };
    let elements = vec![
        Some(built(dimension, &mean(&few), &few, &[1.0; 3])),
        Some(built(dimension, &mean(&equal), &equal, &[0.5; 40])),
        None,
        // Far centroids that no atom belongs to.
        Some(built(
            dimension,
            &[mean(&many), vec![9.0; dimension], vec![-9.0; dimension]].concat(),
            &many,
            &[2.0; 200],
        )),
    ];
    let counts: Vec<usize> = elements.iter().flatten().map(|element| element.components.len()).collect();
    assert_eq!(counts, [1, 1, 1]);
    let symbols = ["H", "He", "Li", "Be"].map(str::to_owned).to_vec();
    let mixture =
        BuiltMixture::new(symbols, projection(dimension), None, settings(dimension, &[1]), elements).unwrap();
    let artifact = mixture.artifact().unwrap();
    assert_eq!(artifact.unsound_components(), []);
    assert!(!artifact.mixture.has_data_of(2) && artifact.mixture.has_data_of(0));
    // The element with 200 atoms has a threshold of its own, the mean of σ² is D.
    let threshold = artifact.mixture.component(3, 0).unwrap().threshold();
    assert!((2.0..6.0).contains(&threshold), "{threshold}");
    // Of equal atoms, σ is the floor: the lowest bin.
    assert!(artifact.mixture.component(1, 0).unwrap().threshold() < 0.011);

    // Atoms without weight count, but have no part in covariance and weighted threshold.
    let element = built(dimension, &mean(&many), &many, &[0.0; 200]);
    assert_eq!((element.components[0].count, element.components[0].effective_count), (200.0, 0.0));
    assert_eq!(element.histograms.thresholds(ThresholdRule::Robust, dimension).weighted, [1.0]);
}

#[test]
fn wrong_input_is_an_error_and_changes_nothing() {
    let message = |error: BuildError| error.to_string();
    assert_eq!(
        message(ScatterPass::new(0, &[]).unwrap_err()),
        "a build needs at least one feature dimension"
    );
    let none = ScatterPass::new(2, &[]).unwrap_err();
    assert_eq!(message(none), "the element has no centroid; pass 1 found no atoms of it");
    assert!(message(CalibrationPass::new(&[]).unwrap_err()).contains("at least one feature"));
    let mut pass = ScatterPass::new(2, &[0.0, 0.0, 1.0, 1.0]).unwrap();
    pass.add(&[1.0, 2.0], &[1.0]).unwrap();
    let before = pass.clone().finish();
    let found = pass.add(&[1.0, 2.0], &[1.0, 1.0]).unwrap_err();
    assert_eq!(message(found), "weights: found 2 numbers, expected 1");
    let found = pass.add(&[1.0, 2.0, 3.0, f64::NAN], &[1.0, 1.0]).unwrap_err();
    assert!(message(found).starts_with("features of atom 1 of the batch: found a sum of squares of NaN"));
    let found = pass.add(&[1.0, 2.0, 3.0, 3.0], &[1.0, -1.0]).unwrap_err();
    assert!(message(found).starts_with("weight of atom 1 of the batch: found -1, expected a finite number"));
    let mut sums = pass.finish();
    assert_eq!(sums, before);

    let other = ScatterPass::new(2, &[0.0, 0.0]).unwrap().finish();
    let found = message(sums.merge(&other).unwrap_err());
    assert_eq!(
        found,
        "partial result of a shard: the number of components is 1, expected 2; was it made by this build?"
    );
    assert!(sums.merge(&ScatterPass::new(1, &[0.0, 1.0]).unwrap().finish()).is_err());
    assert!(ElementHistograms::empty(2).merge(&ElementHistograms::empty(1)).is_err());
    assert_eq!(sums, before);
    assert!(components(&[0.0, 1.0], &sums).is_err());
    let mixture = BuiltMixture::new(vec!["Al".into()], projection(2), None, settings(2, &[1]), vec![None]);
    assert_eq!(mixture.unwrap_err(), BuildError::NoCentroid);
    let mixture = BuiltMixture::new(vec![], projection(3), None, settings(2, &[1]), vec![]);
    assert_eq!(mixture.unwrap_err().to_string(), "features of the projection: found 3 numbers, expected 2");
}
