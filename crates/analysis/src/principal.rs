//! Principal component analysis.

use faer::{Mat, MatRef, Side};

/// Relative squared deviation from the mean below which rows differ only by rounding.
const ROUNDING: f64 = 1e-24;

/// Mean and leading principal axes of rows of `dimension` numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct PrincipalAxes {
    mean: Vec<f64>,
    /// Unit vectors, by descending variance.
    axes: Vec<Vec<f64>>,
    /// Fraction of the total variance along each axis.
    pub shares: Vec<f64>,
}

impl PrincipalAxes {
    /// Finds the first `number` axes, the eigenvectors of the covariance of rows stored consecutively in
    /// `rows`. The largest component of each axis is positive, so that the result is reproducible. `None` for
    /// fewer than two rows, identical rows, numbers that are not finite, or eigenvalues that do not converge.
    pub fn fit(rows: &[f64], dimension: usize, number: usize) -> Option<Self> {
        let count = rows.len().checked_div(dimension)?;
        if count < 2 || number > dimension || !rows.iter().all(|x| x.is_finite()) {
            return None;
        }
        let (mean, scatter) = mean_and_scatter(rows, dimension);
        let size = count as f64 * mean.iter().map(|x| x * x).sum::<f64>();
        Self::of_covariance(mean, scatter.as_ref(), size, number)
    }

    /// The first `number` axes of data with this mean and this symmetric covariance, `[dimension × dimension]`, such as
    /// those of a mixture. `None` if the covariance is zero or of another size, for numbers that are not finite, or eigenvalues that
    /// do not converge.
    pub fn from_covariance(mean: Vec<f64>, covariance: &[f64], number: usize) -> Option<Self> {
        let dimension = mean.len();
        let is_finite = mean.iter().chain(covariance).all(|x| x.is_finite());
        if covariance.len() != dimension * dimension || number > dimension || !is_finite {
            return None;
        }
        let covariance = MatRef::from_row_major_slice(covariance, dimension, dimension);
        let size = mean.iter().map(|x| x * x).sum();
        Self::of_covariance(mean, covariance, size, number)
    }

    /// `size` is the square of the mean in the unit of the covariance.
    fn of_covariance(mean: Vec<f64>, covariance: MatRef<'_, f64>, size: f64, number: usize) -> Option<Self> {
        let dimension = mean.len();
        let eigen = covariance.self_adjoint_eigen(Side::Lower).ok()?;
        let (values, vectors) = (eigen.S(), eigen.U());
        let trace: f64 = (0..dimension).map(|k| values[k].max(0.0)).sum();
        if trace <= ROUNDING * size {
            return None;
        }
        // Eigenvalues ascend.
        let last = (0..number).map(|k| dimension - 1 - k);
        let axes = last
            .clone()
            .map(|column| with_fixed_sign((0..dimension).map(|k| vectors[(k, column)]).collect()));
        let shares = last.clone().map(|column| values[column].max(0.0) / trace);
        Some(Self { axes: axes.collect(), shares: shares.collect(), mean })
    }

    /// The covariance C in the space of the axes, `[number × number]`: aᵀCb of each two axes a, b.
    ///
    /// # Panics
    /// If the covariance has another size than that of the axes.
    pub fn project_covariance(&self, covariance: &[f64]) -> Vec<f64> {
        let dimension = self.mean.len();
        assert_eq!(covariance.len(), dimension * dimension, "a covariance of the same dimension");
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let times = |axis: &Vec<f64>| -> Vec<f64> {
            covariance.chunks_exact(dimension).map(|row| dot(row, axis)).collect()
        };
        let products: Vec<_> = self.axes.iter().map(times).collect();
        self.axes.iter().flat_map(|a| products.iter().map(move |product| dot(a, product))).collect()
    }

    /// Components of a row along the axes, relative to the mean.
    pub fn project(&self, row: &[f64]) -> Vec<f64> {
        let along = |axis: &Vec<f64>| {
            let parts = axis.iter().zip(row).zip(&self.mean);
            parts.map(|((axis, x), mean)| axis * (x - mean)).sum()
        };
        self.axes.iter().map(along).collect()
    }
}

/// Mean and covariance of rows of `dimension` finite numbers, `[D]` and `[D × D]`. `None` without rows.
pub fn row_moments(rows: &[f64], dimension: usize) -> Option<(Vec<f64>, Vec<f64>)> {
    let count = rows.len().checked_div(dimension).filter(|count| *count > 0)?;
    if !rows.iter().all(|x| x.is_finite()) {
        return None;
    }
    let (mean, scatter) = mean_and_scatter(rows, dimension);
    let element = |k: usize| scatter[(k / dimension, k % dimension)] / count as f64;
    Some((mean, (0..dimension * dimension).map(element).collect()))
}

