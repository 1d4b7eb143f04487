//! Kernel density estimates on a grid: Gaussian kernels with Scott's bandwidth (1992).

use crate::quantiles::quantile;

/// The kernel is cut off at this number of bandwidths.
const KERNEL_RADIUS: f64 = 4.0;
/// Lower limit of the bandwidth, as a fraction of the range.
const MIN_RELATIVE_WIDTH: f64 = 1e-3;

/// The density of values on `points` grid points from `low` to `high`, as pairs (x, density). Its integral is
/// the fraction of values in the range. Empty for fewer than two values.
pub fn kernel_density(values: &[f64], low: f64, high: f64, points: usize) -> Vec<(f64, f64)> {
    let Some(width) = width(values, 1, high - low).filter(|_| points > 1 && low < high) else {
        return Vec::new();
    };
    let step = (high - low) / (points - 1) as f64;
    let mut weights = vec![0.0; points];
    for value in values {
        for (place, part) in linear_weights((value - low) / step, points) {
            weights[place] += part;
        }
    }
    let smooth = convolved(&weights, width / step);
    let scale = 1.0 / (step * values.len() as f64);
    smooth.iter().enumerate().map(|(k, weight)| (low + step * k as f64, weight * scale)).collect()
}

/// The density of points in a plane, on a grid that extends beyond them.
#[derive(Clone, Debug)]
pub struct Density2d {
    low: [f64; 2],
    step: [f64; 2],
    size: usize,
    /// Row by row in the second coordinate, [size × size].
    values: Vec<f64>,
}

impl Density2d {
    /// Estimates the density on a grid of `size` × `size` points. `None` for fewer than three points, or if
    /// they lie on a line parallel to an axis.
    pub fn from_points(points: &[[f64; 2]], size: usize) -> Option<Self> {
        if points.len() < 3 || size < 8 {
            return None;
        }
        let (mut low, mut step, mut widths) = ([0.0; 2], [0.0; 2], [0.0; 2]);
        for axis in 0..2 {
            let values: Vec<_> = points.iter().map(|point| point[axis]).collect();
            let (least, largest) = range(&values)?;
            let width = width(&values, 2, largest - least).filter(|_| least < largest)?;
            low[axis] = least - KERNEL_RADIUS * width;
            step[axis] = (largest + KERNEL_RADIUS * width - low[axis]) / (size - 1) as f64;
            widths[axis] = width / step[axis];
        }
        let mut values = vec![0.0; size * size];
        for [x, y] in points {
            for (row, below) in linear_weights((y - low[1]) / step[1], size) {
                for (column, part) in linear_weights((x - low[0]) / step[0], size) {
                    values[row * size + column] += below * part / points.len() as f64;
                }
            }
        }
        let along = |values: &[f64], width: f64| -> Vec<f64> {
            values.chunks_exact(size).flat_map(|row| convolved(row, width)).collect()
        };
        let values = transposed(&along(&values, widths[0]), size);
        let values = transposed(&along(&values, widths[1]), size);
        Some(Self { low, step, size, values })
    }

    /// The density at a point, interpolated linearly; 0 outside the grid. In points per grid cell.
    pub fn at(&self, [x, y]: [f64; 2]) -> f64 {
        let place =
            |value: f64, axis: usize| linear_weights((value - self.low[axis]) / self.step[axis], self.size);
        let mut sum = 0.0;
        for (row, below) in place(y, 1) {
            sum += place(x, 0)
                .map(|(column, part)| below * part * self.values[row * self.size + column])
                .sum::<f64>();
        }
        sum
    }

    /// The density above which this fraction of the points lies: it bounds the smallest region that contains
    /// them.
    pub fn level(&self, points: &[[f64; 2]], share: f64) -> Option<f64> {
        let mut densities: Vec<_> = points.iter().map(|point| self.at(*point)).collect();
        densities.sort_by(f64::total_cmp);
        quantile(&densities, 1.0 - share)
    }

    /// Grid points per side.
    pub fn size(&self) -> usize {
        self.size
    }

    /// The density at a grid point.
    pub fn value(&self, column: usize, row: usize) -> f64 {
        self.values[row * self.size + column]
    }

    /// The coordinates of a grid point, also at fractional indices.
    pub fn point(&self, column: f64, row: f64) -> [f64; 2] {
        [self.low[0] + self.step[0] * column, self.low[1] + self.step[1] * row]
    }
}

