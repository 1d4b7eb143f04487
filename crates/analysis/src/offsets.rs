//! Per-element energy offsets between the labels and a potential.

use std::collections::BTreeSet;

use faer::{Mat, Side};

use crate::quantiles::quantile;

/// Larger differences are unphysical, eV/atom: an all-electron calculation of the heaviest element has 1.5 ·
/// 10⁶.
const MAX_PLAUSIBLE: f64 = 1e7;
/// Minimum residual of an outlier, eV/atom. An outlier exceeds this …
const MIN_CUT: f64 = 1.0;
/// … and this many standard deviations, estimated from the median absolute residual.
const CUT: f64 = 10.0;
const MAD_TO_SIGMA: f64 = 1.4826;
/// Eigenvalues below this fraction of the largest count as zero.
const RANK_TOLERANCE: f64 = 1e-12;
/// Huber thresholds of the robust start, eV/atom. The large one comes first, so that elements whose offsets
/// differ strongly from the others' are found while all of their structures still have weight.
const HUBER_THRESHOLDS: [f64; 2] = [1.0, 0.01];
/// Maximum number of iterations per threshold. They stop earlier once offsets change by less than
/// [`CONVERGENCE`], eV.
const MAX_ITERATIONS: usize = 50;
const CONVERGENCE: f64 = 1e-4;
/// Maximum number of times that outliers are selected anew.
const MAX_SELECTIONS: usize = 10;
/// A composition is outside the fit if the squared norm of its component outside the fitted space exceeds this
/// fraction of its squared norm.
const OUTSIDE_TOLERANCE: f64 = 1e-9;

/// A labelled structure.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledEnergy {
    /// Number of atoms of each element, by atomic number; each element once.
    pub composition: Vec<(u8, u32)>,
    /// Energy of the potential, eV.
    pub model: f64,
    /// Energy of the label, eV.
    pub label: f64,
}

/// Offsets μ of elements such that E_label ≈ E_model + Σ n μ, fitted by least squares to the energy differences
/// per atom of labelled structures.
///
/// Where compositions do not distinguish elements, the minimum-norm solution is taken; then only sums over such
/// compositions are meaningful. Outliers are left out of the fit.
#[derive(Clone, Debug, PartialEq)]
pub struct EnergyOffsets {
    /// Atomic numbers, ascending.
    elements: Vec<u8>,
    /// eV, by element.
    offsets: Vec<f64>,
    /// Pseudo-inverse of Σ x xᵀ over the structures used, with the fractions x of elements.
    inverse: Mat<f64>,
    /// Projection on the space spanned by their compositions.
    projection: Mat<f64>,
    /// Whether each labelled structure is in the fit, or left out.
    used: Vec<bool>,
}

/// The offset of an element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ElementOffset {
    /// Atomic number.
    pub element: u8,
    /// eV/atom.
    pub offset: f64,
    /// Whether the compositions determine this element's offset by itself. If not, the number alone is
    /// meaningless.
    pub is_separate: bool,
}

/// There are fewer labelled structures than a fit needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooFewLabels {
    /// Number of labelled structures.
    pub structures: usize,
    /// The minimum: one more than there are elements.
    pub needed: usize,
}

/// Element fractions and energy difference per atom of a structure.
struct RegressionRow {
    /// Index of the element and its fraction.
    fractions: Vec<(usize, f64)>,
    difference: f64,
}

impl LabelledEnergy {
    fn atoms(&self) -> f64 {
        self.composition.iter().map(|(_, number)| f64::from(*number)).sum()
    }

    /// (E_label − E_model) per atom, eV.
    fn difference_per_atom(&self) -> f64 {
        (self.label - self.model) / self.atoms()
    }
}

