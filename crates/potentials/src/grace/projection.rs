//! The CALM feature z: the invariant basis, normalised, projected, with its norms.

use super::instructions::Instructions;
use super::matrix::{LANES, Lanes, Matrix, Rows, ZERO, add_product, horizontal_sum, scaled};
use super::weights::with_transpose;

/// ε_0 of the paper (Methods, "Latent features and uncertainty models").
const NORM_FLOOR: f64 = 1e-12;

/// Keeps the norm's derivative finite at B = 0.
const SQUARE_FLOOR: f64 = 1e-30;

/// The feature map of a model: z = (T(B̂ R), s log(‖B‖ + ε_0), s log(‖B_1‖ + ε_0), …) with
/// B̂ = B / (‖B‖ + ε_0), ‖B‖ = √(Σ B² + 10⁻³⁰) and ε_0 = 10⁻¹².
#[derive(Clone, Debug)]
pub struct Projection {
    /// R as stored, row-major [D_basis, d].
    pub matrix: Vec<f32>,
    /// d, the number of projected features.
    pub dimension: usize,
    /// Whether B is divided by its norm.
    pub normalize: bool,
    /// Whether the logarithms of the norms are appended.
    pub density_channels: bool,
    /// s
    pub density_scale: f32,
    /// Whether T is asinh (identity otherwise).
    pub asinh: bool,
    /// The layers in the order of their norms in z.
    pub(super) blocks: Vec<usize>,
    /// Of the basis of each layer.
    pub(super) maps: Vec<ProjectionMaps>,
}

/// The rows of R for the basis of one layer, and their transpose.
#[derive(Clone, Debug)]
pub(super) struct ProjectionMaps {
    forward: Matrix,
    transposed: Matrix,
}

impl ProjectionMaps {
    /// `row_of` gives the row of R for each place of the layer's padded basis, none for padding.
    pub fn new(matrix: &[f32], dimension: usize, row_of: &[Option<usize>]) -> Self {
        let element = |place: usize, column: usize| {
            row_of[place].map_or(0.0, |row| f64::from(matrix[row * dimension + column]))
        };
        let (forward, transposed) = with_transpose(row_of.len(), dimension, element);
        Self { forward, transposed }
    }
}

/// What the reverse sweep needs of the forward one, for all atoms in the order of evaluation.
#[derive(Clone, Debug, Default)]
pub(super) struct ProjectionWork {
    /// B̂ R before T, [n, lanes of d].
    projected: Vec<Lanes>,
    /// ‖B‖ and ‖B_k‖ of each layer, [n, 1 + layers].
    norms: Vec<f64>,
}

impl Projection {
    /// D, the dimension of z.
    pub fn feature_dimension(&self) -> usize {
        self.dimension + if self.density_channels { self.n_norms() } else { 0 }
    }

    /// That of the whole basis and that of each block.
    fn n_norms(&self) -> usize {
        1 + self.blocks.len()
    }

    /// Everything that distinguishes this map from another, as bytes: two models with equal bytes give
    /// features that one mixture can grade.
    pub fn fingerprint(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(4 * self.matrix.len() + 24);
        bytes.extend((self.dimension as u64).to_le_bytes());
        bytes.extend([self.normalize, self.density_channels, self.asinh].map(u8::from));
        bytes.extend(self.density_scale.to_le_bytes());
        bytes.extend(self.matrix.iter().flat_map(|x| x.to_le_bytes()));
        bytes
    }

