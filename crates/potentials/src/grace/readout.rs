//! From the invariant basis of an atom to its energy.

use super::matrix::{Lanes, Matrix, ZERO};

/// Non-linearity of the readout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Activation {
    /// x / (1 + e^−x)
    Silu,
    /// tanh x
    Tanh,
}

impl Activation {
    /// Value and derivative.
    #[inline(always)]
    fn evaluate(self, x: f64) -> (f64, f64) {
        match self {
            Self::Silu => {
                let s = 1.0 / (1.0 + (-x).exp());
                (x * s, s * (1.0 + x * (1.0 - s)))
            }
            Self::Tanh => {
                let t = x.tanh();
                (t, 1.0 - t * t)
            }
        }
    }
}

/// E = s (y_0 + MLP(y_1, y_2, …)) + shift of the element, with the densities y_k = Σ W_kb B_b.
#[derive(Clone, Debug)]
pub(super) struct Readout {
    /// W and its transpose for each element of the central atom (one for all if they do not differ).
    pub densities: Vec<(Matrix, Matrix)>,
    /// Layers of the perceptron with their transposes. The first has an input for y_0 as well, with
    /// weights zero, so that it takes y as it stands.
    pub layers: Vec<(Matrix, Matrix)>,
    /// After every layer but the last.
    pub activation: Activation,
    /// s
    pub scale: f64,
    /// eV, by element
    pub shifts: Vec<f64>,
}

/// Work arrays of [`Readout::evaluate`].
#[derive(Clone, Debug, Default)]
pub(super) struct ReadoutWork {
    /// Values after each layer.
    values: Vec<Vec<Lanes>>,
    /// Derivatives of the activations.
    slopes: Vec<Vec<Lanes>>,
    cotangent: Vec<Lanes>,
    swap: Vec<Lanes>,
}

impl Readout {
    fn of_element(&self, element: usize) -> &(Matrix, Matrix) {
        &self.densities[if self.densities.len() == 1 { 0 } else { element }]
    }

    /// Lanes of the densities y of one atom.
    pub fn density_lanes(&self) -> usize {
        self.densities.first().map_or(0, |(matrix, _)| matrix.output_lanes())
    }

    /// The energy of one atom, eV, and ∂E/∂y into `density_cotangent`.
    #[inline(always)]
    pub fn evaluate(
        &self,
        element: usize,
        basis: &[Lanes],
        density_cotangent: &mut [Lanes],
        work: &mut ReadoutWork,
    ) -> f64 {
        work.values.resize(self.layers.len() + 1, Vec::new());
        work.slopes.resize(self.layers.len(), Vec::new());
        zeros(&mut work.values[0], self.density_lanes());
        self.of_element(element).0.multiply_add_row(basis, &mut work.values[0]);
        for (k, (layer, _)) in self.layers.iter().enumerate() {
            let (before, after) = work.values.split_at_mut(k + 1);
            zeros(&mut after[0], layer.output_lanes());
            layer.multiply_add_row(&before[k], &mut after[0]);
            if k + 1 < self.layers.len() {
                zeros(&mut work.slopes[k], layer.output_lanes());
                let values = after[0].as_flattened_mut().iter_mut();
                for (x, slope) in values.zip(work.slopes[k].as_flattened_mut()) {
                    (*x, *slope) = self.activation.evaluate(*x);
                }
            }
        }
        self.backward(density_cotangent, work);
        let perceptron = if self.layers.is_empty() { 0.0 } else { work.values[self.layers.len()][0][0] };
        self.scale * (work.values[0][0][0] + perceptron) + self.shifts[element]
    }

    #[inline(always)]
    fn backward(&self, density_cotangent: &mut [Lanes], work: &mut ReadoutWork) {
        zeros(&mut work.cotangent, 1);
        work.cotangent[0][0] = self.scale;
        for (k, (_, transposed)) in self.layers.iter().enumerate().rev() {
            if k + 1 < self.layers.len() {
                let cotangent = work.cotangent.as_flattened_mut().iter_mut();
                cotangent.zip(work.slopes[k].as_flattened()).for_each(|(c, slope)| *c *= slope);
            }
            zeros(&mut work.swap, transposed.output_lanes());
            transposed.multiply_add_row(&work.cotangent, &mut work.swap);
            std::mem::swap(&mut work.swap, &mut work.cotangent);
        }
        if self.layers.is_empty() {
            zeros(&mut work.cotangent, self.density_lanes());
        }
        density_cotangent.copy_from_slice(&work.cotangent);
        density_cotangent[0][0] += self.scale;
    }

    /// Adds ∂E/∂B to `basis_cotangent`.
    #[inline(always)]
    pub fn basis_cotangent(
        &self,
        element: usize,
        density_cotangent: &[Lanes],
        basis_cotangent: &mut [Lanes],
    ) {
        self.of_element(element).1.multiply_add_row(density_cotangent, basis_cotangent);
    }
}

#[inline(always)]
fn zeros(lanes: &mut Vec<Lanes>, n: usize) {
    lanes.clear();
    lanes.resize(n, ZERO);
}

/// A matrix and its transpose.
pub(super) fn with_transpose(
    inputs: usize,
    outputs: usize,
    element: impl Fn(usize, usize) -> f64,
) -> (Matrix, Matrix) {
    let transposed = Matrix::from_fn(outputs, inputs, |i, o| element(o, i));
    (Matrix::from_fn(inputs, outputs, element), transposed)
}
