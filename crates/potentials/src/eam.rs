//! The embedded-atom method.

use std::path::Path;

use atoms::cell::dot;
use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure, Vec3};

use crate::eam_spline::{self, Cubic};
use crate::pairs::{self, Elements};
use crate::potential_file::PotentialFileError;
use crate::setfl::{EamStyle, Setfl};

/// An embedded-atom potential from a setfl file.
///
/// E = Σ_i F_i(ρ_i) + ½ Σ_{i≠j} φ_ij(r_ij) with ρ_i = Σ_{j≠i} ρ_ij(r_ij), where ρ_ij depends on
/// the element of j (alloy style) or on those of i and j (Finnis–Sinclair style).
/// Source: M. S. Daw and M. I. Baskes, Phys. Rev. B 29, 6443 (1984); M. W. Finnis and
/// J. E. Sinclair, Philos. Mag. A 50, 45 (1984).
///
/// Beyond the largest tabulated density F goes on as a straight line; so do φ and ρ in the last
/// interval before the cutoff where a table ends short of it.
#[derive(Clone, Debug)]
pub struct Eam {
    elements: Elements,
    cutoff: f64,
    /// 1 / spacing of r, 1/Å.
    distance_scale: f64,
    /// 1 / spacing of ρ.
    density_scale: f64,
    /// F(ρ) of each element.
    embedding: Vec<Vec<Cubic>>,
    /// `[host * elements + source]`.
    functions: Vec<Vec<PairPiece>>,
    densities: Vec<f64>,
    /// F′(ρ_i), eV per unit of density.
    embedding_slopes: Vec<f64>,
    bonds: Vec<Bond>,
}

/// One interval of the functions of r for an ordered pair of elements, side by side in memory.
#[derive(Clone, Copy, Debug)]
struct PairPiece {
    /// r φ(r), eV Å.
    pair: Cubic,
    /// ρ(r) of the source on the host.
    density: Cubic,
}

/// A pair within the cutoff, kept until the densities are known.
#[derive(Clone, Copy, Debug)]
struct Bond {
    i: u32,
    j: u32,
    d: Vec3,
    /// φ′(r) / r, eV/Å².
    pair_slope: f64,
    /// ρ′(r) / r of j on i, 1/Å².
    slope_on_i: f64,
    /// ρ′(r) / r of i on j, 1/Å².
    slope_on_j: f64,
}

impl Eam {
    /// Reads a setfl file: Finnis–Sinclair style if its name ends in `.fs`, otherwise alloy style.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, PotentialFileError> {
        let path = path.as_ref();
        let finnis_sinclair = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("fs"));
        let style = if finnis_sinclair { EamStyle::FinnisSinclair } else { EamStyle::Alloy };
        Self::load_as(path, style)
    }

    /// Reads a setfl file of a known style, whatever its name.
    pub fn load_as(path: impl AsRef<Path>, style: EamStyle) -> Result<Self, PotentialFileError> {
        Setfl::read(path.as_ref(), style).map(|tables| Self::new(tables, style))
    }

    fn new(tables: Setfl, style: EamStyle) -> Self {
        let n = tables.species.len();
        let mut functions = Vec::new();
        for host in 0..n {
            for source in 0..n {
                let column = if style == EamStyle::FinnisSinclair { host } else { 0 };
                let density = eam_spline::cubic_pieces(&tables.density[source][column]);
                let pair = eam_spline::cubic_pieces(&tables.pair[host.max(source)][host.min(source)]);
                let pieces = pair.into_iter().zip(density);
                functions.push(pieces.map(|(pair, density)| PairPiece { pair, density }).collect());
            }
        }
        Self {
            elements: Elements::new(tables.species),
            cutoff: tables.cutoff,
            distance_scale: 1.0 / tables.distance_spacing,
            density_scale: 1.0 / tables.density_spacing,
            embedding: tables.embedding.iter().map(|values| eam_spline::cubic_pieces(values)).collect(),
            functions,
            densities: Vec::new(),
            embedding_slopes: Vec::new(),
            bonds: Vec::new(),
        }
    }

    /// Pair energies, the density at each atom, and the list of bonds.
    fn add_pairs(&mut self, structure: &Structure, neighbours: &NeighbourList, out: &mut Evaluation) {
        let n = self.elements.len();
        self.bonds.clear();
        self.densities.clear();
        self.densities.resize(structure.len(), 0.0);
        for i in 0..structure.len() {
            let element_i = self.elements.index(structure.species[i]);
            for neighbour in neighbours.of(i) {
                if !pairs::represents_pair(i, neighbour) {
                    continue;
                }
                let d = neighbour.displacement(structure, i);
                let squared = dot(d, d);
                if squared >= self.cutoff * self.cutoff {
                    continue;
                }
                let j = neighbour.atom as usize;
                let element_j = self.elements.index(structure.species[j]);
                let r = squared.sqrt();
                let on_i = &self.functions[element_i * n + element_j];
                let (k, p) = eam_spline::locate(r * self.distance_scale, on_i.len());
                let on_i = &on_i[k];
                let on_j =
                    if element_i == element_j { on_i } else { &self.functions[element_j * n + element_i][k] };
                let per_r = 1.0 / r;
                let phi = eam_spline::value(&on_i.pair, p) * per_r;
                let slope = self.distance_scale * per_r;
                self.densities[i] += eam_spline::value(&on_i.density, p);
                self.densities[j] += eam_spline::value(&on_j.density, p);
                out.atomic_energies[i] += 0.5 * phi;
                out.atomic_energies[j] += 0.5 * phi;
                self.bonds.push(Bond {
                    i: i as u32,
                    j: neighbour.atom,
                    d,
                    // φ = (r φ) / r, so φ′ = ((r φ)′ − φ) / r.
                    pair_slope: (eam_spline::slope(&on_i.pair, p) * self.distance_scale - phi)
                        * per_r
                        * per_r,
                    slope_on_i: eam_spline::slope(&on_i.density, p) * slope,
                    slope_on_j: eam_spline::slope(&on_j.density, p) * slope,
                });
            }
        }
    }

    /// F(ρ_i) into the energies, F′(ρ_i) into `embedding_slopes`.
    fn embed(&mut self, structure: &Structure, out: &mut Evaluation) {
        self.embedding_slopes.clear();
        for (i, (species, density)) in structure.species.iter().zip(&self.densities).enumerate() {
            let pieces = &self.embedding[self.elements.index(*species)];
            let (k, p) = eam_spline::locate(density * self.density_scale, pieces.len());
            out.atomic_energies[i] += eam_spline::value(&pieces[k], p);
            self.embedding_slopes.push(eam_spline::slope(&pieces[k], p) * self.density_scale);
        }
    }
}

impl Potential for Eam {
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
        self.add_pairs(structure, neighbours, out);
        self.embed(structure, out);
        for bond in &self.bonds {
            let (i, j) = (bond.i as usize, bond.j as usize);
            let slope = bond.pair_slope
                + self.embedding_slopes[i] * bond.slope_on_i
                + self.embedding_slopes[j] * bond.slope_on_j;
            pairs::add_pair_force(out, i, j, bond.d, slope);
        }
        Ok(())
    }
}
