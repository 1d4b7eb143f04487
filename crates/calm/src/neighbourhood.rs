//! The grade averaged over the neighbourhood of each atom.

use std::f64::consts::PI;

/// A directed bond from `i` to `j`, including bonds to periodic images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    /// Central atom.
    pub i: usize,
    /// Neighbour (the original of the image); may equal `i`.
    pub j: usize,
    /// Weight of `j` at `i`, 0 to 1.
    pub weight: f64,
}

impl Pair {
    /// The pair with its weight w_ij = ½[1 + cos(π r_ij / r_c,ij)] (paper, Eq. 3), 0 at or beyond the cutoff.
    ///
    /// `distance` is r_ij and `cutoff` is r_c,ij of this pair of species, Å.
    pub fn new(i: usize, j: usize, distance: f64, cutoff: f64) -> Self {
        let weight = if distance < cutoff { 0.5 * (1.0 + (PI * distance / cutoff).cos()) } else { 0.0 };
        Self { i, j, weight }
    }

    /// The pair with weight 1 within a radius, Å, 0 at or beyond it: the uniform average over these neighbours. With the
    /// pair's cutoff as radius, they are those of [`Pair::new`], which with a smaller radius averages over fewer.
    pub fn uniform(i: usize, j: usize, distance: f64, radius: f64) -> Self {
        Self { i, j, weight: f64::from(distance < radius) }
    }
}

/// A pair with the index of an atom that has no grade.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("pair ({i}, {j}) names an atom beyond the {atoms} graded atoms")]
pub struct PairError {
    /// Central atom.
    pub i: usize,
    /// Neighbour.
    pub j: usize,
    /// Number of graded atoms.
    pub atoms: usize,
}

/// γ_nbr,i = (γ_i + Σ_j w_ij γ_j) / (1 + Σ_j w_ij), w_ij = ½[1 + cos(π r_ij / r_c,ij)] (paper, Eq. 3).
///
/// `gamma` and the result are `[atoms]`. The sum follows the order of the pairs; pass them in a fixed order for
/// reproducible bits.
///
/// # Errors
/// A pair with the index of an atom that has no grade.
pub fn neighbourhood_average(
    gamma: &[f64],
    pairs: impl IntoIterator<Item = Pair>,
) -> Result<Vec<f64>, PairError> {
    let mut sums: Vec<(f64, f64)> = gamma.iter().map(|&grade| (grade, 1.0)).collect();
    for Pair { i, j, weight } in pairs {
        let error = PairError { i, j, atoms: gamma.len() };
        let (sum, grade) = (sums.get_mut(i).ok_or(error)?, gamma.get(j).ok_or(error)?);
        *sum = (sum.0 + weight * grade, sum.1 + weight);
    }
    Ok(sums.into_iter().map(|(sum, weight)| sum / weight).collect())
}