/// Scott's bandwidth in `dimensions` dimensions, σ n^(−1/(d + 4)). σ is the standard deviation, or the estimate
/// from the quartiles if that is smaller. At least a fixed fraction of `range`. `None` for fewer than two
/// values.
fn width(values: &[f64], dimensions: i32, range: f64) -> Option<f64> {
    if values.len() < 2 {
        return None;
    }
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let deviation = (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
    let mut ascending = values.to_vec();
    ascending.sort_by(f64::total_cmp);
    let quartiles = quantile(&ascending, 0.75)? - quantile(&ascending, 0.25)?;
    let spread = if quartiles > 0.0 { deviation.min(quartiles / 1.349) } else { deviation };
    let width = spread * n.powf(-1.0 / f64::from(dimensions + 4));
    Some(width.max(MIN_RELATIVE_WIDTH * range)).filter(|width| width.is_finite() && *width > 0.0)
}

fn range(values: &[f64]) -> Option<(f64, f64)> {
    let least = values.iter().copied().reduce(f64::min)?;
    let largest = values.iter().copied().reduce(f64::max)?;
    (least.is_finite() && largest.is_finite()).then_some((least, largest))
}

/// The two grid points next to a position with their weights; none outside the grid.
fn linear_weights(position: f64, size: usize) -> impl Iterator<Item = (usize, f64)> {
    let is_inside = position >= 0.0 && position <= (size - 1) as f64;
    let below = if is_inside { (position.floor() as usize).min(size - 2) } else { 0 };
    let part = position - below as f64;
    [(below, 1.0 - part), (below + 1, part)].into_iter().filter(move |_| is_inside)
}

/// A row convolved with a Gaussian; `width` is in grid steps.
fn convolved(row: &[f64], width: f64) -> Vec<f64> {
    let reach = (KERNEL_RADIUS * width).ceil() as usize;
    let kernel: Vec<_> = (0..=reach).map(|k| (-0.5 * (k as f64 / width).powi(2)).exp()).collect();
    let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f64>();
    let mut smooth = vec![0.0; row.len()];
    for (k, weight) in row.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
        let (first, last) = (k.saturating_sub(reach), (k + reach).min(row.len() - 1));
        for (place, sum_here) in smooth.iter_mut().enumerate().take(last + 1).skip(first) {
            *sum_here += weight * kernel[place.abs_diff(k)] / sum;
        }
    }
    smooth
}

fn transposed(values: &[f64], size: usize) -> Vec<f64> {
    (0..size * size).map(|k| values[(k % size) * size + k / size]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Approximate quantiles of a normal sample (Tukey's λ with 0.1349).
    fn normal(n: usize) -> impl Iterator<Item = f64> {
        (0..n).map(move |k| {
            let p = (k as f64 + 0.5) / n as f64;
            (p.powf(0.1349) - (1.0 - p).powf(0.1349)) / 0.1975
        })
    }

    #[test]
    fn a_normal_sample_has_a_normal_density() {
        let values: Vec<_> = normal(20_000).collect();
        let density = kernel_density(&values, -5.0, 5.0, 401);
        let integral: f64 = density.iter().map(|(_, density)| density * 10.0 / 400.0).sum();
        assert!((integral - 1.0).abs() < 2e-3, "{integral}");
        // The kernel raises the variance by 1 + n^(−2/5); Tukey's λ deviates by a percent or two.
        let middle = density[200].1;
        assert!((middle - 0.3989).abs() < 0.012, "{middle}");
        assert!((density[160].1 / middle - (-0.5_f64).exp()).abs() < 0.02);
    }

    #[test]
    fn nothing_has_no_density() {
        assert!(
            kernel_density(&[1.0], 0.0, 2.0, 10).is_empty()
                && kernel_density(&[1.0, 1.5], 2.0, 0.0, 10).is_empty()
        );
        assert!(Density2d::from_points(&[[0.0, 0.0], [1.0, 1.0]], 64).is_none());
        assert!(Density2d::from_points(&[[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]], 64).is_none());
    }

    #[test]
    fn the_level_leaves_so_many_inside() {
        let points: Vec<_> = normal(60).flat_map(|x| normal(60).map(move |y| [3.0 * x, y])).collect();
        let plane = Density2d::from_points(&points, 96).unwrap();
        let level = plane.level(&points, 0.95).unwrap();
        let inside = points.iter().filter(|point| plane.at(**point) >= level).count() as f64;
        assert!((inside / points.len() as f64 - 0.95).abs() < 0.002, "{inside}");
        // For a normal distribution this is the ellipse at √(−2 ln 0.05) = 2.448 standard deviations.
        assert!(plane.at([3.0 * 2.1, 0.0]) > level && plane.at([3.0 * 2.8, 0.0]) < level);
        assert!(plane.at([0.0, 2.1]) > level && plane.at([0.0, 2.8]) < level);
        let sum: f64 = (0..96 * 96).map(|k| plane.value(k % 96, k / 96)).sum();
        assert!((sum - 1.0).abs() < 1e-3, "{sum}");
    }
}
