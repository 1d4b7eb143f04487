//! After pass 2: the components of an element from the sums of all shards.

use super::distances::check;
use super::error::{BuildError, expect_same};
use super::moments::{ClusterMoments, ElementSums, merge_small};
use super::settings::check_dimension;
use crate::linear::{
    Inverse, LinearError, REGULARISATION, TRUNCATION, pseudo_inverse_with_spectrum, regularised,
};

/// Smaller eigenvalues of C, relative to the largest, do not count for its rank.
const RANK_TOLERANCE: f64 = 1e-12;

/// A component that has its inverse covariance but no threshold yet.
#[derive(Debug, Clone, PartialEq)]
pub struct BuiltComponent {
    /// Centroid **μ**, `[D]`.
    pub centroid: Vec<f64>,
    /// S = (C + εI)⁺ with C = scatter / effective count and ε = 10⁻⁶, `[D × D]`, exactly symmetric.
    pub inverse: Vec<f64>,
    /// Σ w **δδ**ᵀ about the centroid, `[D × D]`, exactly symmetric.
    pub scatter: Vec<f64>,
    /// Number of atoms.
    pub count: f64,
    /// Sum of their weights.
    pub effective_count: f64,
    /// Ratio of the largest to the smallest eigenvalue of C + εI that the pseudo-inverse keeps; 1 without data.
    pub condition_number: f64,
    /// Number of eigenvalues of C above 10⁻¹² times the largest of C + εI; 0 without data.
    pub effective_rank: usize,
    /// Number of eigenvalues of C + εI that the pseudo-inverse drops.
    pub truncated: usize,
}

/// The components of an element from its centroids, `[K × D]`, and the sums of all shards about them.
///
/// Components with fewer than D + 1 atoms are merged: the smallest first, into the one with the nearest centroid,
/// **μ** = (n_A **μ**_A + n_B **μ**_B)/n and S = S_A + S_B + n_A n_B/n **dd**ᵀ with the effective counts n_A, n_B, n = n_A +
/// n_B and **d** = **μ**_A − **μ**_B. Components without atoms disappear this way; the last component stays, however few
/// atoms it has. The order is that of descending effective counts; equal ones keep that of the centroids.
///
/// Directions that the data do not span have the variance ε, so that a covariance of any rank has an inverse.
///
/// # Errors
/// No centroid, sums of another number of components or features, eigenvalues that do not converge.
pub fn components(centroids: &[f64], sums: &ElementSums) -> Result<Vec<BuiltComponent>, BuildError> {
    let dimension = sums.dimension;
    check_dimension(dimension)?;
    let count = check(centroids, dimension, &mut Vec::new())?;
    if count == 0 {
        return Err(BuildError::NoCentroid);
    }
    expect_same("the number of components", sums.components.len() as u64, count as u64)?;
    let half = dimension * (dimension + 1) / 2;
    for sums in &sums.components {
        expect_same("the length of a scatter", sums.scatter.len() as u64, half as u64)?;
    }
    let pairs = centroids.chunks_exact(dimension).zip(&sums.components);
    let mut merged: Vec<ClusterMoments> = pairs
        .map(|(centroid, sums)| ClusterMoments { centroid: centroid.to_vec(), sums: sums.clone() })
        .collect();
    merge_small(&mut merged, dimension + 1);
    merged.sort_by(|a, b| b.sums.effective_count.total_cmp(&a.sums.effective_count));
    merged.into_iter().enumerate().map(|(slot, moments)| component(slot, moments)).collect()
}

fn component(
    slot: usize,
    ClusterMoments { centroid, sums }: ClusterMoments,
) -> Result<BuiltComponent, BuildError> {
    let dimension = centroid.len();
    let scatter = unpacked(&sums.scatter, dimension);
    let (count, effective_count) = (sums.count, sums.effective_count);
    let divisor = if effective_count > 0.0 { effective_count } else { 1.0 };
    let covariance: Vec<f64> = scatter.iter().map(|value| value / divisor).collect();
    let Inverted { inverse, condition_number, effective_rank, truncated } =
        inverted(&covariance, dimension).map_err(|source| BuildError::Linear { slot, source })?;
    Ok(BuiltComponent {
        centroid,
        inverse,
        scatter,
        count,
        effective_count,
        condition_number,
        effective_rank,
        truncated,
    })
}

