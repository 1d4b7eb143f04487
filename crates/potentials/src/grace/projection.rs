//! The CALM feature z: the invariant basis, normalised, projected, with its norms.

use std::ops::Range;

use super::matrix::{LANES, Lanes, Matrix, ZERO, add_product, horizontal_sum};
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
    /// The lanes of the basis of each layer, in the order of their norms in z.
    pub(super) blocks: Vec<Range<usize>>,
    pub(super) maps: ProjectionMaps,
}

/// R and its transpose for the basis in the order of evaluation.
#[derive(Clone, Debug)]
pub(super) struct ProjectionMaps {
    forward: Matrix,
    transposed: Matrix,
}

impl ProjectionMaps {
    /// `row_of` gives the row of R for each place of the padded basis, none for padding.
    pub fn new(matrix: &[f32], dimension: usize, row_of: &[Option<usize>]) -> Self {
        let element = |place: usize, column: usize| {
            row_of[place].map_or(0.0, |row| f64::from(matrix[row * dimension + column]))
        };
        let (forward, transposed) = with_transpose(row_of.len(), dimension, element);
        Self { forward, transposed }
    }
}

/// What the reverse sweep needs of the forward one, for all atoms.
#[derive(Clone, Debug, Default)]
pub(super) struct ProjectionWork {
    /// B̂ R before T, [n, lanes of d].
    projected: Vec<Lanes>,
    /// ‖B‖, ‖B_1‖, …, [n, 1 + blocks].
    norms: Vec<f64>,
    basis_offsets: Vec<u32>,
    projected_offsets: Vec<u32>,
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

    /// z of `n` atoms into `features` [n, D] from their bases [n, lanes].
    #[inline(always)]
    pub(super) fn forward(
        &self,
        n: usize,
        basis: &[Lanes],
        features: &mut Vec<f64>,
        work: &mut ProjectionWork,
    ) {
        let (basis_lanes, lanes, width) = self.lanes(n, basis);
        work.norms.clear();
        work.basis_offsets.clear();
        work.projected_offsets.clear();
        for (i, basis) in basis.chunks_exact(basis_lanes).enumerate() {
            work.norms.push(norm(basis));
            work.norms.extend(self.blocks.iter().map(|block| norm(&basis[block.clone()])));
            work.basis_offsets.push((i * basis_lanes) as u32);
            work.projected_offsets.push((i * lanes) as u32);
        }
        work.projected.clear();
        work.projected.resize(n * lanes, ZERO);
        self.maps.forward.multiply_add(
            basis,
            &work.basis_offsets,
            &mut work.projected,
            &work.projected_offsets,
        );
        features.clear();
        features.resize(n * width, 0.0);
        let norms = work.norms.chunks_exact(self.n_norms());
        for ((z, projected), norms) in
            features.chunks_exact_mut(width).zip(work.projected.chunks_exact_mut(lanes)).zip(norms)
        {
            let scale = if self.normalize { 1.0 / (norms[0] + NORM_FLOOR) } else { 1.0 };
            let projected = &mut projected.as_flattened_mut()[..self.dimension];
            for (z, p) in z.iter_mut().zip(projected) {
                *p *= scale;
                *z = if self.asinh { p.asinh() } else { *p };
            }
            for (z, norm) in z[self.dimension..].iter_mut().zip(norms) {
                *z = f64::from(self.density_scale) * (norm + NORM_FLOOR).ln();
            }
        }
    }

    /// The cotangent of the bases, [n, lanes], from that of z, [n, D].
    #[inline(always)]
    pub(super) fn backward(
        &self,
        n: usize,
        basis: &[Lanes],
        feature_cotangent: &[f64],
        basis_cotangent: &mut Vec<Lanes>,
        work: &mut ProjectionWork,
    ) {
        let (basis_lanes, lanes, width) = self.lanes(n, basis);
        for (cotangent, projected) in
            feature_cotangent.chunks_exact(width).zip(work.projected.chunks_exact_mut(lanes))
        {
            for (c, p) in cotangent[..self.dimension].iter().zip(projected.as_flattened_mut()) {
                *p = if self.asinh { c / (1.0 + *p * *p).sqrt() } else { *c };
            }
        }
        basis_cotangent.clear();
        basis_cotangent.resize(n * basis_lanes, ZERO);
        self.maps.transposed.multiply_add(
            &work.projected,
            &work.projected_offsets,
            basis_cotangent,
            &work.basis_offsets,
        );
        let norms = work.norms.chunks_exact(self.n_norms());
        let cotangents = feature_cotangent.chunks_exact(width).zip(norms);
        for ((basis, out), (cotangent, norms)) in
            basis.chunks_exact(basis_lanes).zip(basis_cotangent.chunks_exact_mut(basis_lanes)).zip(cotangents)
        {
            self.through_norms(norms, &cotangent[self.dimension..], basis, out);
        }
    }

    /// From the cotangent of B̂ (in `out`) and those of log(‖B‖ + ε_0) and log(‖B_1‖ + ε_0), … to that of B:
    /// B̄ = B̂̄/(N + ε_0) + \[L̄/(N + ε_0) − (B̂̄ · B)/(N + ε_0)²\] B/N, and in block k L̄_k/(N_k + ε_0) B/N_k.
    #[inline(always)]
    fn through_norms(&self, norms: &[f64], log_cotangents: &[f64], basis: &[Lanes], out: &mut [Lanes]) {
        let log_cotangent = |k: usize| {
            log_cotangents.get(k).map_or(0.0, |c| f64::from(self.density_scale) * c) / (norms[k] + NORM_FLOOR)
        };
        let inverse = 1.0 / (norms[0] + NORM_FLOOR);
        let (mut scale, mut along) = (1.0, log_cotangent(0));
        if self.normalize {
            along -= dot(out, basis) * inverse * inverse;
            scale = inverse;
        }
        for (k, block) in self.blocks.iter().enumerate() {
            let factor = along / norms[0] + log_cotangent(k + 1) / norms[k + 1];
            let (out, basis) = (&mut out[block.clone()], &basis[block.clone()]);
            for (out, b) in out.as_flattened_mut().iter_mut().zip(basis.as_flattened()) {
                *out = scale * *out + factor * b;
            }
        }
    }

    fn lanes(&self, n: usize, basis: &[Lanes]) -> (usize, usize, usize) {
        (basis.len() / n.max(1), self.maps.forward.output_lanes(), self.feature_dimension())
    }
}

/// √(Σ B² + 10⁻³⁰)
#[inline(always)]
fn norm(basis: &[Lanes]) -> f64 {
    (dot(basis, basis) + SQUARE_FLOOR).sqrt()
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
