//! The embedded-atom method.

use std::path::Path;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};

use crate::eam_pairs::{AddForces, AddPairs, EamBonds, Functions};
use crate::eam_spline::{self, Cubic};
use crate::grace::Instructions;
use crate::near_pairs::NearPairs;
use crate::pairs::Elements;
use crate::potential_file::PotentialFileError;
use crate::setfl::{EamStyle, Setfl};

/// An embedded-atom potential from a setfl file.
///
/// E = Σ_i F_i(ρ_i) + ½ Σ_{i≠j} φ_ij(r_ij) with ρ_i = Σ_{j≠i} ρ_ij(r_ij),
/// where ρ_ij depends on the element of j (alloy style) or on those of i and j (Finnis–Sinclair style). Source:
/// M. S. Daw and M. I. Baskes, Phys. Rev. B 29, 6443 (1984); M. W. Finnis and J. E. Sinclair, Philos. Mag. A
/// 50, 45 (1984).
///
/// F is extrapolated linearly beyond the largest tabulated density, and so are φ and ρ in the last interval
/// before the cutoff where a table ends short of it.
#[derive(Clone, Debug)]
pub struct Eam {
    elements: Elements,
    functions: Functions,
    /// 1 / spacing of ρ.
    density_scale: f64,
    /// F(ρ) of each element.
    embedding: Vec<Vec<Cubic>>,
    instructions: Instructions,
    near: NearPairs,
    /// Element index of each atom.
    kinds: Vec<usize>,
    /// Pair energy, eV, and density at each atom.
    sums: Vec<[f64; 2]>,
    /// F′(ρ_i), eV per unit of density.
    embedding_slopes: Vec<f64>,
    bonds: EamBonds,
}

impl Eam {
    /// Reads a setfl file: Finnis–Sinclair style if its name ends in `.fs`, otherwise alloy style.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, PotentialFileError> {
        let path = path.as_ref();
        let finnis_sinclair = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("fs"));
        let style = if finnis_sinclair { EamStyle::FinnisSinclair } else { EamStyle::Alloy };
        Self::load_as(path, style)
    }

    /// Reads a setfl file of the given style, independent of its name.
    pub fn load_as(path: impl AsRef<Path>, style: EamStyle) -> Result<Self, PotentialFileError> {
        Setfl::read(path.as_ref(), style).map(|tables| Self::new(tables, style))
    }

    fn new(tables: Setfl, style: EamStyle) -> Self {
        Self {
            functions: Functions::new(&tables, style),
            density_scale: 1.0 / tables.density_spacing,
            embedding: tables.embedding.iter().map(|values| eam_spline::cubic_pieces(values)).collect(),
            elements: Elements::new(tables.species),
            instructions: Instructions::best(),
            near: NearPairs::default(),
            kinds: Vec::new(),
            sums: Vec::new(),
            embedding_slopes: Vec::new(),
            bonds: EamBonds::default(),
        }
    }

    /// Adds F(ρ_i) to the energies and writes F′(ρ_i) to `embedding_slopes`.
    fn embed(&mut self, energies: &mut [f64]) {
        self.embedding_slopes.clear();
        for ((energy, kind), [pair_energy, density]) in energies.iter_mut().zip(&self.kinds).zip(&self.sums) {
            let pieces = &self.embedding[*kind];
            let (k, p) = eam_spline::locate(density * self.density_scale, pieces.len());
            *energy = pair_energy + eam_spline::value(&pieces[k], p);
            self.embedding_slopes.push(eam_spline::slope(&pieces[k], p) * self.density_scale);
        }
    }
}

impl Potential for Eam {
    fn cutoff(&self) -> f64 {
        self.functions.cutoff
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
        self.elements.check(structure, neighbours, self.functions.cutoff)?;
        out.reset(structure.len());
        self.elements.indices(structure, &mut self.kinds);
        neighbours.site_positions(structure, &mut self.near.positions);
        self.sums.clear();
        self.sums.resize(structure.len(), [0.0; 2]);
        self.bonds.clear();
        self.instructions.run(AddPairs {
            neighbours,
            functions: &self.functions,
            kinds: &self.kinds,
            near: &mut self.near,
            sums: &mut self.sums,
            bonds: &mut self.bonds,
        });
        self.embed(&mut out.atomic_energies);
        self.instructions.run(AddForces {
            bonds: &self.bonds,
            embedding_slopes: &self.embedding_slopes,
            out,
        });
        Ok(())
    }
}