/// A regularised inverse, with what artifacts record of it; [`BuiltComponent`] explains the numbers.
pub(super) struct Inverted {
    pub inverse: Vec<f64>,
    pub condition_number: f64,
    pub effective_rank: usize,
    pub truncated: usize,
}

/// (C + εI)⁺ of a covariance, `[D × D]`.
pub(super) fn inverted(covariance: &[f64], dimension: usize) -> Result<Inverted, LinearError> {
    let Inverse { matrix, eigenvalues, truncated } =
        pseudo_inverse_with_spectrum(&regularised(covariance, dimension), dimension)?;
    let largest = eigenvalues.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let smallest = eigenvalues.iter().map(|value| value.abs());
    let smallest = smallest.filter(|value| *value > TRUNCATION * largest);
    let own = |value: &&f64| **value - REGULARISATION > RANK_TOLERANCE * largest;
    Ok(Inverted {
        inverse: matrix,
        condition_number: largest / smallest.fold(f64::INFINITY, f64::min),
        effective_rank: eigenvalues.iter().filter(own).count(),
        truncated,
    })
}

/// The symmetric matrix of a lower half, row by row.
fn unpacked(half: &[f64], dimension: usize) -> Vec<f64> {
    let at = |row: usize, column: usize| half[row * (row + 1) / 2 + column];
    let rows = 0..dimension;
    rows.flat_map(|row| (0..dimension).map(move |column| at(row.max(column), row.min(column)))).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::build::moments::ComponentSums;
    use crate::build::tests::{assert_near, numbers, rows, unit_cases};

    fn packed(matrix: &[Vec<f64>]) -> Vec<f64> {
        matrix.iter().enumerate().flat_map(|(row, values)| values[..=row].to_vec()).collect()
    }

    fn matrices(value: &Value) -> Vec<Vec<Vec<f64>>> {
        serde_json::from_value(value.clone()).unwrap()
    }

    /// The clusters of a case without its sentinels, merged.
    fn merged(case: &Value, effective: &[f64], minimum: usize) -> Vec<ClusterMoments> {
        let (centroids, counts) = (rows(&case["centroids"]), numbers(&case["counts"]));
        let scatters = matrices(&case["scatter"]);
        let slots = centroids.into_iter().zip(scatters).zip(counts.into_iter().zip(effective));
        let mut clusters: Vec<ClusterMoments> = slots
            .filter(|((centroid, _), _)| centroid[0] < 1e9)
            .map(|((centroid, scatter), (count, &effective_count))| {
                let sums = ComponentSums { count, effective_count, scatter: packed(&scatter) };
                ClusterMoments { centroid, sums }
            })
            .collect();
        merge_small(&mut clusters, minimum);
        clusters
    }

    #[test]
    fn components_merge_as_in_the_reference() {
        let cases = unit_cases();
        let case = &cases["merge_step2"];
        let minimum = case["min_atoms"].as_u64().unwrap() as usize;
        let raw = numbers(&case["counts"]);
        let weighted = numbers(&cases["merge_step2_weighted"]["effective_counts"]);
        for (effective, expected) in [(raw, case), (weighted, &cases["merge_step2_weighted"])] {
            let clusters = merged(case, &effective, minimum);
            let real: Vec<usize> =
                (0..5).filter(|&slot| numbers(&expected["out_counts"])[slot] > 0.0).collect();
            assert_eq!(clusters.len(), real.len());
            // The empty slot disappears as well.
            assert_eq!(
                case["n_merged"],
                numbers(&case["counts"]).iter().filter(|n| **n > 0.0).count() - real.len()
            );
            for (cluster, &slot) in clusters.iter().zip(&real) {
                assert_eq!(cluster.sums.count, numbers(&expected["out_counts"])[slot]);
                assert_eq!(cluster.sums.effective_count, numbers(&expected["out_effective"])[slot]);
                assert_near(&cluster.centroid, &rows(&expected["out_centroids"])[slot], 1e-14);
                let scatter = packed(&matrices(&expected["out_scatter"])[slot]);
                assert_near(&cluster.sums.scatter, &scatter, 1e-13);
            }
        }
    }

    #[test]
    fn components_are_compacted_sorted_and_inverted_as_in_the_reference() {
        let cases = unit_cases();
        let case = &cases["merge_step2"];
        let mut most = 0;
        for (element, kept) in [("0", vec![0, 1, 2]), ("1", vec![1])] {
            let expected = &cases["finalize"][element];
            let mut clusters = merged(case, &numbers(&case["counts"]), 5);
            clusters = kept.iter().map(|&slot| clusters[slot].clone()).collect();
            let centroids: Vec<f64> = clusters.iter().flat_map(|cluster| cluster.centroid.clone()).collect();
            let sums = clusters.into_iter().map(|cluster| cluster.sums).collect();
            let found = components(&centroids, &ElementSums { dimension: 4, components: sums }).unwrap();
            assert_eq!(found.len(), kept.len());
            most = most.max(found.len());
            for (slot, component) in found.iter().enumerate() {
                assert_near(&component.centroid, &rows(&cases["compact"]["centroids"][element])[slot], 1e-14);
                assert_eq!(component.count, numbers(&cases["compact"]["counts"][element])[slot]);
                assert_near(&component.inverse, &matrices(&expected["inv_cov"])[slot].concat(), 1e-12);
                let condition = numbers(&expected["cond_number"])[slot];
                assert!((component.condition_number / condition - 1.0).abs() < 1e-12);
                assert_eq!(component.effective_rank as f64, numbers(&expected["effective_rank"])[slot]);
            }
        }
        assert_eq!(cases["compact"]["K_max"], most);
    }

    #[test]
    fn deficient_covariances_lose_eigenvalues_as_in_the_reference() {
        let case = &unit_cases()["safe_invert_rank2"];
        let covariance = rows(&case["cov"]).concat();
        let found = pseudo_inverse_with_spectrum(&covariance, 4).unwrap();
        assert_eq!(case["n_truncated"], found.truncated);
        assert_eq!(case["rank"], 4 - found.truncated);
        assert_near(&found.matrix, &rows(&case["inv"]).concat(), 1e-9);
        // With ε on the diagonal nothing is dropped, and the rank is the same.
        let scatter = packed(&rows(&case["cov"])).iter().map(|value| 9.0 * value).collect();
        let sums = ComponentSums { count: 9.0, effective_count: 9.0, scatter };
        let found = components(&[0.0; 4], &ElementSums { dimension: 4, components: vec![sums] }).unwrap();
        assert_eq!((found[0].truncated, found[0].effective_rank), (0, 2));
    }

    #[test]
    fn the_order_is_stable() {
        let sums = |count, effective_count| ComponentSums { count, effective_count, scatter: vec![1.0] };
        let components_of = vec![sums(5.0, 2.0), sums(9.0, 3.0), sums(4.0, 2.0), sums(2.0, 7.0)];
        let all = ElementSums { dimension: 1, components: components_of };
        let found = components(&[10.0, 20.0, 30.0, 40.0], &all).unwrap();
        assert_eq!(found.iter().map(|c| c.centroid[0]).collect::<Vec<_>>(), [40.0, 20.0, 10.0, 30.0]);
    }

    #[test]
    fn components_without_atoms_or_weight_disappear_or_stay_alone() {
        let sums = |count, effective_count, value: f64| ComponentSums {
            count,
            effective_count,
            scatter: vec![value, 0.0, value],
        };
        let of = |components| ElementSums { dimension: 2, components };
        let centroids = [0.0, 0.0, 1.0, 1.0, 5.0, 5.0];
        let empty = sums(0.0, 0.0, 0.0);
        let found =
            components(&centroids, &of(vec![empty.clone(), sums(8.0, 4.0, 8.0), empty.clone()])).unwrap();
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].centroid.as_slice(), found[0].count), (&[1.0, 1.0][..], 8.0));
        assert_eq!(found[0].effective_rank, 2);
        // No atom at all, and atoms without weight.
        let all = of(vec![empty.clone(), empty.clone(), sums(2.0, 0.0, 0.0)]);
        let found = components(&centroids, &all).unwrap();
        assert_eq!((found.len(), found[0].count, found[0].effective_rank), (1, 2.0, 0));
        assert_eq!((found[0].condition_number, found[0].inverse[0]), (1.0, 1e6));
    }
}
