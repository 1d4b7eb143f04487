//! Whether compositions tell elements apart.

use analysis::LabelledEnergy;
use faer::{Mat, Side};

/// Largest condition index of compositions that tell elements apart.
pub const MAX_CONDITION: f64 = 30.0;
/// Largest share of the variance of a shift that comes from worse combinations of elements.
const MAX_SHARE: f64 = 0.5;

/// How well the compositions of structures determine a shift of each element by least squares.
///
/// The columns of the matrix of fractions (structures × elements) are scaled to length 1. With its singular values dₖ, the
/// condition index of a combination of elements is d_max / dₖ, and the variance of the shift of element i is proportional to
/// Σₖ vᵢₖ² / dₖ². An element is collinear with others if more than half of it comes from indices above 30: the criterion of
/// Belsley, Kuh & Welsch, Regression Diagnostics (Wiley, 1980), chapter 3.
#[derive(Clone, Debug, PartialEq)]
pub struct Collinearity {
    /// d_max / d_min; at most 7 · 10⁷, the limit of rounding.
    pub condition: f64,
    /// Atomic numbers of the collinear elements, ascending.
    pub elements: Vec<u8>,
}

impl Collinearity {
    /// That of these structures, with their elements in ascending order.
    pub fn of(energies: &[LabelledEnergy], elements: &[u8]) -> Self {
        let n = elements.len();
        if n == 0 {
            return Self { condition: 1.0, elements: Vec::new() };
        }
        let product = scaled_product(energies, elements);
        let Ok(eigen) = product.self_adjoint_eigen(Side::Lower) else {
            return Self { condition: f64::INFINITY, elements: elements.to_vec() };
        };
        // d² and v.
        let (values, vectors) = (eigen.S(), eigen.U());
        let largest = (0..n).map(|k| values[k]).fold(0.0, f64::max);
        let squares: Vec<_> = (0..n).map(|k| values[k].max(f64::EPSILON * largest)).collect();
        let is_weak = |k: &usize| largest > MAX_CONDITION.powi(2) * squares[*k];
        let is_collinear = |element: usize| {
            let variance = |k: usize| vectors[(element, k)] * vectors[(element, k)] / squares[k];
            let all: f64 = (0..n).map(variance).sum();
            let weak: f64 = (0..n).filter(is_weak).map(variance).sum();
            weak > MAX_SHARE * all
        };
        let smallest = squares.iter().copied().fold(f64::INFINITY, f64::min);
        let collinear = (0..n).filter(|&element| is_collinear(element)).map(|element| elements[element]);
        Self { condition: (largest / smallest).sqrt(), elements: collinear.collect() }
    }
}

/// XᵀX of the fractions X, with columns of length 1.
fn scaled_product(energies: &[LabelledEnergy], elements: &[u8]) -> Mat<f64> {
    let n = elements.len();
    let mut product = Mat::<f64>::zeros(n, n);
    for energy in energies {
        let atoms: f64 = energy.composition.iter().map(|(_, number)| f64::from(*number)).sum();
        let fraction = |(element, number): &(u8, u32)| {
            Some((elements.binary_search(element).ok()?, f64::from(*number) / atoms))
        };
        let row: Vec<_> = energy.composition.iter().filter_map(fraction).collect();
        for (i, x) in &row {
            row.iter().for_each(|(k, y)| product[(*i, *k)] += x * y);
        }
    }
    let lengths: Vec<_> = (0..n).map(|k| product[(k, k)].sqrt().max(f64::MIN_POSITIVE)).collect();
    Mat::from_fn(n, n, |i, k| product[(i, k)] / (lengths[i] * lengths[k]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(compositions: &[&[(u8, u32)]]) -> Collinearity {
        let energy = |composition: &&[(u8, u32)]| LabelledEnergy {
            composition: composition.to_vec(),
            model: 0.0,
            label: 0.0,
        };
        let energies: Vec<_> = compositions.iter().map(energy).collect();
        let mut elements: Vec<_> = compositions
            .iter()
            .flat_map(|composition| composition.iter().map(|(element, _)| *element))
            .collect();
        elements.sort_unstable();
        elements.dedup();
        Collinearity::of(&energies, &elements)
    }

    #[test]
    fn condition_numbers_are_those_by_hand() {
        // The columns (1, 0) and (0, 1), and a single one.
        let apart: [&[&[(u8, u32)]]; 2] = [&[&[(13, 4)], &[(28, 1)]], &[&[(13, 4)], &[(13, 2)]]];
        for compositions in apart {
            let found = of(compositions);
            assert!((found.condition - 1.0).abs() < 1e-9 && found.elements.is_empty(), "{found:?}");
        }
        // Fractions ½ ± d: the columns have the cosine c = Σ(¼ − d²) / Σ(¼ + d²), and the condition √((1 + c) / (1 − c)).
        for (step, expected, collinear) in [(10, 50.0_f64.sqrt(), 0), (1, 5000.0_f64.sqrt(), 2)] {
            let of_al = [50, 50 + step, 50 - step, 50].map(|al| [(13, al), (28, 100 - al)]);
            let found = of(&of_al.each_ref().map(|composition| &composition[..]));
            assert!((found.condition / expected - 1.0).abs() < 1e-6, "{found:?}");
            assert_eq!(found.elements.len(), collinear, "{found:?}");
        }
        assert!(of(&[&[(13, 1), (28, 1)], &[(13, 3), (28, 3)]]).condition > 1e6);
    }

    #[test]
    fn only_elements_that_always_come_together_are_collinear() {
        let found = of(&[&[(1, 2), (8, 1)], &[(1, 4), (8, 2)], &[(13, 4)], &[(13, 4), (1, 2), (8, 1)]]);
        assert_eq!(found.elements, [1, 8]);
        // One structure that has one of them only.
        let found = of(&[&[(1, 2), (8, 1)], &[(1, 4), (8, 2)], &[(13, 4)], &[(13, 4), (8, 1)]]);
        assert_eq!(found.elements, [0_u8; 0]);
    }
}
