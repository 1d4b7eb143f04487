//! Negative logarithm of the mixture's density: the Gaussian mixture without the calibration by θ.
//!
//! −log Σ_k π_k N(**z**; **μ**_k, C_k + εI) over the components of the element, with π_k = n_k / Σ n. The quadratic form uses
//! the stored inverse, as σ does.

use super::error::{BaselineError, check_element};
use super::groups::for_each_group;
use crate::linear::{
    LinearError, VECTORS_PER_PASS, cholesky, dot, eigenvalues, regularised, symmetric_products, view,
};
use crate::mixture::Mixture;

/// The Gaussians of each element.
#[derive(Debug, Clone, PartialEq)]
pub struct Likelihood {
    pub(super) dimension: usize,
    pub(super) elements: Vec<Vec<Gaussian>>,
}

/// A component with atoms.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Gaussian {
    pub centroid: Vec<f64>,
    /// `[D × D]`
    pub inverse: Vec<f64>,
    /// log π − ½ log det(C + εI) − (D/2) log 2π
    pub constant: f64,
}

impl Likelihood {
    pub(super) fn new(mixture: &Mixture) -> Result<Self, BaselineError> {
        let dimension = mixture.dimension();
        let mut elements = vec![Vec::new(); mixture.element_count()];
        let mut totals = vec![0.0; mixture.element_count()];
        for (element, _, component) in mixture.iter() {
            totals[element] += component.statistics().ok_or(BaselineError::NoStatistics)?.effective_count;
        }
        for (element, _, component) in mixture.iter() {
            let statistics = component.statistics().ok_or(BaselineError::NoStatistics)?;
            if statistics.effective_count <= 0.0 {
                continue;
            }
            let share = statistics.effective_count / totals[element];
            let determinant = log_determinant(&statistics.covariance(), dimension)?;
            let circle = dimension as f64 * std::f64::consts::TAU.ln();
            elements[element].push(Gaussian {
                centroid: component.centroid().to_vec(),
                inverse: component.inverse().to_vec(),
                constant: share.ln() - 0.5 * (determinant + circle),
            });
        }
        Ok(Self { dimension, elements })
    }

    /// D
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    pub(super) fn score(&self, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, BaselineError> {
        for (atom, &element) in elements.iter().enumerate() {
            check_element(atom, element, self.elements.len())?;
        }
        let mut scores = vec![f64::INFINITY; elements.len()];
        for_each_group(elements, self.dimension, features, |element, atoms, rows| {
            let mut logarithms = vec![Vec::new(); atoms.len()];
            for gaussian in &self.elements[element] {
                let found = gaussian.log_density(rows);
                logarithms.iter_mut().zip(found).for_each(|(all, one)| all.push(one));
            }
            for (atom, found) in atoms.iter().zip(&logarithms) {
                scores[*atom] = -log_sum_exp(found);
            }
        });
        Ok(scores)
    }
}

impl Gaussian {
    /// log π N of each row, `[n × D]`.
    fn log_density(&self, rows: &[f64]) -> Vec<f64> {
        let dimension = self.centroid.len();
        let (mut out, mut product) = (Vec::new(), Vec::new());
        for rows in rows.chunks(VECTORS_PER_PASS * dimension) {
            let mut deltas = rows.to_vec();
            super::groups::subtract(&mut deltas, &self.centroid);
            product.resize(deltas.len(), 0.0);
            symmetric_products(&self.inverse, dimension, &deltas, &mut product);
            let pairs = deltas.chunks_exact(dimension).zip(product.chunks_exact(dimension));
            out.extend(pairs.map(|(delta, product)| self.constant - 0.5 * dot(delta, product)));
        }
        out
    }
}

/// log Σ exp; −∞ for none.
fn log_sum_exp(logarithms: &[f64]) -> f64 {
    let largest = logarithms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if largest == f64::NEG_INFINITY {
        return largest;
    }
    largest + logarithms.iter().map(|x| (x - largest).exp()).sum::<f64>().ln()
}

/// log det(C + εI).
fn log_determinant(covariance: &[f64], dimension: usize) -> Result<f64, LinearError> {
    let matrix = regularised(covariance, dimension);
    if let Some(factor) = cholesky(&matrix, dimension) {
        return Ok(2.0 * (0..dimension).map(|k| factor[(k, k)].ln()).sum::<f64>());
    }
    // Rounding made C indefinite: what is below ε counts as ε.
    let values = eigenvalues(view(&matrix, dimension, dimension))?;
    Ok(values.iter().map(|value| value.max(crate::linear::REGULARISATION).ln()).sum())
}