impl EnergyOffsets {
    /// Fits offsets. Energies that are not finite or are unphysical are ignored.
    ///
    /// # Errors
    /// [`TooFewLabels`] unless there is at least one more structure than elements.
    pub fn fit(labels: &[LabelledEnergy]) -> Result<Self, TooFewLabels> {
        let is_possible = |label: &&LabelledEnergy| label.difference_per_atom().abs() <= MAX_PLAUSIBLE;
        let possible: Vec<_> = labels.iter().filter(is_possible).collect();
        let elements =
            possible.iter().flat_map(|label| label.composition.iter().map(|(element, _)| *element));
        let elements: Vec<u8> = elements.collect::<BTreeSet<_>>().into_iter().collect();
        let needed = elements.len().max(1) + 1;
        if possible.len() < needed {
            return Err(TooFewLabels { structures: possible.len(), needed });
        }
        let rows: Vec<_> = possible.iter().map(|label| RegressionRow::new(label, &elements)).collect();
        let mut used = within_cut(&residuals(&rows, &robust_start(&rows, elements.len())));
        let mut solved = Solved::solve(&rows, &weights(&used), elements.len());
        for _ in 0..MAX_SELECTIONS {
            let again = within_cut(&residuals(&rows, &solved.offsets));
            if again == used {
                break;
            }
            used = again;
            solved = Solved::solve(&rows, &weights(&used), elements.len());
        }
        let Solved { offsets, inverse, projection } = solved;
        let mut used = used.into_iter();
        let used = labels.iter().map(|label| is_possible(&label) && used.next() == Some(true)).collect();
        Ok(Self { elements, offsets, inverse, projection, used })
    }

    /// Number of structures in the fit.
    pub fn structures(&self) -> usize {
        self.used.iter().filter(|used| **used).count()
    }

    /// Number of labelled structures that were left out as outliers.
    pub fn left_out(&self) -> usize {
        self.used.len() - self.structures()
    }

    /// Whether each labelled structure is in the fit, or left out as an outlier.
    pub fn used(&self) -> &[bool] {
        &self.used
    }

    /// The offsets by ascending atomic number.
    pub fn elements(&self) -> impl Iterator<Item = ElementOffset> + '_ {
        self.elements.iter().zip(&self.offsets).map(|(element, offset)| ElementOffset {
            element: *element,
            offset: *offset,
            is_separate: self.support(&[(*element, 1)]) > 0.0,
        })
    }

    /// The effective number of structures that support the offset of this composition: the inverse of its
    /// leverage. 0 if the fitted compositions do not determine it.
    pub fn support(&self, composition: &[(u8, u32)]) -> f64 {
        let Some(row) = self.row(composition) else { return 0.0 };
        let size: f64 = row.iter().map(|x| x * x).sum();
        if size.is_nan() || size <= 0.0 {
            return 0.0;
        }
        let inside = form(&self.projection, &row);
        let leverage = form(&self.inverse, &row);
        if size - inside > OUTSIDE_TOLERANCE * size || leverage <= 0.0 { 0.0 } else { 1.0 / leverage }
    }

    /// (E_model − E_label) per atom after removing the offsets, eV. `None` if fewer than `min_support`
    /// structures support the composition.
    pub fn error_per_atom(&self, label: &LabelledEnergy, min_support: f64) -> Option<f64> {
        let support = self.support(&label.composition);
        // Tolerate rounding where the support is a whole number.
        if support <= 0.0 || support < min_support * (1.0 - 1e-6) {
            return None;
        }
        let row = self.row(&label.composition)?;
        let offset: f64 = row.iter().zip(&self.offsets).map(|(x, offset)| x * offset).sum();
        Some(offset - label.difference_per_atom())
    }

    /// Fractions of the fitted elements; `None` if the composition has another element.
    fn row(&self, composition: &[(u8, u32)]) -> Option<Vec<f64>> {
        let atoms: f64 = composition.iter().map(|(_, number)| f64::from(*number)).sum();
        let mut row = vec![0.0; self.elements.len()];
        for (element, number) in composition {
            row[self.elements.binary_search(element).ok()?] += f64::from(*number) / atoms;
        }
        Some(row)
    }
}

impl RegressionRow {
    fn new(label: &LabelledEnergy, elements: &[u8]) -> Self {
        let atoms = label.atoms();
        let fraction = |(element, number): &(u8, u32)| {
            let index = elements.binary_search(element).expect("the elements of all rows are known");
            (index, f64::from(*number) / atoms)
        };
        let fractions = label.composition.iter().map(fraction).collect();
        Self { fractions, difference: label.difference_per_atom() }
    }

