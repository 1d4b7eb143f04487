//! D-optimal structures: those that add most to the determinant of the information matrices of the elements.
//!
//! A linear model of the features **z** of the atoms of element e has the information matrix
//!
//! Λ_e = M_e + εI + Σ **zz**ᵀ,  M_e = Σ_k (Σ w **δδ**ᵀ + n_k **μ**_k**μ**_kᵀ) / Σ_k n_k,
//!
//! where the sum is over the picked atoms, and M_e is the mean of **zz**ᵀ over the training atoms of the element, from scatter,
//! effective count n_k and centroid of each component, as far as centroids are means. Features are not centred. The training data
//! thus weigh as much as one atom of each element (a unit-information prior; Kass & Wasserman, J. Am. Stat. Assoc. 90, 928, 1995):
//! they say which directions are known, and picks do not depend on their number. With the sum over 10⁶ of them instead of the mean, a
//! copy of a picked structure would add nearly as much as the structure itself. ε = 10⁻⁶ as in the grades. An element without
//! training atoms has M_e = 0.
//!
//! The gain of a structure with the rows Φ_e of features is
//!
//! Σ_e log det(Λ_e + Φ_eᵀΦ_e) − log det Λ_e = Σ_e log det(I + Φ_eΛ_e⁻¹Φ_eᵀ),
//!
//! and each pick is the structure with the largest gain (Fedorov, Theory of Optimal Experiments, 1972). log det is monotone and
//! submodular: gains only fall, so that lazy evaluation is exact, and the N picks have at least 1 − 1/e of the largest sum of gains that
//! any N structures have (Nemhauser, Wolsey & Fisher, Math. Program. 14, 265, 1978).

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::io;

use faer::{Mat, MatRef};

use super::SelectionError;
use super::lazy_heap::{Bound, LazyHeap};
use super::pool::Pool;
use crate::grade::GradeError;
use crate::linear::{
    LinearError, REGULARISATION, cholesky, eigen, product, regularised, solve_lower, symmetrised, view,
};
use crate::mixture::Mixture;
use crate::update::UpdateError;

/// Picks the structures whose atoms within the window have the largest gain.
#[derive(Debug)]
pub struct DOptimal<'a> {
    pool: &'a Pool,
    /// Of each element that the pool has.
    information: BTreeMap<usize, Information>,
    /// Of the gains of structures.
    bounds: LazyHeap,
    taken: Vec<bool>,
}

/// A structure that was picked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DOptimalPick {
    /// Its index in the pool.
    pub structure: usize,
    /// What it added to the sum of log det Λ_e over the elements.
    pub gain: f64,
}

impl<'a> DOptimal<'a> {
    /// Prepares the picks. The atoms within the window of structures that were `picked` before are in the information matrices, and
    /// these structures are not picked again.
    ///
    /// # Errors
    /// A mixture without statistics, a pool that belongs to another mixture, a file that cannot be read.
    pub fn new(
        pool: &'a Pool,
        mixture: &Mixture,
        picked: impl IntoIterator<Item = usize>,
    ) -> Result<Self, SelectionError> {
        let mut information = BTreeMap::new();
        for atom in pool.atoms() {
            let element = usize::from(atom.element);
            if let Entry::Vacant(place) = information.entry(element) {
                place.insert(Information::new(mixture, element)?);
            }
        }
        let taken = vec![false; pool.len()];
        let mut design = Self { pool, information, bounds: LazyHeap::default(), taken };
        for structure in picked {
            design.learn(structure)?;
        }
        for structure in 0..pool.len() {
            if !design.taken[structure] {
                design.evaluate(structure)?;
            }
        }
        Ok(design)
    }

    /// Picks the structure with the largest gain, the first of several. `None` when no structure with a gain is left: those without
    /// an atom within the window have none.
    ///
    /// # Errors
    /// A temporary file that cannot be read.
    pub fn pick(&mut self) -> Result<Option<DOptimalPick>, SelectionError> {
        loop {
            let outdated = self.bounds.take_outdated(1, |structure| {
                (!self.taken[structure]).then(|| version(self.pool, &self.information, structure))
            });
            if outdated.is_empty() {
                break;
            }
            for structure in outdated {
                self.evaluate(structure)?;
            }
        }
        let Some(Bound { value: gain, index: structure, .. }) = self.bounds.pop() else { return Ok(None) };
        self.learn(structure)?;
        Ok(Some(DOptimalPick { structure, gain }))
    }

    /// Computes the gain of a structure and puts it into the queue. Gains that are 0 stay 0.
    fn evaluate(&mut self, structure: usize) -> Result<(), SelectionError> {
        let mut value = 0.0;
        for (element, rows) in rows(self.pool, structure)? {
            let gain = self.information[&element].gain(&rows);
            value += gain.map_err(|source| SelectionError::Information { element, source })?;
        }
        if value > 0.0 {
            let version = version(self.pool, &self.information, structure);
            self.bounds.push(Bound { value, preference: 0.0, index: structure, version });
        }
        Ok(())
    }