/// The mean of the rows, and the sum of the outer products of their deviations from it.
fn mean_and_scatter(rows: &[f64], dimension: usize) -> (Vec<f64>, Mat<f64>) {
    let count = rows.len() / dimension;
    let mut mean = vec![0.0; dimension];
    for row in rows.chunks_exact(dimension) {
        mean.iter_mut().zip(row).for_each(|(mean, x)| *mean += x / count as f64);
    }
    let centred = Mat::from_fn(count, dimension, |row, k| rows[row * dimension + k] - mean[k]);
    let scatter = centred.transpose() * &centred;
    (mean, scatter)
}

fn with_fixed_sign(mut axis: Vec<f64>) -> Vec<f64> {
    let largest =
        axis.iter().copied().fold(0.0, |largest: f64, x| if x.abs() > largest.abs() { x } else { largest });
    if largest < 0.0 {
        axis.iter_mut().for_each(|x| *x = -*x);
    }
    axis
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_thin_cloud_lies_along_its_axis() {
        // Mean (1, 2, 3); ±3 along (3, 4, 0) / 5 and ±1 along (−4, 3, 0) / 5: variances 9 : 1 : 0.
        let (long, thin) = ([0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]);
        let mut rows = Vec::new();
        for (a, b) in [(3.0, 0.0), (-3.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
            (0..3).for_each(|k| rows.push([1.0, 2.0, 3.0][k] + a * long[k] + b * thin[k]));
        }
        let axes = PrincipalAxes::fit(&rows, 3, 2).unwrap();
        for (found, expected) in axes.shares.iter().zip([0.9, 0.1]) {
            assert!((found - expected).abs() < 1e-12, "{:?}", axes.shares);
        }
        // The second axis points towards growing x.
        let point = axes.project(&[1.0 + 0.6 - 0.8, 2.0 + 0.8 + 0.6, 7.0]);
        assert!((point[0] - 1.0).abs() < 1e-12 && (point[1] + 1.0).abs() < 1e-12, "{point:?}");
    }

    #[test]
    fn a_covariance_has_the_axes_of_its_rows() {
        // Three correlated columns.
        let rows: Vec<_> = (0..40)
            .flat_map(|k| {
                let t = f64::from(k);
                [t, 0.5 * t + (0.7 * t).sin(), 3.0 * (0.3 * t).cos()]
            })
            .collect();
        let mean: Vec<f64> = (0..3).map(|k| rows.iter().skip(k).step_by(3).sum::<f64>() / 40.0).collect();
        let element = |i: usize, j: usize| {
            rows.chunks_exact(3).map(|row| (row[i] - mean[i]) * (row[j] - mean[j])).sum::<f64>() / 40.0
        };
        let covariance: Vec<_> = (0..9).map(|k| element(k / 3, k % 3)).collect();
        let expected = PrincipalAxes::fit(&rows, 3, 2).unwrap();
        let found = PrincipalAxes::from_covariance(mean.clone(), &covariance, 2).unwrap();
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
        assert!(near(&found.shares, &expected.shares), "{found:?} {expected:?}");
        assert!(near(&found.project(&rows[..3]), &expected.project(&rows[..3])));
        // Along its own axes, a covariance is diagonal, with the variances.
        let trace = covariance[0] + covariance[4] + covariance[8];
        let diagonal = [found.shares[0] * trace, 0.0, 0.0, found.shares[1] * trace];
        assert!(near(&found.project_covariance(&covariance), &diagonal));
        let (own_mean, own_covariance) = row_moments(&rows, 3).unwrap();
        assert!(near(&own_mean, &mean) && near(&own_covariance, &covariance), "{own_covariance:?}");
        assert_eq!((row_moments(&[], 3), row_moments(&[1.0, f64::NAN], 2)), (None, None));
        assert_eq!(PrincipalAxes::from_covariance(mean, &[0.0; 9], 2), None, "no variance");
        assert_eq!(PrincipalAxes::from_covariance(vec![0.0; 2], &covariance, 2), None, "another size");
    }

    #[test]
    fn nothing_is_said_of_nothing() {
        assert_eq!(PrincipalAxes::fit(&[], 3, 2), None);
        assert_eq!(PrincipalAxes::fit(&[1.0, 2.0], 2, 2), None, "one row");
        assert_eq!(PrincipalAxes::fit(&[1.0, 2.0, 1.0, 2.0], 2, 2), None, "the same row twice");
        assert_eq!(PrincipalAxes::fit(&[7.1; 40], 2, 2), None, "they differ from their mean by rounding");
        assert_eq!(PrincipalAxes::fit(&[1.0, f64::NAN, 1.0, 2.0], 2, 2), None);
        assert_eq!(PrincipalAxes::fit(&[1.0], 0, 0), None);
    }
}
