//! The CALM feature z: the invariant basis, normalised and projected, with its norms.

use std::ops::Range;

use npz::NpzFile;

use super::basis::BasisLayout;
use super::batches::Chunk;
use super::chunked_slices::{ChunkedSlice, PlaceLayout, SplitByChunk};
use super::instructions::Instructions;
use super::matrix::{Factors, Matrix, StridedRows};
use super::vector::{Number, Vector};
use super::weights::with_transpose;

/// ε_0 of the paper (Methods, "Latent features and uncertainty models").
const NORM_FLOOR: f64 = 1e-12;

/// Keeps the norm's derivative finite at B = 0.
const SQUARE_FLOOR: f64 = 1e-30;

/// The feature map of a model: z = (T(B̂ R), s log(‖B‖ + ε_0), s log(‖B_1‖ + ε_0), …) with
/// B̂ = B / (‖B‖ + ε_0), ‖B‖ = √(Σ B² + 10⁻³⁰) and ε_0 = 10⁻¹².
#[derive(Clone, Debug, PartialEq)]
pub struct GraceProjection {
    /// R as stored, row-major `[D_basis, d]`.
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
    /// Number of layers, each of which has a norm.
    pub layers: usize,
}

/// How features follow from B and R (paper, "Selection of feature space and uncertainty estimator").
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FeatureForm {
    /// The normalised feature: z = (B̂ R, s log ‖B‖, s log ‖B_1‖, …).
    Normalised,
    /// The linear projected basis: z = B R.
    Linear,
}

/// The rows of R for the basis of one layer, and their transpose.
#[derive(Clone, Debug)]
pub(super) struct ProjectionMaps<V> {
    forward: Matrix<V>,
    transposed: Matrix<V>,
}

impl<V: Vector> ProjectionMaps<V> {
    /// `row_of` gives the row of R for each index of the layer's padded basis, `None` for padding.
    pub fn new(matrix: &[f32], dimension: usize, row_of: &[Option<usize>]) -> Self {
        let element = |place: usize, column: usize| {
            row_of[place].map_or(0.0, |row| f64::from(matrix[row * dimension + column]))
        };
        let (forward, transposed) = with_transpose(row_of.len(), dimension, element);
        Self { forward, transposed }
    }
}

/// The features z, and the forward data that the reverse pass needs, for all atoms in evaluation order.
#[derive(Clone, Debug, Default)]
pub(super) struct ProjectionWork<V> {
    /// B̂ R before T, `[n, lanes of d]`.
    projected: Vec<V>,
    /// ‖B‖ and ‖B_k‖ of each layer, `[n, 1 + layers]`.
    norms: Vec<f64>,
    /// Cotangents of B̂ R, and the factors of B in those of B, with the same shapes. The reverse pass leaves the forward data as they are:
    /// it may be repeated.
    cotangents: Vec<V>,
    factors: Vec<f64>,
    /// z, `[n, D]`.
    pub features: Vec<f64>,
}

/// The slices that belong to some atoms.
pub(super) struct Projected<'a, V> {
    projected: ChunkedSlice<'a, V>,
    norms: ChunkedSlice<'a, f64>,
    cotangents: ChunkedSlice<'a, V>,
    factors: ChunkedSlice<'a, f64>,
    /// z.
    pub features: ChunkedSlice<'a, f64>,
}

impl<V: Vector> ProjectionWork<V> {
    /// Resizes the arrays to `n` atoms.
    pub fn resize(&mut self, map: &FeatureMap<V>, n: usize) {
        let projection = &map.projection;
        self.projected.resize(n * map.lanes(), V::ZERO);
        self.norms.resize(n * projection.n_norms(), 0.0);
        self.cotangents.resize(self.projected.len(), V::ZERO);
        self.factors.resize(self.norms.len(), 0.0);
        self.features.resize(n * projection.feature_dimension(), 0.0);
    }

    /// The slices of all atoms, which can be split.
    pub fn parts(&mut self, map: &FeatureMap<V>) -> Projected<'_, V> {
        let (even, projection) = (PlaceLayout::Even, &map.projection);
        Projected {
            projected: ChunkedSlice::new(even(map.lanes()), 0, &mut self.projected[..]),
            norms: ChunkedSlice::new(even(projection.n_norms()), 0, &mut self.norms[..]),
            cotangents: ChunkedSlice::new(even(map.lanes()), 0, &mut self.cotangents[..]),
            factors: ChunkedSlice::new(even(projection.n_norms()), 0, &mut self.factors[..]),
            features: ChunkedSlice::new(even(projection.feature_dimension()), 0, &mut self.features[..]),
        }
    }
}