    /// z of atoms into `features` [n, D] from the bases of each layer, [n, lanes] in the given order of the atoms.
    #[inline(always)]
    pub(super) fn forward<'a>(
        &self,
        order: &[u32],
        bases: impl Iterator<Item = &'a [Lanes]>,
        features: &mut Vec<f64>,
        work: &mut ProjectionWork,
        instructions: Instructions,
    ) {
        let (n, lanes, width) = (order.len(), self.lanes(), self.feature_dimension());
        work.norms.clear();
        work.norms.resize(n * self.n_norms(), SQUARE_FLOOR);
        work.projected.clear();
        work.projected.resize(n * lanes, ZERO);
        for (layer, (maps, bases)) in self.maps.iter().zip(bases).enumerate() {
            let of_atom = maps.forward.input_lanes();
            for (norms, basis) in work.norms.chunks_exact_mut(self.n_norms()).zip(bases.chunks_exact(of_atom))
            {
                let square = dot(basis, basis);
                norms[0] += square;
                norms[layer + 1] += square;
            }
            let (from, to) = (Rows::of_atoms(n, of_atom), Rows::of_atoms(n, lanes));
            maps.forward.multiply_add(bases, from, &mut work.projected, to, instructions);
        }
        work.norms.iter_mut().for_each(|square| *square = square.sqrt());
        features.clear();
        features.resize(n * width, 0.0);
        let rows = work.projected.chunks_exact_mut(lanes).zip(work.norms.chunks_exact(self.n_norms()));
        for (atom, (projected, norms)) in order.iter().zip(rows) {
            let z = &mut features[*atom as usize * width..][..width];
            let scale = if self.normalize { 1.0 / (norms[0] + NORM_FLOOR) } else { 1.0 };
            let projected = &mut projected.as_flattened_mut()[..self.dimension];
            for (z, p) in z.iter_mut().zip(projected) {
                *p *= scale;
                *z = if self.asinh { p.asinh() } else { *p };
            }
            let norms = std::iter::once(norms[0]).chain(self.blocks.iter().map(|layer| norms[layer + 1]));
            for (z, norm) in z[self.dimension..].iter_mut().zip(norms) {
                *z = f64::from(self.density_scale) * (norm + NORM_FLOOR).ln();
            }
        }
    }

    /// The cotangents of the bases of each layer, [n, lanes] in the given order of the atoms, from that of z, [n, D].
    /// `layers` gives each layer's bases and where to write.
    ///
    /// B̄ = R p̄/(N + ε_0) + \[L̄/(N + ε_0) − (p̄ · p)/(N + ε_0)\] B/N with p = B̂ R, and in block k besides
    /// L̄_k/(N_k + ε_0) B/N_k.
    #[inline(always)]
    pub(super) fn backward<'a>(
        &self,
        order: &[u32],
        layers: impl Iterator<Item = (&'a [Lanes], &'a mut Vec<Lanes>)>,
        feature_cotangent: &[f64],
        work: &mut ProjectionWork,
        instructions: Instructions,
    ) {
        let (n, lanes, width) = (order.len(), self.lanes(), self.feature_dimension());
        let rows = work.projected.chunks_exact_mut(lanes).zip(work.norms.chunks_exact_mut(self.n_norms()));
        for (atom, (projected, norms)) in order.iter().zip(rows) {
            let (of_projected, of_norms) =
                feature_cotangent[*atom as usize * width..][..width].split_at(self.dimension);
            let inverse = 1.0 / (norms[0] + NORM_FLOOR);
            let (scale, mut along) = (if self.normalize { inverse } else { 1.0 }, 0.0);
            for (c, p) in of_projected.iter().zip(projected.as_flattened_mut()) {
                let cotangent = if self.asinh { c / (1.0 + *p * *p).sqrt() } else { *c };
                along += cotangent * *p;
                *p = scale * cotangent;
            }
            self.norm_cotangents(norms, if self.normalize { along } else { 0.0 }, of_norms);
        }
        for (layer, (maps, (bases, out))) in self.maps.iter().zip(layers).enumerate() {
            let of_atom = maps.forward.input_lanes();
            out.clear();
            for (basis, factors) in bases.chunks_exact(of_atom).zip(work.norms.chunks_exact(self.n_norms())) {
                out.extend(basis.iter().map(|b| scaled(factors[0] + factors[layer + 1], b)));
            }
            let (from, to) = (Rows::of_atoms(n, lanes), Rows::of_atoms(n, of_atom));
            maps.transposed.multiply_add(&work.projected, from, out, to, instructions);
        }
    }

    /// Puts in place of ‖B‖ and ‖B_k‖ the factors of B in its cotangent, the first for all layers.
    #[inline(always)]
    fn norm_cotangents(&self, norms: &mut [f64], along: f64, of_norms: &[f64]) {
        let (scale, density) = (f64::from(self.density_scale), |k: usize| of_norms.get(k).copied());
        let factor = |norm: f64, cotangent: f64| cotangent / (norm + NORM_FLOOR) / norm;
        for (k, layer) in self.blocks.iter().enumerate() {
            norms[layer + 1] = factor(norms[layer + 1], scale * density(k + 1).unwrap_or(0.0));
        }
        norms[0] = factor(norms[0], scale * density(0).unwrap_or(0.0) - along);
    }

    /// Lanes of B̂ R.
    fn lanes(&self) -> usize {
        self.maps.first().map_or(0, |maps| maps.forward.output_lanes())
    }
}

#[inline(always)]
fn dot(a: &[Lanes], b: &[Lanes]) -> f64 {
    let mut sum = ZERO;
    for (a, b) in a.iter().zip(b) {
        add_product(&mut sum, a, b);
    }
    horizontal_sum(&sum)
}

/// Components and channels of the sources of one layer's basis.
pub(super) type Sources = [(usize, usize)];

/// The row of R for each place of the padded basis of one layer, whose first row is `first`: sources one after
/// another, the file channel-major (row n · components + c), the evaluation \[component\]\[padded channel\].
pub(super) fn rows_of_projection(mut first: usize, sources: &Sources) -> Vec<Option<usize>> {
    let mut rows = Vec::new();
    for (components, channels) in sources {
        let padded = channels.next_multiple_of(LANES);
        for c in 0..*components {
            rows.extend((0..padded).map(|n| (n < *channels).then_some(first + n * components + c)));
        }
        first += components * channels;
    }
    rows
}
