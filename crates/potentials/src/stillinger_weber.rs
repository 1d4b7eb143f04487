//! The Stillinger–Weber potential.

use std::path::Path;

use atoms::cell::{dot, scale};
use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure, Vec3};

use crate::pairs::{self, Elements};
use crate::potential_file::PotentialFileError;
use crate::stillinger_weber_file::{Parameters, StillingerWeberEntries};

/// The Stillinger–Weber potential for one or several elements.
///
/// E = Σ_{i<j} φ₂(r_ij) + Σ_i Σ_{j<k} φ₃(r_ij, r_ik, θ_jik),
/// φ₂ = A ε [B (σ/r)^p − (σ/r)^q] exp(σ / (r − aσ)),
/// φ₃ = λ ε (cos θ − cos θ₀)² exp(γσ / (r_ij − aσ)) exp(γσ / (r_ik − aσ)).
/// Source: F. H. Stillinger and T. A. Weber, Phys. Rev. B 31, 5262 (1985).
///
/// In a mixture the entry `i j j` gives φ₂ and the σ, a and γ of an arm i–j; the entry `i j k` with the centre
/// i gives λ ε and cos θ₀. An entry's `tol` shortens the range of its pair to where exp(min(γ, 1) σ / (r − aσ))
/// = tol, as in the LAMMPS manual; 0 keeps a σ.
#[derive(Clone, Debug)]
pub struct StillingerWeber {
    elements: Elements,
    cutoff: f64,
    /// `[i * elements + j]`.
    pair_terms: Vec<PairTerm>,
    /// `[(i * elements + j) * elements + k]`.
    angle_terms: Vec<AngleTerm>,
    arms: Vec<Arm>,
}

#[derive(Clone, Copy, Debug)]
struct PairTerm {
    /// A ε, eV.
    strength: f64,
    /// σ, Å.
    sigma: f64,
    /// γ σ, Å.
    gamma_sigma: f64,
    /// a σ, Å.
    end: f64,
    /// Square of the pair's cutoff, Å².
    squared_cutoff: f64,
    big_b: f64,
    p: Exponent,
    q: Exponent,
}

#[derive(Clone, Copy, Debug)]
struct AngleTerm {
    /// λ ε, eV.
    strength: f64,
    /// cos θ₀.
    cosine: f64,
}

/// A neighbour in the angular terms of an atom.
#[derive(Clone, Copy, Debug)]
struct Arm {
    atom: usize,
    element: usize,
    /// Å.
    d: Vec3,
    /// d / r.
    unit: Vec3,
    /// 1 / r, 1/Å.
    per_r: f64,
    /// g = exp(γσ / (r − aσ)).
    decay: f64,
    /// g′(r) / g, 1/Å.
    decay_rate: f64,
    /// ∂E₃/∂d so far, eV/Å.
    gradient: Vec3,
}

/// x^n, fast for the small integers n in most files.
#[derive(Clone, Copy, Debug)]
enum Exponent {
    Whole(i32),
    Real(f64),
}

impl Exponent {
    fn new(n: f64) -> Self {
        if n.fract() == 0.0 && n <= 64.0 { Self::Whole(n as i32) } else { Self::Real(n) }
    }

    /// (x^n, n x^n)
    #[inline]
    fn power(self, x: f64) -> (f64, f64) {
        let (power, n) = match self {
            Self::Whole(n) => (x.powi(n), f64::from(n)),
            Self::Real(n) => (x.powf(n), n),
        };
        (power, n * power)
    }
}

impl PairTerm {
    fn new(entry: &Parameters) -> Self {
        Self {
            strength: entry.big_a * entry.epsilon,
            sigma: entry.sigma,
            gamma_sigma: entry.gamma * entry.sigma,
            end: entry.a * entry.sigma,
            squared_cutoff: entry.reach().powi(2),
            big_b: entry.big_b,
            p: Exponent::new(entry.p),
            q: Exponent::new(entry.q),
        }
    }

    /// φ₂, eV, and φ₂′(r) / r, eV/Å².
    #[inline]
    fn energy_and_slope(&self, r: f64, per_r: f64) -> (f64, f64) {
        let to_end = 1.0 / (r - self.end);
        let s = self.sigma * per_r;
        let (repulsion, repulsion_slope) = self.p.power(s);
        let (attraction, attraction_slope) = self.q.power(s);
        let difference = self.big_b * repulsion - attraction;
        let strength = self.strength * (self.sigma * to_end).exp();
        let slope = (self.big_b * repulsion_slope - attraction_slope) * per_r
            + difference * self.sigma * to_end * to_end;
        (strength * difference, -strength * slope * per_r)
    }

