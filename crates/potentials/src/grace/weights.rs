//! Matrices with their transposes, per element of the central atom where they differ.

use super::matrix::Matrix;
use super::vector::Vector;

/// Weights W_kn of a linear map and of its transpose.
#[derive(Clone, Debug)]
pub(super) struct Weights<V>(Vec<(Matrix<V>, Matrix<V>)>);

impl<V: Vector> Weights<V> {
    /// From `element(type, input, output)` for `n_types` elements of the central atom, or for one type that
    /// represents all.
    pub fn new(
        n_types: usize,
        inputs: usize,
        outputs: usize,
        element: impl Fn(usize, usize, usize) -> f64,
    ) -> Self {
        Self((0..n_types).map(|t| with_transpose(inputs, outputs, |i, o| element(t, i, o))).collect())
    }

    /// `[inputs × outputs]`
    #[inline(always)]
    pub fn forward(&self, element: usize) -> &Matrix<V> {
        &self.for_element(element).0
    }

    /// `[outputs × inputs]`
    #[inline(always)]
    pub fn transposed(&self, element: usize) -> &Matrix<V> {
        &self.for_element(element).1
    }

    /// Adds weights of the same shape.
    pub fn add(&mut self, other: &Self) {
        for ((matrix, transposed), other) in self.0.iter_mut().zip(&other.0) {
            matrix.add(&other.0);
            transposed.add(&other.1);
        }
    }

    #[inline(always)]
    fn for_element(&self, element: usize) -> &(Matrix<V>, Matrix<V>) {
        &self.0[if self.0.len() == 1 { 0 } else { element }]
    }
}

/// A matrix and its transpose.
pub(super) fn with_transpose<V: Vector>(
    inputs: usize,
    outputs: usize,
    element: impl Fn(usize, usize) -> f64,
) -> (Matrix<V>, Matrix<V>) {
    let transposed = Matrix::from_fn(outputs, inputs, |i, o| element(o, i));
    (Matrix::from_fn(inputs, outputs, element), transposed)
}
