//! The random projection of a model that has none yet.

use super::random::Random;
use crate::artifact::Projection;

/// Stands for the projection among the words that choose random numbers.
const PROJECTION: u64 = u64::MAX;

/// The paper's projection (Methods: Latent features and uncertainty models) of a basis of `rows` invariants: R ~
/// N(0, 1)/√d, d = `columns`, for the normalised basis, with the logarithmic norms of the whole basis and of its
/// `blocks`. It depends on random seed and shape only.
///
/// Normal numbers are those of Box & Muller, Ann. Math. Stat. 29, 610 (1958).
pub fn random_projection(seed: u64, rows: usize, columns: usize, blocks: usize) -> Projection {
    let mut random = Random::new(&[seed, PROJECTION]);
    let scale = 1.0 / (columns as f64).sqrt();
    let mut matrix = Vec::with_capacity(rows * columns + 1);
    while matrix.len() < rows * columns {
        let radius = scale * (-2.0 * (1.0 - random.uniform()).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * random.uniform()).sin_cos();
        matrix.extend([(radius * cos) as f32, (radius * sin) as f32]);
    }
    matrix.truncate(rows * columns);
    Projection {
        matrix,
        rows,
        columns,
        feature_dimension: columns + 1 + blocks,
        asinh: false,
        normalised: true,
        density_channels: true,
        density_scale: 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_normal_and_independent() {
        let (rows, columns) = (401, 125);
        let matrix = random_projection(42, rows, columns, 1).matrix;
        assert_eq!(matrix.len(), rows * columns);
        let numbers: Vec<f64> = matrix.iter().map(|x| f64::from(*x) * (columns as f64).sqrt()).collect();
        // Five standard deviations of the means of x, x², x⁴ and x x′ over independent normal numbers.
        let n = numbers.len() as f64;
        let mean = |f: &dyn Fn(f64) -> f64| numbers.iter().map(|x| f(*x)).sum::<f64>() / n;
        for (found, expected, variance) in
            [(mean(&|x| x), 0.0, 1.0), (mean(&|x| x * x), 1.0, 2.0), (mean(&|x| x.powi(4)), 3.0, 96.0)]
        {
            assert!((found - expected).abs() < 5.0 * f64::sqrt(variance / n), "{found} {expected}");
        }
        for lag in [1, 2, columns] {
            let product: f64 = numbers.iter().zip(&numbers[lag..]).map(|(a, b)| a * b).sum();
            assert!(product.abs() < 5.0 * n.sqrt(), "{lag} {product}");
        }
        // The share within one standard deviation.
        let inside = numbers.iter().filter(|x| x.abs() < 1.0).count() as f64 / n;
        assert!((inside - 0.682_689).abs() < 5.0 * (0.682_689 * 0.317_311 / n).sqrt(), "{inside}");
    }

    #[test]
    fn it_depends_on_seed_and_shape() {
        let one = random_projection(1, 9, 5, 2);
        assert_eq!(one, random_projection(1, 9, 5, 2));
        assert_eq!((one.matrix.len(), one.feature_dimension), (45, 8));
        assert_ne!(one.matrix, random_projection(2, 9, 5, 2).matrix);
    }
}
