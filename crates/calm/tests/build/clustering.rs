//! Pass 1: the quality of the clusters, and streams with few atoms.

use calm::build::{BuildError, BuildSettings, ShardClustering, ShardClusters, partition};

use super::{Blobs, settings};
use crate::common::Random;

/// Pass 1 over one shard, in batches of these many atoms.
fn clusters(settings: &BuildSettings, shard: u64, features: &[f64], batch: usize) -> ShardClusters {
    let mut pass = ShardClustering::new(settings, shard, 0).unwrap();
    features.chunks(batch * settings.dimension).for_each(|batch| pass.add(batch).unwrap());
    pass.finish()
}

/// The shards of a data set.
fn shards(settings: &BuildSettings, features: &[f64], atoms: usize) -> Vec<ShardClusters> {
    let shards = features.chunks(atoms * settings.dimension).enumerate();
    shards.map(|(shard, features)| clusters(settings, shard as u64, features, 100)).collect()
}

/// Σ |z − c|² to the nearest of some centroids.
fn inertia(dimension: usize, features: &[f64], centroids: &[f64]) -> f64 {
    let squared = |z: &[f64], c: &[f64]| z.iter().zip(c).map(|(z, c)| (z - c).powi(2)).sum::<f64>();
    let nearest =
        |z: &[f64]| centroids.chunks_exact(dimension).map(|c| squared(z, c)).fold(f64::INFINITY, f64::min);
    features.chunks_exact(dimension).map(nearest).sum()
}

/// Lloyd's algorithm over all atoms, from these centroids.
fn lloyd(dimension: usize, features: &[f64], mut centroids: Vec<f64>) -> Vec<f64> {
    for _ in 0..100 {
        let mut sums = vec![0.0; centroids.len()];
        let mut counts = vec![0.0; centroids.len() / dimension];
        for z in features.chunks_exact(dimension) {
            let slot = calm::grade::nearest(centroids.chunks_exact(dimension), z);
            counts[slot] += 1.0;
            sums[slot * dimension..][..dimension].iter_mut().zip(z).for_each(|(sum, z)| *sum += z);
        }
        let rows = centroids.chunks_exact_mut(dimension).zip(sums.chunks_exact(dimension)).zip(counts);
        for ((centroid, sums), count) in rows.filter(|(_, count)| *count > 0.0) {
            centroid.iter_mut().zip(sums).for_each(|(c, sum)| *c = sum / count);
        }
    }
    centroids
}

#[test]
fn the_elbow_finds_the_blobs_and_lloyd_hardly_improves_them() {
    for (seed, blobs) in [(1, 2), (2, 4), (3, 8), (4, 4)] {
        let dimension = 10;
        let data = Blobs::new(seed, dimension, blobs, 12_000, 12.0);
        let settings = settings(dimension, &[1, 2, 4, 8, 16]);
        let found = partition(&settings, 0, &shards(&settings, &data.features, 3000)).unwrap();
        println!("{blobs} blobs: {} chosen, inertia {:?}", found.chosen, found.inertia);
        assert_eq!((found.chosen, found.atoms), (blobs, 12_000));
        assert_eq!(found.counts.iter().sum::<f64>(), 12_000.0);
        // Each blob has its centroid, with its atoms.
        for (label, centre) in data.centres.iter().enumerate() {
            let slot = calm::grade::nearest(found.centroids.chunks_exact(dimension), centre);
            let away = inertia(dimension, &found.centroids[slot * dimension..][..dimension], centre).sqrt();
            assert!(away < 0.5, "{away}");
            let atoms = data.labels.iter().filter(|own| **own == label).count() as f64;
            assert!((found.counts[slot] / atoms - 1.0).abs() < 0.02, "{} {atoms}", found.counts[slot]);
        }
        let reached = inertia(dimension, &data.features, &found.centroids);
        let best = lloyd(dimension, &data.features, found.centroids.clone());
        let best = inertia(dimension, &data.features, &best);
        println!("inertia {reached:.1}, after Lloyd's algorithm {best:.1}");
        assert!(reached < 1.01 * best);
    }
}

/// Without separate clusters, mini-batches must come near a full k-means from any start.
#[test]
fn mini_batches_come_near_lloyd_without_blobs() {
    let dimension = 6;
    let data = Random(9).take(10_000 * dimension);
    let settings = settings(dimension, &[1, 8]);
    let found = clusters(&settings, 0, &data, 333);
    assert_eq!(found.candidates.len(), 2);
    let starts = [2_000, 5_000, 7_000].map(|first| data[first * dimension..][..8 * dimension].to_vec());
    let best = starts.map(|start| inertia(dimension, &data, &lloyd(dimension, &data, start)));
    let best = best.into_iter().fold(f64::INFINITY, f64::min);
    let reached = inertia(dimension, &data, &found.candidates[1].centroids);
    println!("inertia {reached:.1}, Lloyd's algorithm {best:.1}");
    assert!(reached < 1.03 * best);
    // The inertia of the pass is that of centroids that still moved.
    assert!(found.candidates[1].inertia < 1.05 * best);
    let mean = inertia(dimension, &data, &found.candidates[0].centroids);
    assert!((found.candidates[0].inertia / mean - 1.0).abs() < 0.01);
}

