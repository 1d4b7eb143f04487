//! From the invariant basis of an atom to its energy.

use super::invariant_norm::InvariantNorm;
use super::matrix::{Lanes, Matrix, ZERO};
use super::weights::Weights;

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

/// E = s (y_0 + MLP(y_1, y_2, …)) + shift of the element, with the densities y = Σ over layers of norm(W B), B
/// being the invariants of the layer.
#[derive(Clone, Debug)]
pub(super) struct Readout {
    /// Densities of each layer.
    pub blocks: Vec<Block>,
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

/// The densities that one layer adds.
#[derive(Clone, Debug)]
pub(super) struct Block {
    /// W
    pub weights: Weights,
    /// Left out in models of one layer.
    pub norm: Option<InvariantNorm>,
}

/// Work arrays of [`Readout::evaluate`].
#[derive(Clone, Debug, Default)]
pub(super) struct ReadoutWork {
    /// W B of one layer after another.
    densities: Vec<Lanes>,
    /// Values after each layer of the perceptron, its input first.
    values: Vec<Vec<Lanes>>,
    /// Derivatives of the activations.
    slopes: Vec<Vec<Lanes>>,
    cotangent: Vec<Lanes>,
    swap: Vec<Lanes>,
}

impl Readout {
    /// Lanes of the densities of one layer.
    fn block_lanes(&self) -> usize {
        self.blocks.first().map_or(0, |block| block.weights.forward(0).output_lanes())
    }

    /// Lanes of the densities of all layers of one atom.
    pub fn density_lanes(&self) -> usize {
        self.blocks.len() * self.block_lanes()
    }

    /// The energy of one atom, eV, from its basis, whose lanes `ends` divides into layers, and the derivatives
    /// of the energy with respect to the densities W B of each layer into `density_cotangent`.
    #[inline(always)]
    pub fn evaluate(
        &self,
        element: usize,
        basis: &[Lanes],
        ends: &[usize],
        density_cotangent: &mut [Lanes],
        work: &mut ReadoutWork,
    ) -> f64 {
        work.values.resize(self.layers.len() + 1, Vec::new());
        work.slopes.resize(self.layers.len(), Vec::new());
        self.sum_densities(element, basis, ends, work);
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

    /// y into the first of `work.values`.
    #[inline(always)]
    fn sum_densities(&self, element: usize, basis: &[Lanes], ends: &[usize], work: &mut ReadoutWork) {
        let (lanes, mut start) = (self.block_lanes(), 0);
        zeros(&mut work.densities, self.density_lanes());
        zeros(&mut work.values[0], lanes);
        let densities = work.densities.chunks_exact_mut(lanes.max(1));
        for ((block, end), densities) in self.blocks.iter().zip(ends).zip(densities) {
            block.weights.forward(element).multiply_add_row(&basis[start..*end], densities);
            let sum = work.values[0].as_flattened_mut();
            match &block.norm {
                Some(norm) => norm.forward(densities.as_flattened(), sum),
                None => sum.iter_mut().zip(densities.as_flattened()).for_each(|(sum, y)| *sum += y),
            }
            start = *end;
        }
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
        let lanes = self.block_lanes();
        if self.layers.is_empty() {
            zeros(&mut work.cotangent, lanes);
        }
        work.cotangent[0][0] += self.scale;
        let blocks = density_cotangent.chunks_exact_mut(lanes.max(1)).zip(&self.blocks);
        for ((cotangent, block), densities) in blocks.zip(work.densities.chunks_exact(lanes.max(1))) {
            cotangent.copy_from_slice(&work.cotangent);
            if let Some(norm) = &block.norm {
                norm.backward(densities.as_flattened(), cotangent.as_flattened_mut());
            }
        }
    }

    /// Adds ∂E/∂B of one layer to `basis_cotangent`.
    #[inline(always)]
    pub fn basis_cotangent(
        &self,
        layer: usize,
        element: usize,
        density_cotangent: &[Lanes],
        basis_cotangent: &mut [Lanes],
    ) {
        let lanes = self.block_lanes();
        let cotangent = &density_cotangent[layer * lanes..][..lanes];
        self.blocks[layer].weights.transposed(element).multiply_add_row(cotangent, basis_cotangent);
    }
}

#[inline(always)]
fn zeros(lanes: &mut Vec<Lanes>, n: usize) {
    lanes.clear();
    lanes.resize(n, ZERO);
}