impl<V: Send> SplitByChunk for Projected<'_, V> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let (projected, norms) = (self.projected.split(chunk), self.norms.split(chunk));
        let (cotangents, factors) = (self.cotangents.split(chunk), self.factors.split(chunk));
        let features = self.features.split(chunk);
        let of = |projected, norms, cotangents, factors, features| Self {
            projected,
            norms,
            cotangents,
            factors,
            features,
        };
        (
            of(projected.0, norms.0, cotangents.0, factors.0, features.0),
            of(projected.1, norms.1, cotangents.1, factors.1, features.1),
        )
    }
}

impl GraceProjection {
    /// D, the dimension of z.
    pub fn feature_dimension(&self) -> usize {
        self.dimension + if self.density_channels { self.n_norms() } else { 0 }
    }

    /// The same matrix with other features.
    pub(super) fn with_form(&self, form: FeatureForm) -> Self {
        let normalised = form == FeatureForm::Normalised;
        Self { normalize: normalised, density_channels: normalised, asinh: false, ..self.clone() }
    }

    /// Number of norms: that of the whole basis and those of the layers.
    fn n_norms(&self) -> usize {
        1 + self.layers
    }
}

/// A projection with its matrix in the layout of the passes over atoms.
#[derive(Clone, Debug)]
pub(super) struct FeatureMap<V> {
    pub projection: GraceProjection,
    /// For the basis of each layer.
    maps: Vec<ProjectionMaps<V>>,
    /// The layers in the order of their norms in z.
    blocks: Vec<usize>,
}

impl<V: Vector> FeatureMap<V> {
    /// `projection` must fit the basis.
    pub fn new(projection: GraceProjection, basis: &BasisLayout) -> Self {
        let GraceProjection { matrix, dimension, .. } = &projection;
        let maps = basis.rows.iter().map(|rows| ProjectionMaps::new(matrix, *dimension, rows)).collect();
        Self { maps, blocks: basis.blocks.clone(), projection }
    }

    /// The factor of layer k's basis in its cotangent, for each k, from ‖B‖ and ‖B_k‖.
    #[inline(always)]
    fn basis_factors(&self, norms: &[f64], along: f64, of_norms: &[f64], factors: &mut [f64]) {
        let scale = f64::from(self.projection.density_scale);
        let density = |k: usize| of_norms.get(k).copied();
        let factor = |norm: f64, cotangent: f64| cotangent / (norm + NORM_FLOOR) / norm;
        let of_all = factor(norms[0], scale * density(0).unwrap_or(0.0) - along);
        for (k, layer) in self.blocks.iter().enumerate() {
            factors[layer + 1] = of_all + factor(norms[layer + 1], scale * density(k + 1).unwrap_or(0.0));
        }
    }

