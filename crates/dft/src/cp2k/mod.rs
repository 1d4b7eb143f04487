//! CP2K (Quickstep) with Gaussian basis sets (MOLOPT) and GTH pseudopotentials: for large cells.
//!
//! Spin-polarised PBE with Fermi–Dirac occupations. The energy is the free energy. The magnetic moment of the cell is
//! free; moments of atoms are Mulliken's. Directions of a structure that do not repeat get vacuum, and no stress is given
//! then.
//!
//! Remedies:
//! - more steps: three times as many;
//! - slower mixing: a fifth of the new density is mixed in instead of two;
//! - another algorithm: Broyden's mixing forgets all but 4 old densities, instead of 8, which leads elsewhere;
//! - other moments: half of them to start from.

mod data;
mod input;
mod output;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use atoms::{Species, Structure};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::checks::{at_least, positive};
use crate::moments::Moments;
use crate::padded_structure::{self, PaddedStructure};
use crate::{
    DftBackend, Exit, Failure, Input, PassedEnvironment, Results, RetryAdjustment, SetupError, Size,
    validation, version_query,
};
use data::Kind;

/// eV, as CP2K has it (CODATA 2006).
const HARTREE: f64 = 27.211_383_856_556_3;

/// Å, as CP2K has it (CODATA 2006).
const BOHR: f64 = 0.529_177_208_59;

/// Name of the output.
const OUTPUT: &str = "run.out";

/// Counts changes of what is written here that change a label's value.
const INPUT_VERSION: u32 = 1;

/// Grids of less than this, eV, hold no pseudopotential: the number was meant in Rydberg.
const LEAST_CUTOFF: f64 = 1000.0;

/// `[label.method.cp2k]`
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// CP2K, and what it is started by: `["mpirun", "-np", "4", "cp2k"]`.
    pub command: Vec<String>,
    /// Added to the environment; `OMP_NUM_THREADS` is 1 unless it stands here.
    pub environment: BTreeMap<String, String>,
    /// Directory with `BASIS_MOLOPT` and `GTH_POTENTIALS`.
    pub pseudopotentials: PathBuf,
    /// Pseudopotential of an element where it is not `GTH-PBE`: `{ W = "GTH-PBE-q6" }`.
    pub variants: BTreeMap<Species, String>,
    /// Basis set of all elements.
    pub basis: String,
    /// Cutoff of the finest grid, eV (8163 eV are 600 Ry).
    pub cutoff: f64,
    /// Cutoff that a Gaussian of exponent 1 needs, eV (816 eV are 60 Ry).
    pub relative_cutoff: f64,
    /// Largest distance of k-points, Å⁻¹, 2π included; the mesh is Γ-centred.
    pub k_spacing: f64,
    /// k_B T of the Fermi–Dirac occupation, eV.
    pub smearing_width: f64,
    /// Whether the two spins have their own densities.
    pub spin: bool,
    /// Initial magnetic moment by element, μ_B; 1 for all others.
    pub moments: Moments,
    /// CP2K's `EPS_SCF`: largest change of the density in an electronic step.
    pub density_tolerance: f64,
    /// Most electronic steps.
    pub steps: u32,
    /// Space between images in directions that do not repeat, Å.
    pub vacuum: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            command: vec!["cp2k".into()],
            environment: BTreeMap::new(),
            pseudopotentials: "/usr/share/cp2k".into(),
            variants: BTreeMap::new(),
            basis: "DZVP-MOLOPT-SR-GTH".into(),
            cutoff: 8163.0,
            relative_cutoff: 816.0,
            k_spacing: 0.125,
            smearing_width: 0.1,
            spin: true,
            moments: Moments::new(),
            density_tolerance: 1e-7,
            steps: 200,
            vacuum: 10.0,
        }
    }
}