    /// The arm to a neighbour at d, before its angles are added.
    #[inline]
    fn arm(&self, atom: usize, element: usize, d: Vec3, r: f64, per_r: f64) -> Arm {
        let to_end = 1.0 / (r - self.end);
        Arm {
            atom,
            element,
            d,
            unit: scale(d, per_r),
            per_r,
            decay: (self.gamma_sigma * to_end).exp(),
            decay_rate: -self.gamma_sigma * to_end * to_end,
            gradient: [0.0; 3],
        }
    }
}

impl StillingerWeber {
    /// Reads a parameter file (`.sw`), which must have an entry for each ordered triplet of its elements.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, PotentialFileError> {
        let StillingerWeberEntries { species, parameters } = StillingerWeberEntries::read(path.as_ref())?;
        let n = species.len();
        let pair_entry = |i: usize, j: usize| &parameters[(i * n + j) * n + j];
        let pair_terms: Vec<PairTerm> =
            (0..n * n).map(|pair| PairTerm::new(pair_entry(pair / n, pair % n))).collect();
        // j–i–k and k–i–j are the same angle; the entry whose second element comes first represents both.
        let angle_entry = |i: usize, j: usize, k: usize| &parameters[(i * n + j.min(k)) * n + j.max(k)];
        let angle_terms = (0..n * n * n).map(|triplet| {
            let entry = angle_entry(triplet / (n * n), triplet / n % n, triplet % n);
            AngleTerm { strength: entry.lambda * entry.epsilon, cosine: entry.cosine }
        });
        let angle_terms = angle_terms.collect();
        Ok(Self {
            elements: Elements::new(species),
            cutoff: pair_terms.iter().map(|term| term.squared_cutoff).fold(0.0, f64::max).sqrt(),
            pair_terms,
            angle_terms,
            arms: Vec::new(),
        })
    }

    /// Adds the pairs of atom `i` and collects its arms.
    fn add_pairs(
        &mut self,
        i: usize,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) {
        self.arms.clear();
        let row = self.elements.index(structure.species[i]) * self.elements.len();
        for neighbour in neighbours.neighbours_of(i) {
            let d = neighbour.displacement(structure, i);
            let squared = dot(d, d);
            let j = neighbour.atom as usize;
            let element = self.elements.index(structure.species[j]);
            let term = &self.pair_terms[row + element];
            if squared >= term.squared_cutoff {
                continue;
            }
            let r = squared.sqrt();
            let per_r = 1.0 / r;
            self.arms.push(term.arm(j, element, d, r, per_r));
            if pairs::represents_pair(i, neighbour) {
                let (energy, slope) = term.energy_and_slope(r, per_r);
                out.atomic_energies[i] += 0.5 * energy;
                out.atomic_energies[j] += 0.5 * energy;
                pairs::add_pair_force(out, i, j, d, slope);
            }
        }
    }

    /// Adds the angles at atom `i`: energies, and gradients to the arms.
    fn add_angles(&mut self, element_i: usize) -> f64 {
        let n = self.elements.len();
        let mut energy = 0.0;
        for first in 1..self.arms.len() {
            let (before, from) = self.arms.split_at_mut(first);
            let k = &mut from[0];
            for j in before {
                let term = &self.angle_terms[(element_i * n + j.element) * n + k.element];
                let cosine = dot(j.unit, k.unit);
                let off = cosine - term.cosine;
                let strength = term.strength * j.decay * k.decay * off;
                let angle_energy = strength * off;
                energy += angle_energy;
                for x in 0..3 {
                    j.gradient[x] += 2.0 * strength * (k.unit[x] - cosine * j.unit[x]) * j.per_r
                        + angle_energy * j.decay_rate * j.unit[x];
                    k.gradient[x] += 2.0 * strength * (j.unit[x] - cosine * k.unit[x]) * k.per_r
                        + angle_energy * k.decay_rate * k.unit[x];
                }
            }
        }
        energy
    }
}

impl Potential for StillingerWeber {
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
        self.elements.check(structure, neighbours, self.cutoff)?;
        out.reset(structure.len());
        for i in 0..structure.len() {
            self.add_pairs(i, structure, neighbours, out);
            out.atomic_energies[i] += self.add_angles(self.elements.index(structure.species[i]));
            for arm in &self.arms {
                for x in 0..3 {
                    out.forces[i][x] += arm.gradient[x];
                    out.forces[arm.atom][x] -= arm.gradient[x];
                    for y in 0..3 {
                        out.virial[x][y] -= arm.gradient[x] * arm.d[y];
                    }
                }
            }
        }
        // Rounding leaves the sum over three-body gradients slightly asymmetric.
        for x in 0..3 {
            for y in 0..x {
                let mean = 0.5 * (out.virial[x][y] + out.virial[y][x]);
                out.virial[x][y] = mean;
                out.virial[y][x] = mean;
            }
        }
        Ok(())
    }
}
