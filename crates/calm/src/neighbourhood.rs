//! The grade averaged over the neighbourhood of each atom.

use std::f64::consts::PI;
use std::fmt::{self, Display, Formatter};
use std::str::FromStr;

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
        Self { i, j, weight: NeighbourWeights::default().weight(distance, cutoff) }
    }
}

/// How much each neighbour counts in an average. By default as in the paper's Eq. 3; the others are the variants of its
/// Supplementary Information ("Neighbourhood-averaged extrapolation grade").
///
/// Its text is `cosine` or `uniform`, with an optional radius in Å: `uniform:3.2`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct NeighbourWeights {
    /// Whether all neighbours count 1, instead of w(r) = ½[1 + cos(π r / r_c)].
    pub is_uniform: bool,
    /// Replaces larger cutoffs r_c of pairs, Å.
    pub radius: Option<f64>,
}

impl NeighbourWeights {
    /// Weight of a neighbour, 0 to 1. `distance` is r_ij and `cutoff` is r_c,ij of this pair of species, Å.
    pub fn weight(self, distance: f64, cutoff: f64) -> f64 {
        let cutoff = self.radius.map_or(cutoff, |radius| radius.min(cutoff));
        match distance < cutoff {
            false => 0.0,
            true if self.is_uniform => 1.0,
            true => 0.5 * (1.0 + (PI * distance / cutoff).cos()),
        }
    }
}

impl Display for NeighbourWeights {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(if self.is_uniform { "uniform" } else { "cosine" })?;
        self.radius.map_or(Ok(()), |radius| write!(f, ":{radius}"))
    }
}

impl FromStr for NeighbourWeights {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (kind, radius) = text.split_once(':').map_or((text, None), |(kind, radius)| (kind, Some(radius)));
        let is_uniform = match kind {
            "uniform" => true,
            "cosine" => false,
            _ => {
                return Err(
                    "expected cosine or uniform, with an optional radius in Å, such as uniform:3.2".into()
                );
            }
        };
        let parse =
            |radius: &str| radius.parse().ok().filter(|radius| *radius > 0.0 && f64::is_finite(*radius));
        let radius = radius
            .map(|radius| parse(radius).ok_or(format!("radius '{radius}': expected a positive number in Å")));
        Ok(Self { is_uniform, radius: radius.transpose()? })
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