impl Settings {
    /// Asks CP2K for its version and finds pseudopotentials and basis sets.
    ///
    /// # Errors
    /// A program that does not answer, a setting with an impossible value, data files that are missing.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Cp2k, SetupError> {
        at_least("cutoff", self.cutoff, LEAST_CUTOFF)?;
        positive("cutoff", self.cutoff)?;
        positive("relative_cutoff", self.relative_cutoff)?;
        positive("k_spacing", self.k_spacing)?;
        positive("smearing_width", self.smearing_width)?;
        positive("density_tolerance", self.density_tolerance)?;
        positive("vacuum", self.vacuum)?;
        at_least("steps", self.steps, 1)?;
        let kinds = data::find(self)?;
        let environment = version_query::environment(&self.environment);
        let version = version(&self.command, &environment, passed)?;
        Ok(Cp2k { settings: self.clone(), environment, version, kinds })
    }
}

/// `2023.1`
fn version(
    command: &[String],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
) -> Result<String, SetupError> {
    let said = version_query::run(command, &["--version"], environment, passed, &[])?;
    let version = said.split("CP2K version ").nth(1).and_then(|rest| rest.split_whitespace().next());
    version.map(str::to_owned).ok_or_else(|| {
        version_query::wrong_program(command, "is not CP2K: it does not say its version".into())
    })
}

/// CP2K, ready to be used.
#[derive(Clone, Debug)]
pub struct Cp2k {
    settings: Settings,
    environment: BTreeMap<String, String>,
    version: String,
    kinds: BTreeMap<Species, Kind>,
}

impl Cp2k {
    fn kind(&self, species: Species) -> Result<&Kind, SetupError> {
        self.kinds.get(&species).ok_or_else(|| data::missing(species, &self.settings))
    }

    /// Valence electrons of a structure; unknown elements have none.
    fn electrons(&self, structure: &Structure) -> f64 {
        structure.species.iter().filter_map(|species| self.kinds.get(species)).map(|kind| kind.valence).sum()
    }
}

impl DftBackend for Cp2k {
    fn identity(&self) -> Value {
        let hashes: BTreeMap<&str, String> =
            self.kinds.iter().map(|(species, kind)| (species.symbol(), kind.entries.hash())).collect();
        // Destructured, so that a new setting is not forgotten here.
        let Settings {
            command: _,
            environment: _,
            pseudopotentials: _,
            variants: _,
            basis,
            cutoff,
            relative_cutoff,
            k_spacing,
            smearing_width,
            spin,
            moments,
            density_tolerance,
            steps: _,
            vacuum,
        } = &self.settings;
        json!({
            "code": "cp2k", "version": self.version, "recipe": INPUT_VERSION, "functional": "PBE", "basis": basis,
            "cutoff": cutoff, "relative_cutoff": relative_cutoff, "k_spacing": k_spacing,
            "smearing": "fermi_dirac", "smearing_width": smearing_width, "spin": spin, "moments": moments,
            "density_tolerance": density_tolerance, "vacuum": vacuum, "pseudopotentials": hashes,
        })
    }

    fn supports(&self, species: &BTreeSet<Species>) -> Result<(), SetupError> {
        species.iter().try_for_each(|species| self.kind(*species).map(|_| ()))
    }

    fn input(
        &self,
        structure: &Structure,
        adjustments: &BTreeSet<RetryAdjustment>,
    ) -> Result<Input, Failure> {
        input::write(self, &PaddedStructure::new(structure, self.settings.vacuum)?, adjustments)
    }

    fn read(&self, structure: &Structure, directory: &Path, exit: Exit) -> Result<Results, Failure> {
        let padded = PaddedStructure::new(structure, self.settings.vacuum)?;
        match output::read(&padded.structure, directory, &self.version)? {
            Some(calculated) => Ok(padded.without_padding_stress(calculated)),
            None => Err(validation::failure_without_result(exit, directory, &[OUTPUT, "stdout", "stderr"])),
        }
    }

    fn size(&self, structure: &Structure) -> Size {
        let Settings { vacuum, k_spacing, .. } = self.settings;
        padded_structure::size(structure, vacuum, k_spacing, self.electrons(structure))
    }
}