/// The first atoms, which initialise all centroids, come from a region that does not come again.
#[test]
fn centroids_move_to_regions_that_come_late() {
    let dimension = 4;
    let mut data = Random(3).take(2000 * dimension);
    let late = Random(4).take(120_000 * dimension);
    data.extend(late.iter().enumerate().map(|(k, z)| z + 30.0 * (1 + k / dimension % 3) as f64));
    let found = clusters(&settings(dimension, &[4]), 0, &data, 1000);
    let found = &found.candidates[0];
    assert_eq!(found.counts.iter().sum::<f64>(), 122_000.0);
    // Centroids keep a memory of what they represented before, but each region has its own.
    let regions = [30.0, 60.0, 90.0].map(|centre| {
        let slot = calm::grade::nearest(found.centroids.chunks_exact(dimension), &vec![centre; dimension]);
        let away = (found.centroids[slot * dimension] - centre).abs();
        assert!(away < 10.0, "{away}");
        slot
    });
    assert!(regions[0] != regions[1] && regions[1] != regions[2] && regions[0] != regions[2]);
}

#[test]
fn the_result_depends_on_seed_and_order_but_not_on_batches() {
    let dimension = 5;
    let data = Random(4).take(3000 * dimension);
    let settings = settings(dimension, &[1, 2, 4]);
    let found = clusters(&settings, 3, &data, 3000);
    for batch in [1, 7, 1024, 2500] {
        assert_eq!(found, clusters(&settings, 3, &data, batch));
    }
    let other = BuildSettings { seed: 43, ..settings.clone() };
    assert_ne!(found.candidates, clusters(&other, 3, &data, 100).candidates);
    assert_ne!(found.candidates, clusters(&settings, 4, &data, 100).candidates);
    // A build that goes on from stored shards has the same partition.
    let all = shards(&settings, &data, 700);
    let stored: Vec<ShardClusters> = serde_json::from_slice(&serde_json::to_vec(&all).unwrap()).unwrap();
    assert_eq!(stored, all);
    assert_eq!(partition(&settings, 0, &all), partition(&settings, 0, &stored));
}

#[test]
fn few_or_equal_atoms_give_few_clusters() {
    let dimension = 3;
    let settings = settings(dimension, &[1, 2, 4, 8, 16]);
    let empty = clusters(&settings, 0, &[], 1);
    assert_eq!((empty.atoms, empty.candidates.len()), (0, 0));
    let none = partition(&settings, 0, std::slice::from_ref(&empty)).unwrap();
    assert_eq!((none.atoms, none.chosen, none.centroids.len()), (0, 0, 0));

    let two = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0];
    let few = clusters(&settings, 1, &two, 1);
    let sizes: Vec<usize> = few.candidates.iter().map(|found| found.counts.len()).collect();
    assert_eq!(sizes, [1, 2, 2, 2, 2]);
    // Fewer than D + 1 atoms make one cluster at their mean.
    let found = partition(&settings, 0, &[empty, few]).unwrap();
    assert_eq!((found.centroids.as_slice(), found.counts.as_slice()), (&[0.5; 3][..], &[2.0][..]));

    let equal = clusters(&settings, 0, &[0.25; 30], 4);
    assert!(equal.candidates.iter().all(|found| found.counts == [10.0] && found.inertia == 0.0));
    assert_eq!(partition(&settings, 0, &[equal]).unwrap().centroids, [0.25; 3]);
}

#[test]
fn wrong_settings_and_shards_are_errors() {
    for candidates in [&[][..], &[0, 1], &[2, 2], &[4, 2]] {
        let found = ShardClustering::new(&settings(3, candidates), 0, 0).unwrap_err();
        assert!(found.to_string().contains("expected at least one, ascending, from 1"), "{found}");
    }
    assert_eq!(ShardClustering::new(&settings(0, &[1]), 0, 0).unwrap_err(), BuildError::NoFeature);
    let settings = settings(2, &[1, 2]);
    let mut pass = ShardClustering::new(&settings, 0, 0).unwrap();
    let found = pass.add(&[0.0, 1.0, f64::INFINITY, 0.0]).unwrap_err();
    assert!(found.to_string().starts_with("features of atom 1 of the batch"), "{found}");
    assert_eq!(pass.finish().atoms, 0);

    let shard = |index| clusters(&settings, index, &[0.0, 1.0, 2.0, 3.0], 9);
    let message = |shards: &[ShardClusters]| partition(&settings, 0, shards).unwrap_err().to_string();
    assert!(message(&[shard(1), shard(0)]).contains("its index is 0, expected 2"));
    assert!(message(&[shard(1), shard(1)]).contains("its index is 1, expected 2"));
    assert!(message(&[ShardClusters { element: 4, ..shard(0) }]).contains("the index of its element is 4"));
    let mut damaged = shard(0);
    damaged.candidates.pop();
    assert!(message(&[damaged]).contains("the number of candidates is 1, expected 2"));
    let mut damaged = shard(0);
    damaged.candidates[0].centroids.pop();
    assert!(message(&[damaged]).contains("centroids of a shard: found 1 numbers, expected 2"));
}