    fn residual(&self, offsets: &[f64]) -> f64 {
        self.difference - self.fractions.iter().map(|(k, x)| x * offsets[*k]).sum::<f64>()
    }
}

/// Offsets that are insensitive to outliers (Huber's estimator by reweighting).
fn robust_start(rows: &[RegressionRow], elements: usize) -> Vec<f64> {
    let mut differences: Vec<_> = rows.iter().map(|row| row.difference).collect();
    differences.sort_by(f64::total_cmp);
    let median = quantile(&differences, 0.5).unwrap_or(0.0);
    let mut offsets = vec![median; elements];
    for knee in HUBER_THRESHOLDS {
        for _ in 0..MAX_ITERATIONS {
            let residuals = residuals(rows, &offsets);
            let weights: Vec<_> = residuals.iter().map(|residual| knee / residual.abs().max(knee)).collect();
            let before = std::mem::replace(&mut offsets, Solved::solve(rows, &weights, elements).offsets);
            if before.iter().zip(&offsets).all(|(before, now)| (before - now).abs() < CONVERGENCE) {
                break;
            }
        }
    }
    offsets
}

fn residuals(rows: &[RegressionRow], offsets: &[f64]) -> Vec<f64> {
    rows.iter().map(|row| row.residual(offsets)).collect()
}

/// Which residuals are not outliers.
fn within_cut(residuals: &[f64]) -> Vec<bool> {
    let mut sizes: Vec<_> = residuals.iter().map(|residual| residual.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    let cut = (CUT * MAD_TO_SIGMA * quantile(&sizes, 0.5).unwrap_or(0.0)).max(MIN_CUT);
    residuals.iter().map(|residual| residual.abs() <= cut).collect()
}

fn weights(used: &[bool]) -> Vec<f64> {
    used.iter().map(|used| f64::from(u8::from(*used))).collect()
}

/// Minimum-norm weighted least squares.
struct Solved {
    offsets: Vec<f64>,
    inverse: Mat<f64>,
    projection: Mat<f64>,
}

impl Solved {
    fn solve(rows: &[RegressionRow], weights: &[f64], elements: usize) -> Self {
        let mut normal = Mat::<f64>::zeros(elements, elements);
        let mut right = vec![0.0; elements];
        for (row, weight) in rows.iter().zip(weights) {
            for (i, x) in &row.fractions {
                row.fractions.iter().for_each(|(k, y)| normal[(*i, *k)] += weight * x * y);
                right[*i] += weight * x * row.difference;
            }
        }
        let (inverse, projection) = pseudo_inverse(&normal);
        let product = |i: usize| (0..elements).map(|k| inverse[(i, k)] * right[k]).sum();
        Self { offsets: (0..elements).map(product).collect(), inverse, projection }
    }
}

/// Pseudo-inverse of a positive semidefinite matrix, and the projection on its range. Both are zero if the
/// eigenvalues do not converge.
fn pseudo_inverse(matrix: &Mat<f64>) -> (Mat<f64>, Mat<f64>) {
    let n = matrix.nrows();
    let mut inverse = Mat::zeros(n, n);
    let mut projection = Mat::zeros(n, n);
    let Ok(eigen) = matrix.self_adjoint_eigen(Side::Lower) else { return (inverse, projection) };
    let (values, vectors) = (eigen.S(), eigen.U());
    let largest = (0..n).map(|k| values[k]).fold(0.0, f64::max);
    for column in (0..n).filter(|column| values[*column] > RANK_TOLERANCE * largest) {
        for i in 0..n {
            for k in 0..n {
                let product = vectors[(i, column)] * vectors[(k, column)];
                inverse[(i, k)] += product / values[column];
                projection[(i, k)] += product;
            }
        }
    }
    (inverse, projection)
}

/// xᵀ M x
fn form(matrix: &Mat<f64>, x: &[f64]) -> f64 {
    let n = x.len();
    (0..n).map(|i| (0..n).map(|k| x[i] * matrix[(i, k)] * x[k]).sum::<f64>()).sum()
}

#[cfg(test)]
mod tests;
