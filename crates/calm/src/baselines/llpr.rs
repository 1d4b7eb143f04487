//! Last-layer prediction rigidity (Bigi et al., Mach. Learn.: Sci. Technol. 5, 045018, 2024; paper, Supplementary Information).
//!
//! G = Σ_s **x**_s **x**_sᵀ over structures, **x**_s = (1/N_s) Σ_i **h**_i or Σ_i **h**_i; u = √(**h**ᵀ(G + λI)⁻¹**h**),
//! λ = η tr G / D. The force form adds the rows of all force components to G: for a model that is linear in its features, a
//! force component is linear in the gradient of their sum.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, Par};

use super::error::{BaselineError, check_rows};
use super::kind::BaselineKind;
use super::max_vol::multiply_transposed;
use super::settings::BaselineSettings;
use crate::linear::{LinearError, dot, eigen, trace, view};

/// Rows of one matrix product.
const BLOCK_ROWS: usize = 128;

/// One Gram matrix for all elements.
#[derive(Debug, Clone, PartialEq)]
pub struct Llpr {
    pub(super) kind: BaselineKind,
    pub(super) dimension: usize,
    /// G, `[D × D]`, symmetric.
    pub(super) gram: Vec<f64>,
    /// η
    pub(super) regularisation: f64,
    /// Rows v_iᵀ/√(w_i + λ) for the eigenpairs of G, `[D × D]`.
    whitening: Vec<f64>,
}

impl Llpr {
    pub(super) fn new(
        kind: BaselineKind,
        dimension: usize,
        gram: Vec<f64>,
        regularisation: f64,
    ) -> Result<Self, LinearError> {
        let shift = regularisation * trace(&gram, dimension) / dimension as f64;
        let found = eigen(view(&gram, dimension, dimension))?;
        let mut whitening = Vec::with_capacity(dimension * dimension);
        for (column, value) in found.values.iter().enumerate() {
            // Rounding makes eigenvalues of a Gram matrix negative.
            let scale = 1.0 / (value.max(0.0) + shift).sqrt();
            whitening.extend((0..dimension).map(|row| scale * found.vectors[(row, column)]));
        }
        Ok(Self { kind, dimension, gram, regularisation, whitening })
    }

    /// Which rows the Gram matrix has.
    pub fn kind(&self) -> BaselineKind {
        self.kind
    }

    /// D
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// G, `[D × D]`.
    pub fn gram(&self) -> &[f64] {
        &self.gram
    }

    /// u of each row, `[n × D]`.
    pub(super) fn score_rows(&self, rows: &[f64]) -> Vec<f64> {
        let mut scores = Vec::with_capacity(rows.len() / self.dimension);
        for rows in rows.chunks(BLOCK_ROWS * self.dimension) {
            let white = multiply_transposed(rows, &self.whitening, self.dimension);
            scores.extend(white.chunks_exact(self.dimension).map(|row| dot(row, row).sqrt()));
        }
        scores
    }

    /// As [`super::Baseline::score_forces`].
    pub(super) fn score_forces(&self, rows: &[f64]) -> Result<Vec<f64>, BaselineError> {
        check_rows(self.dimension, 3, rows)?;
        let components = self.score_rows(rows);
        Ok(components.chunks_exact(3).map(|u| dot(u, u).sqrt()).collect())
    }
}

/// Sums the Gram matrix.
#[derive(Debug, Clone)]
pub(super) struct LlprBuilder {
    kind: BaselineKind,
    dimension: usize,
    regularisation: f64,
    /// √ of the weight of force components.
    force_factor: f64,
    gram: Vec<f64>,
    /// Rows that wait, `[≤ BLOCK_ROWS × D]`.
    block: Vec<f64>,
}

impl LlprBuilder {
    pub fn new(kind: BaselineKind, settings: &BaselineSettings, dimension: usize) -> Self {
        Self {
            kind,
            dimension,
            regularisation: settings.regularisation,
            force_factor: settings.force_weight.sqrt(),
            gram: vec![0.0; dimension * dimension],
            block: Vec::new(),
        }
    }

    /// Adds a structure.
    pub fn add(&mut self, features: &[f64]) {
        let atoms = features.len() / self.dimension;
        if atoms == 0 {
            return;
        }
        let mut row = vec![0.0; self.dimension];
        for z in features.chunks_exact(self.dimension) {
            row.iter_mut().zip(z).for_each(|(sum, z)| *sum += z);
        }
        if self.kind != BaselineKind::LlprSum {
            row.iter_mut().for_each(|sum| *sum /= atoms as f64);
        }
        self.push(&row, 1.0);
    }

    /// Adds the rows of a structure's force components.
    pub fn add_forces(&mut self, rows: &[f64]) -> Result<(), BaselineError> {
        if !self.kind.has_force_form() {
            return Ok(());
        }
        check_rows(self.dimension, 3, rows)?;
        for row in rows.chunks_exact(self.dimension) {
            self.push(row, self.force_factor);
        }
        Ok(())
    }

    fn push(&mut self, row: &[f64], factor: f64) {
        self.block.extend(row.iter().map(|x| factor * x));
        if self.block.len() == BLOCK_ROWS * self.dimension {
            self.flush();
        }
    }

    fn flush(&mut self) {
        let (dimension, rows) = (self.dimension, self.block.len() / self.dimension);
        let block = view(&self.block, rows, dimension);
        let gram = MatMut::from_row_major_slice_mut(&mut self.gram, dimension, dimension);
        matmul(gram, Accum::Add, block.transpose(), block, 1.0, Par::Seq);
        self.block.clear();
    }

    pub fn finish(mut self) -> Result<Llpr, BaselineError> {
        self.flush();
        let symmetric = crate::linear::symmetrised(view(&self.gram, self.dimension, self.dimension));
        if trace(&symmetric, self.dimension) <= 0.0 {
            return Err(BaselineError::NoData);
        }
        Ok(Llpr::new(self.kind, self.dimension, symmetric, self.regularisation)?)
    }
}