    /// Adds the atoms of a structure within the window to the information matrices.
    fn learn(&mut self, structure: usize) -> Result<(), SelectionError> {
        self.taken[structure] = true;
        for (element, rows) in rows(self.pool, structure)? {
            if let Some(information) = self.information.get_mut(&element) {
                information.add(&rows).map_err(|source| SelectionError::Information { element, source })?;
            }
        }
        Ok(())
    }
}

/// Features of the atoms of a structure within the window, `[n × D]` for each element.
fn rows(pool: &Pool, structure: usize) -> io::Result<BTreeMap<usize, Vec<f64>>> {
    let mut rows: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for atom in pool.window_atoms_of(structure) {
        let element = usize::from(pool.atoms()[atom].element);
        pool.features().read(atom..atom + 1, rows.entry(element).or_default())?;
    }
    Ok(rows)
}

/// Changes whenever an information matrix changes that the gain of a structure depends on.
fn version(pool: &Pool, information: &BTreeMap<usize, Information>, structure: usize) -> usize {
    let elements = pool.window_atoms_of(structure).map(|atom| usize::from(pool.atoms()[atom].element));
    elements.map(|element| information[&element].additions).sum()
}

/// The information matrix Λ of an element, as W of Λ⁻¹ = WᵀW.
///
/// With Y = ΦWᵀ, the gain of Φ is log det(I + YYᵀ) = log det(I + YᵀY), and Λ + ΦᵀΦ = W⁻¹(I + YᵀY)W⁻ᵀ: its W is L⁻¹W for
/// I + YᵀY = LLᵀ. This is Woodbury's identity without a difference, so that Λ stays positive definite.
#[derive(Debug)]
struct Information {
    /// W, `[D × D]`.
    whitening: Mat<f64>,
    /// Structures that were added.
    additions: usize,
}

impl Information {
    /// M + εI of an element.
    fn new(mixture: &Mixture, element: usize) -> Result<Self, SelectionError> {
        let dimension = mixture.dimension();
        let moment = regularised(&second_moment(mixture, element)?, dimension);
        let found = eigen(view(&moment, dimension, dimension))
            .map_err(|source| SelectionError::Information { element, source })?;
        // Rounding, of scatter in single precision too, makes eigenvalues smaller than ε.
        let scale = |k: usize| found.values[k].max(REGULARISATION).sqrt();
        let whitening =
            Mat::from_fn(dimension, dimension, |row, column| found.vectors[(column, row)] / scale(row));
        Ok(Self { whitening, additions: 0 })
    }

    /// log det(I + ΦΛ⁻¹Φᵀ) of rows Φ, `[n × D]`.
    fn gain(&self, rows: &[f64]) -> Result<f64, LinearError> {
        let white = self.whitened(rows);
        let smaller = if white.nrows() < white.ncols() { white.as_ref() } else { white.transpose() };
        let factor = factor(smaller)?;
        Ok(2.0 * (0..factor.nrows()).map(|k| factor[(k, k)].ln()).sum::<f64>())
    }

    /// Adds ΦᵀΦ to Λ.
    fn add(&mut self, rows: &[f64]) -> Result<(), LinearError> {
        let factor = factor(self.whitened(rows).transpose())?;
        solve_lower(&factor, &mut self.whitening);
        self.additions += 1;
        Ok(())
    }

    /// Y = ΦWᵀ, `[n × D]`.
    fn whitened(&self, rows: &[f64]) -> Mat<f64> {
        let dimension = self.whitening.nrows();
        product(view(rows, rows.len() / dimension, dimension), self.whitening.transpose())
    }
}

/// L of I + AAᵀ = LLᵀ, in the lower triangle.
fn factor(a: MatRef<'_, f64>) -> Result<Mat<f64>, LinearError> {
    let dimension = a.nrows();
    let mut matrix = symmetrised(product(a, a.transpose()).as_ref());
    matrix.iter_mut().step_by(dimension + 1).for_each(|value| *value += 1.0);
    cholesky(&matrix, dimension).ok_or(LinearError::NotPositive { dimension })
}

/// M, the mean of **zz**ᵀ over the training atoms of an element, `[D × D]`; 0 without any.
fn second_moment(mixture: &Mixture, element: usize) -> Result<Vec<f64>, SelectionError> {
    let unknown = GradeError::Element { atom: 0, element, elements: mixture.element_count() };
    let dimension = mixture.dimension();
    let (mut sum, mut count) = (vec![0.0_f64; dimension * dimension], 0.0_f64);
    for (slot, component) in mixture.components(element).ok_or(unknown)?.iter().enumerate() {
        let statistics = component.statistics().ok_or(UpdateError::NoStatistics { element, slot })?;
        let (weight, centroid) = (statistics.effective_count, component.centroid());
        let rows = sum.chunks_exact_mut(dimension).zip(statistics.scatter.chunks_exact(dimension));
        for ((sums, scatter), of_row) in rows.zip(centroid) {
            for ((sum, scatter), of_column) in sums.iter_mut().zip(scatter).zip(centroid) {
                *sum += scatter + weight * of_row * of_column;
            }
        }
        count += weight;
    }
    if count > 0.0 {
        sum.iter_mut().for_each(|value| *value /= count);
    }
    Ok(sum)
}
