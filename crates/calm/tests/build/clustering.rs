//! Pass 1: the quality of the clusters, and streams with few atoms.

use calm::build::{BuildError, BuildSettings, ElementPartition, Partitioner, ShardClustering, ShardClusters};

use super::{Blobs, batches, settings, weights};
use crate::common::Random;

/// Pass 1 over one shard, in batches of these many atoms.
fn clusters(settings: &BuildSettings, shard: u64, features: &[f64], batch: usize) -> ShardClusters {
    let weights = vec![1.0; features.len() / settings.dimension];
    weighted_clusters(settings, shard, (features, &weights), batch)
}

fn weighted_clusters(
    settings: &BuildSettings,
    shard: u64,
    (features, weights): (&[f64], &[f64]),
    batch: usize,
) -> ShardClusters {
    let mut pass = ShardClustering::new(settings, shard, 0).unwrap();
    for (features, weights) in batches(settings.dimension, features, weights, &[batch]) {
        pass.add(features, weights).unwrap();
    }
    pass.finish()
}

/// The global step.
fn partition(
    settings: &BuildSettings,
    element: usize,
    shards: &[ShardClusters],
) -> Result<ElementPartition, BuildError> {
    let mut all = Partitioner::new(settings, element)?;
    shards.iter().try_for_each(|shard| all.add(shard))?;
    Ok(all.finish())
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

/// The first atoms, which initialise all centroids, come from a region that does not occur again.
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
    // A build that continues from stored shards has the same partition.
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
    let found = pass.add(&[0.0, 1.0, f64::INFINITY, 0.0], &[1.0; 2]).unwrap_err();
    assert!(found.to_string().starts_with("features of atom 1 of the batch"), "{found}");
    let found = pass.add(&[0.0; 4], &[1.0, -1.0]).unwrap_err();
    assert!(found.to_string().starts_with("weight of atom 1 of the batch: found -1"), "{found}");
    assert!(matches!(pass.add(&[0.0; 4], &[1.0]), Err(BuildError::Length { .. })));
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

/// Σ w and Σ w x / Σ w of the atoms of each blob, and their number.
fn weighted_means(data: &Blobs, dimension: usize, weights: &[f64]) -> Vec<(f64, Vec<f64>, f64)> {
    let mut sums = vec![(0.0, vec![0.0; dimension], 0.0); data.centres.len()];
    for ((row, &label), &weight) in data.features.chunks_exact(dimension).zip(&data.labels).zip(weights) {
        let (total, sum, count) = &mut sums[label];
        *total += weight;
        *count += 1.0;
        sum.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
    }
    for (total, sum, _) in &mut sums {
        sum.iter_mut().for_each(|value| *value /= *total);
    }
    sums
}

#[test]
fn centroids_of_blobs_are_the_weighted_means_of_their_atoms() {
    let (dimension, atoms) = (4, 6000);
    let data = Blobs::new(5, dimension, 4, atoms, 200.0);
    let weights = weights(6, atoms);
    let settings = settings(dimension, &[4]);
    let expected = weighted_means(&data, dimension, &weights);
    // One shard, in which mini-batches move the centroids, and the combination of five.
    let one = weighted_clusters(&settings, 0, (&data.features, &weights), 77);
    assert_eq!(one.atoms, atoms as u64);
    assert!((one.weight - weights.iter().sum::<f64>()).abs() < 1e-9);
    let parts = data.features.chunks(1300 * dimension).zip(weights.chunks(1300)).zip(0..);
    let parts: Vec<_> = parts.map(|(part, shard)| weighted_clusters(&settings, shard, part, 1000)).collect();
    let all = partition(&settings, 0, &parts).unwrap();
    let found = &one.candidates[0];
    for centroids in [&found.centroids, &all.centroids] {
        for (total, mean, count) in &expected {
            let slot = calm::grade::nearest(centroids.chunks_exact(dimension), mean);
            let centroid = &centroids[slot * dimension..][..dimension];
            let away = centroid.iter().zip(mean).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(away < 1e-10, "{away:e}");
            let counts = if centroids == &all.centroids { &all.counts } else { &found.counts };
            assert_eq!(counts[slot], *count);
            if centroids == &found.centroids {
                assert!((found.weights[slot] / total - 1.0).abs() < 1e-12);
            }
        }
    }
    // Σ w |x − c|² per weight; the centroids of the pass still moved.
    let rows = data.features.chunks_exact(dimension).zip(&data.labels).zip(&weights);
    let squares = rows.map(|((row, &label), weight)| weight * inertia(dimension, row, &expected[label].1));
    let mean = squares.sum::<f64>() / weights.iter().sum::<f64>();
    assert!((all.inertia[0] / mean - 1.0).abs() < 0.01, "{} {mean}", all.inertia[0]);
}

#[test]
fn a_weight_is_a_number_of_copies() {
    // Whole numbers, whose sums are exact, in one mini-batch.
    let dimension = 3;
    let data: Vec<f64> = Random(8).take(200 * dimension).iter().map(|x| (20.0 * x).round()).collect();
    let weights: Vec<f64> = Random(9).take(200).iter().map(|x| (2.0 + 2.4 * x).round()).collect();
    let rows = data.chunks_exact(dimension).zip(&weights);
    let copies: Vec<f64> = rows.flat_map(|(row, weight)| row.repeat(*weight as usize)).collect();
    assert!(copies.len() / dimension < 1024 && weights.contains(&0.0) && weights.contains(&4.0));
    let settings = settings(dimension, &[1, 2, 4, 8]);
    let weighted = weighted_clusters(&settings, 0, (&data, &weights), 50);
    let copied = clusters(&settings, 0, &copies, 50);
    assert_eq!(weighted.weight, copied.weight);
    for (a, b) in weighted.candidates.iter().zip(&copied.candidates) {
        assert_eq!((&a.centroids, &a.weights, &b.weights), (&b.centroids, &b.counts, &b.counts));
        assert!((a.inertia / b.inertia - 1.0).abs() < 1e-12);
    }
    assert_eq!(weighted.atoms as usize, weights.iter().filter(|weight| **weight > 0.0).count());
}

#[test]
fn weights_count_relative_to_each_other_and_atoms_without_weight_do_not() {
    let (dimension, atoms) = (5, 5000);
    let data = Random(4).take(atoms * dimension);
    let own = weights(3, atoms);
    let settings = settings(dimension, &[1, 2, 4]);
    let shards = |factor: f64| {
        let own: Vec<f64> = own.iter().map(|weight| factor * weight).collect();
        let parts = data.chunks(1700 * dimension).zip(own.chunks(1700)).zip(0..);
        parts.map(|(part, shard)| weighted_clusters(&settings, shard, part, 100)).collect::<Vec<_>>()
    };
    // A power of two changes no digit.
    assert_eq!(partition(&settings, 0, &shards(1.0)), partition(&settings, 0, &shards(0.25)));
    let ones = vec![1.0; atoms];
    assert_ne!(clusters(&settings, 0, &data, 10), weighted_clusters(&settings, 0, (&data, &own), 10));

    let (mut more, mut weights) = (data.clone(), ones);
    for _ in 0..300 {
        more.splice(0..0, [100.0; 5]);
        weights.insert(0, 0.0);
    }
    let found = weighted_clusters(&settings, 0, (&more, &weights), 64);
    assert_eq!(found, clusters(&settings, 0, &data, 64));
    let none = weighted_clusters(&settings, 0, (&data, &vec![0.0; atoms]), 64);
    assert_eq!((none.atoms, none.candidates.len()), (0, 0));
}

#[test]
fn clusters_merge_by_their_number_of_atoms_whatever_their_weight() {
    // D + 1 = 4 atoms are needed: 3 heavy ones are too few, 5 light ones are enough.
    let dimension = 3;
    let blob = |centre: f64, atoms: usize| -> Vec<f64> {
        (0..atoms).flat_map(|atom| [centre, centre, centre + 0.01 * atom as f64]).collect()
    };
    let data = [blob(0.0, 40), blob(50.0, 3), blob(-90.0, 5)].concat();
    let weights = [vec![1.0; 40], vec![1e4; 3], vec![0.1; 5]].concat();
    let settings = settings(dimension, &[3]);
    let shard = weighted_clusters(&settings, 0, (&data, &weights), 48);
    let found = partition(&settings, 0, &[shard]).unwrap();
    let mut counts = found.counts.clone();
    counts.sort_by(f64::total_cmp);
    assert_eq!(counts, [5.0, 43.0]);
    // The heavy atoms draw the centroid of the merged cluster to themselves.
    let slot = calm::grade::nearest(found.centroids.chunks_exact(dimension), &[50.0; 3]);
    assert!((found.centroids[slot * dimension] - 50.0).abs() < 0.1, "{:?}", found.centroids);
}

#[test]
fn many_shards_are_combined_in_groups() {
    let (dimension, per_shard, count) = (4, 200, 300);
    let data = Blobs::new(7, dimension, 4, per_shard * count, 12.0);
    let settings = settings(dimension, &[1, 2, 4, 8]);
    let all = shards(&settings, &data.features, per_shard);
    let found = partition(&settings, 0, &all).unwrap();
    assert_eq!((found.chosen, found.atoms), (4, (per_shard * count) as u64));
    assert_eq!(found.counts.iter().sum::<f64>(), (per_shard * count) as f64);
    let reached = inertia(dimension, &data.features, &found.centroids);
    let best = lloyd(dimension, &data.features, found.centroids.clone());
    let best = inertia(dimension, &data.features, &best);
    assert!(reached < 1.01 * best, "{reached} {best}");
}
