//! The universal screened nuclear repulsion, a guard against close pairs.

use atoms::cell::dot;
use atoms::units::COULOMB;
use atoms::{ElementPair, Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};

use crate::pairs::{self, Elements};
use crate::zbl_windows::{ZblWindow, ZblWindows};

/// The Ziegler–Biersack–Littmark repulsion with a smooth switch.
///
/// E = Σ_{i<j} S(x) Z_i Z_j e² / (4πε₀ r) Φ(r / a), a = 0.46850 Å / (Z_i^0.23 + Z_j^0.23),
/// Φ(y) = 0.18175 e^(−3.19980 y) + 0.50986 e^(−0.94229 y) + 0.28022 e^(−0.40290 y) + 0.02817 e^(−0.20162 y).
/// Source: J. F. Ziegler, J. P. Biersack, U. Littmark, The Stopping and Range of Ions in Solids (Pergamon,
/// 1985).
///
/// S(x) = 1 − 10 x³ + 15 x⁴ − 6 x⁵ with x = (r − inner) / (outer − inner) between `inner` and `outer` of the pair of
/// elements; it is continuous up to its second derivative. S = 1 below and 0 above.
#[derive(Clone, Debug)]
pub struct Zbl {
    elements: Elements,
    /// The largest `outer`, Å.
    cutoff: f64,
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
    window: ZblWindow,
}

/// Φ: (factor, exponent) of each term.
const SCREENING: [(f64, f64); 4] =
    [(0.18175, -3.19980), (0.50986, -0.94229), (0.28022, -0.40290), (0.02817, -0.20162)];

/// An invalid switch.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "the ZBL repulsion of {pair} cannot be switched off between {inner} Å and {outer} Å: expected 0 ≤ inner < outer"
)]
pub struct ZblRangeError {
    /// The pair of elements.
    pub pair: ElementPair,
    /// Where the switch starts, Å.
    pub inner: f64,
    /// Where the repulsion ends, Å.
    pub outer: f64,
}

impl Zbl {
    /// The repulsion between all pairs of `species`.
    ///
    /// # Errors
    /// A window without width.
    pub fn new(species: &[Species], windows: &ZblWindows) -> Result<Self, ZblRangeError> {
        let mut species = species.to_vec();
        species.sort_unstable();
        species.dedup();
        let mut repulsions = Vec::new();
        let mut cutoff = 0.0_f64;
        for a in &species {
            for b in &species {
                let pair = ElementPair::new(*a, *b);
                let window = windows.window(pair);
                let ZblWindow { inner, outer } = window;
                if !(0.0 <= inner && inner < outer && outer.is_finite()) {
                    return Err(ZblRangeError { pair, inner, outer });
                }
                cutoff = cutoff.max(outer);
                let (za, zb) = (f64::from(a.atomic_number()), f64::from(b.atomic_number()));
                repulsions.push(Repulsion {
                    strength: COULOMB * za * zb,
                    screening_length: 0.46850 / (za.powf(0.23) + zb.powf(0.23)),
                    window,
                });
            }
        }
        Ok(Self { elements: Elements::new(species), cutoff, repulsions })
    }

    /// Adds energies, forces and virial of the repulsion to `out`, which must have as many atoms.
    pub fn add(
        &self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.elements.check(structure, neighbours, self.cutoff)?;
        for i in 0..structure.len() {
            let row = self.elements.index(structure.species[i]) * self.elements.len();
            for neighbour in neighbours.later_neighbours_of(i) {
                let d = neighbour.displacement(structure, i);
                let squared = dot(d, d);
                if squared >= self.cutoff * self.cutoff {
                    continue;
                }
                let j = neighbour.atom as usize;
                let r = squared.sqrt();
                let repulsion = &self.repulsions[row + self.elements.index(structure.species[j])];
                if r >= repulsion.window.outer {
                    continue;
                }
                let (energy, slope) = repulsion.energy_and_slope(r);
                out.atomic_energies[i] += 0.5 * energy;
                out.atomic_energies[j] += 0.5 * energy;
                pairs::add_pair_force(out, i, j, d, slope / r);
            }
        }
        Ok(())
    }
}

impl Repulsion {
    /// E(r), eV, and E′(r), eV/Å, within the window.
    fn energy_and_slope(&self, r: f64) -> (f64, f64) {
        let ZblWindow { inner, outer } = self.window;
        let y = r / self.screening_length;
        let (mut screening, mut screening_slope) = (0.0, 0.0);
        for (factor, exponent) in SCREENING {
            let term = factor * (exponent * y).exp();
            screening += term;
            screening_slope += exponent * term;
        }
        let coulomb = self.strength / r;
        let energy = coulomb * screening;
        let slope = coulomb * (screening_slope / self.screening_length - screening / r);
        if r <= inner {
            return (energy, slope);
        }
        let width = outer - inner;
        let x = (r - inner) / width;
        let switch = 1.0 - x * x * x * (10.0 - x * (15.0 - 6.0 * x));
        let switch_slope = -30.0 * x * x * (1.0 - x) * (1.0 - x) / width;
        (switch * energy, switch * slope + switch_slope * energy)
    }
}

impl Potential for Zbl {
    fn cutoff(&self) -> f64 {
        self.cutoff
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
