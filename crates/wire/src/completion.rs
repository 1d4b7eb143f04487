//! The probability that the calculation of a label completes: what it depends on, and the coefficients of a model.
//!
//! The process that reads finished labels learns the coefficients; the selector may decline candidates by them.

use atoms::{ElementPair, NeighbourList, ShortestDistances, Species, Structure, StructureError, composition};

/// Bonds longer than this multiple of the sum of covalent radii are no bonds, and count as this long.
pub const MAX_BOND: f64 = 1.5;

/// Range of γ_max; numbers outside it count as its ends.
const GAMMA_RANGE: (f64, f64) = (1e-3, 1e6);

/// What the probability of completion depends on.
#[derive(Clone, Debug, PartialEq)]
pub struct CompletionPredictors {
    /// Largest γ under the original mixture of the version of the potential.
    pub gamma_max: f64,
    /// V/V₀; 1 for a structure without a volume.
    pub relative_volume: f64,
    /// Smallest distance of two atoms relative to the sum of their covalent radii, [`MAX_BOND`] at most.
    pub shortest_bond: f64,
    /// Atomic number and fraction of each element, ascending.
    pub fractions: Vec<(u8, f64)>,
}

/// A model ln(p / (1 − p)) = b + **w** · **x** of the probability p of completion. **x** are ln γ_max, V/V₀, (V/V₀)², the shortest
/// bond, and the fractions of all elements but the first.
#[derive(Clone, Debug, PartialEq)]
pub struct CompletionCoefficients {
    /// Atomic numbers of the elements, ascending. The fractions of others are ignored.
    pub elements: Vec<u8>,
    /// b; infinite if nothing has failed.
    pub intercept: f64,
    /// **w**, or nothing if p is the same for all structures.
    pub weights: Vec<f64>,
}

impl CompletionPredictors {
    /// Of a structure with these elements and shortest distances.
    pub fn new(
        species: &[Species],
        shortest: &ShortestDistances,
        gamma_max: f64,
        relative_volume: Option<f64>,
    ) -> Self {
        let ratio = |(pair, distance): (ElementPair, f64)| distance / pair.covalent_radii();
        let atoms = species.len().max(1) as f64;
        let (least, most) = GAMMA_RANGE;
        Self {
            gamma_max: if gamma_max.is_nan() { most } else { gamma_max.clamp(least, most) },
            relative_volume: relative_volume.filter(|ratio| ratio.is_finite() && *ratio > 0.0).unwrap_or(1.0),
            shortest_bond: shortest.iter().map(ratio).fold(MAX_BOND, f64::min),
            fractions: composition(species)
                .into_iter()
                .map(|(element, number)| (element, f64::from(number) / atoms))
                .collect(),
        }
    }

    /// The same for a structure whose distances are not known yet.
    ///
    /// # Errors
    /// A structure that has no neighbour list.
    pub fn of_structure(
        structure: &Structure,
        gamma_max: f64,
        relative_volume: Option<f64>,
    ) -> Result<Self, StructureError> {
        let radius = structure.species.iter().map(|species| species.covalent_radius()).fold(0.0, f64::max);
        let mut list = NeighbourList::new(2.0 * MAX_BOND * radius, 0.0);
        list.update(structure)?;
        let shortest = ShortestDistances::from_neighbours(structure, &list);
        Ok(Self::new(&structure.species, &shortest, gamma_max, relative_volume))
    }

    /// **x** for a model with these elements.
    pub fn row(&self, elements: &[u8]) -> Vec<f64> {
        let volume = self.relative_volume;
        let fraction = |element: &u8| {
            let found = self.fractions.iter().find(|(number, _)| number == element);
            found.map_or(0.0, |(_, fraction)| *fraction)
        };
        let of_elements = elements.iter().skip(1).map(fraction);
        [self.gamma_max.ln(), volume, volume * volume, self.shortest_bond]
            .into_iter()
            .chain(of_elements)
            .collect()
    }
}

impl CompletionCoefficients {
    /// The same probability for all structures.
    pub fn constant(probability: f64) -> Self {
        let odds = (probability / (1.0 - probability)).ln();
        Self { elements: Vec::new(), intercept: odds, weights: Vec::new() }
    }

    /// Whether the probability is the same for all structures.
    pub fn is_constant(&self) -> bool {
        self.weights.is_empty()
    }

    /// The probability p for a structure.
    pub fn probability(&self, predictors: &CompletionPredictors) -> f64 {
        let row = match self.is_constant() {
            true => Vec::new(),
            false => predictors.row(&self.elements),
        };
        let sum: f64 = self.weights.iter().zip(&row).map(|(weight, x)| weight * x).sum();
        1.0 / (1.0 + (-(self.intercept + sum)).exp())
    }
}

#[cfg(test)]
mod tests {
    use atoms::Cell;

    use super::*;

    fn silica(distance: f64) -> Structure {
        Structure {
            species: ["Si", "O", "O"].map(|symbol| symbol.parse().unwrap()).to_vec(),
            positions: vec![[0.0; 3], [distance, 0.0, 0.0], [0.0, 0.0, 4.0]],
            cell: Cell::orthorhombic(9.0, 9.0, 9.0),
            periodic: [true; 3],
        }
    }

    #[test]
    fn bonds_are_relative_to_covalent_radii_and_elements_to_the_first() {
        // Cordero et al.: 1.11 Å for Si, 0.66 Å for O.
        let found = CompletionPredictors::of_structure(&silica(1.6), 2.0, Some(1.1)).unwrap();
        assert!((found.shortest_bond - 1.6 / 1.77).abs() < 1e-12, "{found:?}");
        assert_eq!(found.fractions, [(8, 2.0 / 3.0), (14, 1.0 / 3.0)]);
        let row = found.row(&[8, 14, 26]);
        assert_eq!((row.len(), row[0], row[1], row[4], row[5]), (6, 2.0_f64.ln(), 1.1, 1.0 / 3.0, 0.0));
        let far = CompletionPredictors::of_structure(&silica(3.2), f64::NAN, None).unwrap();
        assert_eq!((far.shortest_bond, far.gamma_max, far.relative_volume), (MAX_BOND, 1e6, 1.0));
    }

    #[test]
    fn probabilities_follow_the_coefficients() {
        let found = CompletionPredictors::of_structure(&silica(1.6), 1.0, Some(2.0)).unwrap();
        let model =
            CompletionCoefficients { elements: vec![8], intercept: 1.0, weights: vec![9.0, -1.0, 0.5, 0.0] };
        assert!((model.probability(&found) - 1.0 / (1.0 + (-1.0_f64).exp())).abs() < 1e-12);
        for share in [0.0, 0.25, 1.0] {
            let constant = CompletionCoefficients::constant(share);
            assert!((constant.probability(&found) - share).abs() < 1e-12 && constant.is_constant());
        }
    }
}
