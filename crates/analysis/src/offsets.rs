//! Energy offsets of elements: by how much the zero of the labels' energies differs from that of a potential.

use std::collections::BTreeSet;

use faer::{Mat, Side};

use crate::quantiles::quantile;

/// Differences beyond this come from no calculation, eV an atom: an all-electron calculation of the heaviest element has
/// 1.5 · 10⁶.
const MAX_PLAUSIBLE: f64 = 1e7;
/// A structure is left out of the fit if it is further from it than this, eV an atom …
const MIN_CUT: f64 = 1.0;
/// … and than so many standard deviations, as the median absolute residual gives them for normal noise.
const CUT: f64 = 10.0;
const MAD_TO_SIGMA: f64 = 1.4826;
/// Eigenvalues below this part of the largest are zero but for rounding.
const RANK_TOLERANCE: f64 = 1e-12;
/// Residuals above these have a bounded influence on the robust start, eV an atom. The large one comes first: elements whose zeros are
/// far from the others' are found while none of their structures weighs nothing.
const HUBER_THRESHOLDS: [f64; 2] = [1.0, 0.01];
/// Rounds of the robust start, if its offsets do not settle earlier: they change by less than this, eV.
const MAX_ITERATIONS: usize = 50;
const CONVERGENCE: f64 = 1e-4;
/// Rounds in which structures may still be left out or taken in again.
const MAX_SELECTIONS: usize = 10;
/// A composition whose part outside of the fit's space, squared, is larger than this part of it is not described.
const OUTSIDE_TOLERANCE: f64 = 1e-9;

/// A labelled structure as the fit sees it.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledEnergy {
    /// Atomic numbers, each once, with the numbers of atoms.
    pub composition: Vec<(u8, u32)>,
    /// Energy by the potential, eV.
    pub model: f64,
    /// Energy of the label, eV.
    pub label: f64,
}

/// Offsets μ of elements such that E_label ≈ E_model + Σ n μ, by least squares of the differences an atom over labelled
/// structures.
///
/// Where compositions do not tell elements apart, the offsets with the smallest sum of squares are taken, and only their sums over
/// such compositions mean something. Structures that are far from all others are left out of the fit.
#[derive(Clone, Debug, PartialEq)]
pub struct EnergyOffsets {
    /// Atomic numbers, ascending.
    elements: Vec<u8>,
    /// eV, by element.
    offsets: Vec<f64>,
    /// Pseudo-inverse of Σ x xᵀ over the structures used, with the fractions x of elements.
    inverse: Mat<f64>,
    /// Projection on the space of their compositions.
    projection: Mat<f64>,
    structures: usize,
    left_out: usize,
}

/// The offset of an element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ElementOffset {
    /// Atomic number.
    pub element: u8,
    /// eV an atom.
    pub offset: f64,
    /// Whether the compositions tell the element apart from the others. If not, the number by itself means nothing.
    pub is_separate: bool,
}

/// Fewer labelled structures than a fit needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooFewLabels {
    /// Labelled structures.
    pub structures: usize,
    /// At least so many are needed: one more than there are elements.
    pub needed: usize,
}

/// Fractions of elements, and the difference of energies an atom.
struct Row {
    /// Index of the element, and its fraction.
    fractions: Vec<(usize, f64)>,
    difference: f64,
}

impl LabelledEnergy {
    fn atoms(&self) -> f64 {
        self.composition.iter().map(|(_, number)| f64::from(*number)).sum()
    }

    /// (E_label − E_model) an atom, eV.
    fn difference_per_atom(&self) -> f64 {
        (self.label - self.model) / self.atoms()
    }
}

impl EnergyOffsets {
    /// Fits offsets. What is not finite, or beyond any calculation, is left out.
    ///
    /// # Errors
    /// [`TooFewLabels`] unless there is one more structure than elements.
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
        let rows: Vec<_> = possible.iter().map(|label| Row::new(label, &elements)).collect();
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
        let structures = used.iter().filter(|used| **used).count();
        Ok(Self { elements, offsets, inverse, projection, structures, left_out: labels.len() - structures })
    }

    /// Structures that the fit used.
    pub fn structures(&self) -> usize {
        self.structures
    }

    /// Labelled structures that it did not use: they are too far from the others.
    pub fn left_out(&self) -> usize {
        self.left_out
    }

    /// The offsets, by atomic number.
    pub fn elements(&self) -> impl Iterator<Item = ElementOffset> + '_ {
        self.elements.iter().zip(&self.offsets).map(|(element, offset)| ElementOffset {
            element: *element,
            offset: *offset,
            is_separate: self.support(&[(*element, 1)]) > 0.0,
        })
    }

    /// For how many structures of this composition those of the fit stand: the inverse of its leverage. 0 where the compositions of
    /// the fit do not say what this one's offset is.
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

    /// (E_model − E_label) an atom without the offsets, eV. `None` where fewer than `min_support` structures speak for the
    /// composition.
    pub fn error_per_atom(&self, label: &LabelledEnergy, min_support: f64) -> Option<f64> {
        let support = self.support(&label.composition);
        // Rounding must not decide about whole numbers.
        if support <= 0.0 || support < min_support * (1.0 - 1e-6) {
            return None;
        }
        let row = self.row(&label.composition)?;
        let offset: f64 = row.iter().zip(&self.offsets).map(|(x, offset)| x * offset).sum();
        Some(offset - label.difference_per_atom())
    }

    /// Fractions of the elements of the fit; `None` if there is another element.
    fn row(&self, composition: &[(u8, u32)]) -> Option<Vec<f64>> {
        let atoms: f64 = composition.iter().map(|(_, number)| f64::from(*number)).sum();
        let mut row = vec![0.0; self.elements.len()];
        for (element, number) in composition {
            row[self.elements.binary_search(element).ok()?] += f64::from(*number) / atoms;
        }
        Some(row)
    }
}

impl Row {
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

/// Offsets that few outliers hardly move (Huber's estimator, by weights).
fn robust_start(rows: &[Row], elements: usize) -> Vec<f64> {
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

fn residuals(rows: &[Row], offsets: &[f64]) -> Vec<f64> {
    rows.iter().map(|row| row.residual(offsets)).collect()
}

/// Which residuals are no outliers.
fn within_cut(residuals: &[f64]) -> Vec<bool> {
    let mut sizes: Vec<_> = residuals.iter().map(|residual| residual.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    let cut = (CUT * MAD_TO_SIGMA * quantile(&sizes, 0.5).unwrap_or(0.0)).max(MIN_CUT);
    residuals.iter().map(|residual| residual.abs() <= cut).collect()
}

fn weights(used: &[bool]) -> Vec<f64> {
    used.iter().map(|used| f64::from(u8::from(*used))).collect()
}

/// Weighted least squares of minimum norm.
struct Solved {
    offsets: Vec<f64>,
    inverse: Mat<f64>,
    projection: Mat<f64>,
}

impl Solved {
    fn solve(rows: &[Row], weights: &[f64], elements: usize) -> Self {
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

/// Of a symmetric matrix without negative eigenvalues; with the projection on its range. Both are zero if the eigenvalues do not
/// converge.
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
