//! The universal screened nuclear repulsion, a guard against close pairs.

use atoms::cell::dot;
use atoms::units::COULOMB;
use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};

use crate::pairs::{self, Elements};

/// The Ziegler–Biersack–Littmark repulsion with a smooth switch.
///
/// E = Σ_{i<j} S(x) Z_i Z_j e² / (4πε₀ r) Φ(r / a), a = 0.46850 Å / (Z_i^0.23 + Z_j^0.23),
/// Φ(y) = 0.18175 e^(−3.19980 y) + 0.50986 e^(−0.94229 y) + 0.28022 e^(−0.40290 y) + 0.02817 e^(−0.20162 y).
/// Source: J. F. Ziegler, J. P. Biersack, U. Littmark, The Stopping and Range of Ions in Solids (Pergamon,
/// 1985).
///
/// S(x) = 1 − 10 x³ + 15 x⁴ − 6 x⁵ with x = (r − inner) / (outer − inner) between `inner` and `outer`; it is
/// continuous up to its second derivative. S = 1 below and 0 above.
#[derive(Clone, Debug)]
pub struct Zbl {
    elements: Elements,
    inner: f64,
    outer: f64,
    /// `[i * elements + j]`.
    repulsions: Vec<Repulsion>,
}

/// The contribution of a pair of elements.
#[derive(Clone, Copy, Debug)]
struct Repulsion {
    /// Z_i Z_j e² / (4πε₀), eV Å.
    strength: f64,
    /// a, Å.
    screening_length: f64,
}

/// Φ: (factor, exponent) of each term.
const SCREENING: [(f64, f64); 4] =
    [(0.18175, -3.19980), (0.50986, -0.94229), (0.28022, -0.40290), (0.02817, -0.20162)];

/// An invalid switch.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "the ZBL repulsion cannot be switched off between {inner} Å and {outer} Å: expected 0 ≤ inner < outer"
)]
pub struct ZblRangeError {
    /// Where the switch starts, Å.
    pub inner: f64,
    /// Where the repulsion ends, Å.
    pub outer: f64,
}

impl Zbl {
    /// The repulsion between all pairs of `species`, complete up to `inner` and zero from `outer`, Å.
    pub fn new(species: &[Species], inner: f64, outer: f64) -> Result<Self, ZblRangeError> {
        if !(0.0 <= inner && inner < outer && outer.is_finite()) {
            return Err(ZblRangeError { inner, outer });
        }
        let mut species = species.to_vec();
        species.sort_unstable();
        species.dedup();
        let charges: Vec<f64> = species.iter().map(|s| f64::from(s.atomic_number())).collect();
        let mut repulsions = Vec::new();
        for zi in &charges {
            for zj in &charges {
                repulsions.push(Repulsion {
                    strength: COULOMB * zi * zj,
                    screening_length: 0.46850 / (zi.powf(0.23) + zj.powf(0.23)),
                });
            }
        }
        Ok(Self { elements: Elements::new(species), inner, outer, repulsions })
    }

    /// Adds energies, forces and virial of the repulsion to `out`, which must have as many atoms.
    pub fn add(
        &self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.elements.check(structure, neighbours, self.outer)?;
        for i in 0..structure.len() {
            let row = self.elements.index(structure.species[i]) * self.elements.len();
            for neighbour in neighbours.later_neighbours_of(i) {
                let d = neighbour.displacement(structure, i);
                let squared = dot(d, d);
                if squared >= self.outer * self.outer {
                    continue;
                }
                let j = neighbour.atom as usize;
                let r = squared.sqrt();
                let repulsion = &self.repulsions[row + self.elements.index(structure.species[j])];
                let (energy, slope) = self.energy_and_slope(repulsion, r);
                out.atomic_energies[i] += 0.5 * energy;
                out.atomic_energies[j] += 0.5 * energy;
                pairs::add_pair_force(out, i, j, d, slope / r);
            }
        }
        Ok(())
    }

    /// E(r), eV, and E′(r), eV/Å, of a pair.
    fn energy_and_slope(&self, repulsion: &Repulsion, r: f64) -> (f64, f64) {
        let y = r / repulsion.screening_length;
        let (mut screening, mut screening_slope) = (0.0, 0.0);
        for (factor, exponent) in SCREENING {
            let term = factor * (exponent * y).exp();
            screening += term;
            screening_slope += exponent * term;
        }
        let coulomb = repulsion.strength / r;
        let energy = coulomb * screening;
        let slope = coulomb * (screening_slope / repulsion.screening_length - screening / r);
        if r <= self.inner {
            return (energy, slope);
        }
        let width = self.outer - self.inner;
        let x = (r - self.inner) / width;
        let switch = 1.0 - x * x * x * (10.0 - x * (15.0 - 6.0 * x));
        let switch_slope = -30.0 * x * x * (1.0 - x) * (1.0 - x) / width;
        (switch * energy, switch * slope + switch_slope * energy)
    }
}

impl Potential for Zbl {
    fn cutoff(&self) -> f64 {
        self.outer
    }

    fn species(&self) -> &[Species] {
        self.elements.species()
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        out.reset(structure.len());
        self.add(structure, neighbours, out)
    }
}