    /// z of the atoms at these places from the bases of each layer, `[places, lanes]`.
    #[inline(always)]
    pub fn forward<'a>(
        &self,
        places: &Range<usize>,
        bases: impl Fn(usize) -> &'a [V],
        work: &mut Projected<V>,
        instructions: Instructions,
    ) {
        let (map, n, lanes) = (&self.projection, places.len(), self.lanes());
        let width = map.feature_dimension();
        let (all_norms, all_projected) = (work.norms.slice(places), work.projected.slice(places));
        all_norms.fill(SQUARE_FLOOR);
        all_projected.fill(V::ZERO);
        for (layer, maps) in self.maps.iter().enumerate() {
            let (bases, of_atom) = (bases(layer), maps.forward.input_lanes());
            for (norms, basis) in all_norms.chunks_exact_mut(map.n_norms()).zip(bases.chunks_exact(of_atom)) {
                let square = dot(basis, basis);
                norms[0] += square;
                norms[layer + 1] += square;
            }
            let (from, to) = (StridedRows::of_atoms(n, of_atom), StridedRows::of_atoms(n, lanes));
            maps.forward.multiply_add((bases, &mut *all_projected), from, to, instructions);
        }
        all_norms.iter_mut().for_each(|square| *square = square.sqrt());
        let rows = all_projected.chunks_exact_mut(lanes).zip(all_norms.chunks_exact(map.n_norms()));
        for (z, (projected, norms)) in work.features.slice(places).chunks_exact_mut(width).zip(rows) {
            let scale = if map.normalize { 1.0 / (norms[0] + NORM_FLOOR) } else { 1.0 };
            let projected = &mut V::flat_mut(projected)[..map.dimension];
            for (z, p) in z.iter_mut().zip(projected) {
                *p *= V::Number::round(scale);
                let p: f64 = (*p).into();
                *z = if map.asinh { p.asinh() } else { p };
            }
            let norms = std::iter::once(norms[0]).chain(self.blocks.iter().map(|layer| norms[layer + 1]));
            for (z, norm) in z[map.dimension..].iter_mut().zip(norms) {
                *z = f64::from(map.density_scale) * (norm + NORM_FLOOR).ln();
            }
        }
    }

    /// The first half of the reverse pass for the atoms at these places: the cotangents of B̂ R and the factors
    /// of B from those of z, `[places, D]`.
    ///
    /// B̄ = R p̄/(N + ε_0) + \[L̄/(N + ε_0) − (p̄ · p)/(N + ε_0)\] B/N with p = B̂ R, and in block k
    /// additionally L̄_k/(N_k + ε_0) B/N_k.
    #[inline(always)]
    pub fn begin_backward(&self, places: &Range<usize>, cotangent: &[f64], work: &mut Projected<V>) {
        let (map, lanes) = (&self.projection, self.lanes());
        let forward = work.projected.slice(places).chunks_exact_mut(lanes);
        let forward = forward.zip(work.norms.slice(places).chunks_exact(map.n_norms()));
        let reverse = work.cotangents.slice(places).chunks_exact_mut(lanes);
        let reverse = reverse.zip(work.factors.slice(places).chunks_exact_mut(map.n_norms()));
        let rows = cotangent.chunks_exact(map.feature_dimension()).zip(forward.zip(reverse));
        for (cotangent, ((projected, norms), (of_lanes, factors))) in rows {
            let (of_projected, of_norms) = cotangent.split_at(map.dimension);
            let inverse = 1.0 / (norms[0] + NORM_FLOOR);
            let (scale, mut along) = (if map.normalize { inverse } else { 1.0 }, 0.0);
            let numbers = V::flat_mut(projected).iter().zip(V::flat_mut(of_lanes));
            for (c, (p, out)) in of_projected.iter().zip(numbers) {
                let of_z: f64 = (*p).into();
                let cotangent = if map.asinh { c / (1.0 + of_z * of_z).sqrt() } else { *c };
                along += cotangent * of_z;
                *out = V::Number::round(scale * cotangent);
            }
            self.basis_factors(norms, if map.normalize { along } else { 0.0 }, of_norms, factors);
        }
    }

    /// The second half: replaces the bases of one layer, `[places, lanes]`, with their cotangents.
    #[inline(always)]
    pub fn backward(
        &self,
        layer: usize,
        places: &Range<usize>,
        bases: &mut [V],
        work: &mut Projected<V>,
        instructions: Instructions,
    ) {
        let (maps, stride) = (&self.maps[layer], self.projection.n_norms());
        let from = StridedRows::of_atoms(places.len(), self.lanes());
        let to = StridedRows::of_atoms(places.len(), maps.forward.input_lanes());
        let factors = Factors { numbers: &work.factors.slice(places)[layer + 1..], stride };
        let lanes = (&*work.cotangents.slice(places), bases);
        maps.transposed.scale_multiply_add(lanes, from, (to, factors), instructions);
    }

    /// Lanes of B̂ R.
    fn lanes(&self) -> usize {
        self.maps.first().map_or(0, |maps| maps.forward.output_lanes())
    }
}

/// Whether an export has a projection of the features.
pub(super) fn has_projection(archive: &NpzFile) -> bool {
    archive.contains("uq_schema_version")
}

#[inline(always)]
fn dot<V: Vector>(a: &[V], b: &[V]) -> f64 {
    let mut sum = V::ZERO;
    for (a, b) in a.iter().zip(b) {
        sum.add_product(a, b);
    }
    sum.horizontal_sum().into()
}
