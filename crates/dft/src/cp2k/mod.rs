//! CP2K (Quickstep) with Gaussian basis sets (MOLOPT) and GTH pseudopotentials, for large cells.
//!
//! Spin-polarised PBE with Fermi–Dirac occupations. The energy is the free energy. The magnetic moment of the
//! cell is unconstrained; moments of atoms are Mulliken's. Non-periodic directions get vacuum; such structures
//! have no stress.
//!
//! Adjustments of a retry:
//! - more steps: three times as many;
//! - slower mixing: mixes one fifth of the new density instead of two fifths;
//! - another algorithm: Broyden mixing with a history of 4 densities instead of 8, which takes another path;
//! - other moments: half of the initial moments.

mod data;
mod input;
mod output;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use atoms::{Species, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::checks::{at_least, positive};
use crate::moments::InitialMagneticMoments;
use crate::padded_structure::{self, PaddedStructure};
use crate::{
    CalculationInput, CalculationResults, CalculationSize, DftBackend, Exit, Failure, PassedEnvironment,
    RetryAdjustment, SetupError, validation, version_query,
};
use data::AtomicKind;

/// eV, the value in CP2K (CODATA 2006).
const HARTREE: f64 = 27.211_383_856_556_3;

/// Å, the value in CP2K (CODATA 2006).
const BOHR: f64 = 0.529_177_208_59;

/// Name of the output file.
const OUTPUT: &str = "run.out";

/// Version of the generated input; raised when a change affects label values.
const INPUT_VERSION: u32 = 1;

/// Smaller cutoffs, eV, cannot represent any pseudopotential: the value was meant in Rydberg.
const MIN_CUTOFF: f64 = 1000.0;

/// The settings of `[label.method.cp2k]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Cp2kSettings {
    /// CP2K with its launcher: `["mpirun", "-np", "4", "cp2k"]`.
    pub command: Vec<String>,
    /// Additional environment variables. Default: `OMP_NUM_THREADS=1`.
    pub environment: BTreeMap<String, String>,
    /// Directory with `BASIS_MOLOPT` and `GTH_POTENTIALS`.
    pub pseudopotentials: PathBuf,
    /// Pseudopotentials other than `GTH-PBE`: `{ W = "GTH-PBE-q6" }`.
    pub pseudopotential_variants: BTreeMap<Species, String>,
    /// Basis set of all elements.
    pub basis: String,
    /// Cutoff of the finest grid, eV (8163 eV are 600 Ry).
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub cutoff: f64,
    /// Cutoff for a Gaussian of exponent 1, eV (816 eV are 60 Ry).
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub relative_cutoff: f64,
    /// Largest spacing of k-points, Å⁻¹, including 2π; the mesh is Γ-centred.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub k_spacing: f64,
    /// k_B T of the Fermi–Dirac occupation, eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub smearing_width: f64,
    /// Whether the calculation is spin-polarised.
    pub spin_polarized: bool,
    /// Initial magnetic moment of each element, μ_B. Default: 1.
    pub initial_magnetic_moments: InitialMagneticMoments,
    /// CP2K's `EPS_SCF`: tolerance of the density between electronic steps.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub density_tolerance: f64,
    /// Maximum number of electronic steps.
    #[schemars(range(min = 1))]
    pub max_scf_steps: u32,
    /// Vacuum along non-periodic directions, Å.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub vacuum: f64,
}

impl Default for Cp2kSettings {
    fn default() -> Self {
        Self {
            command: vec!["cp2k".into()],
            environment: BTreeMap::new(),
            pseudopotentials: "/usr/share/cp2k".into(),
            pseudopotential_variants: BTreeMap::new(),
            basis: "DZVP-MOLOPT-SR-GTH".into(),
            cutoff: 8163.0,
            relative_cutoff: 816.0,
            k_spacing: 0.125,
            smearing_width: 0.1,
            spin_polarized: true,
            initial_magnetic_moments: InitialMagneticMoments::new(),
            density_tolerance: 1e-7,
            max_scf_steps: 200,
            vacuum: 10.0,
        }
    }
}

impl Cp2kSettings {
    /// Queries CP2K's version and finds pseudopotentials and basis sets.
    ///
    /// # Errors
    /// A program that does not answer, an invalid setting, missing data files.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Cp2k, SetupError> {
        at_least("cutoff", self.cutoff, MIN_CUTOFF)?;
        positive("cutoff", self.cutoff)?;
        positive("relative_cutoff", self.relative_cutoff)?;
        positive("k_spacing", self.k_spacing)?;
        positive("smearing_width", self.smearing_width)?;
        positive("density_tolerance", self.density_tolerance)?;
        positive("vacuum", self.vacuum)?;
        at_least("max_scf_steps", self.max_scf_steps, 1)?;
        let kinds = data::find(self)?;
        let environment = version_query::environment(&self.environment);
        let version = version(&self.command, &environment, passed)?;
        Ok(Cp2k { settings: self.clone(), environment, version, kinds })
    }
}

/// The version, such as `2023.1`.
pub(crate) fn version(
    command: &[String],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
) -> Result<String, SetupError> {
    let said = version_query::run(command, &["--version"], environment, passed, &[])?;
    let version = said.split("CP2K version ").nth(1).and_then(|rest| rest.split_whitespace().next());
    version
        .map(str::to_owned)
        .ok_or_else(|| version_query::wrong_program(command, "is not CP2K: it reports no version".into()))
}

/// A configured CP2K.
#[derive(Clone, Debug)]
pub struct Cp2k {
    settings: Cp2kSettings,
    environment: BTreeMap<String, String>,
    version: String,
    kinds: BTreeMap<Species, AtomicKind>,
}

impl Cp2k {
    fn kind(&self, species: Species) -> Result<&AtomicKind, SetupError> {
        self.kinds.get(&species).ok_or_else(|| data::missing(species, &self.settings))
    }

    /// Valence electrons of a structure; unknown elements count none.
    fn electrons(&self, structure: &Structure) -> f64 {
        structure.species.iter().filter_map(|species| self.kinds.get(species)).map(|kind| kind.valence).sum()
    }
}

impl DftBackend for Cp2k {
    fn identity(&self) -> Value {
        let hashes: BTreeMap<&str, String> =
            self.kinds.iter().map(|(species, kind)| (species.symbol(), kind.entries.hash())).collect();
        // Destructure, so that a new setting cannot be forgotten here.
        let Cp2kSettings {
            command: _,
            environment: _,
            pseudopotentials: _,
            pseudopotential_variants: _,
            basis,
            cutoff,
            relative_cutoff,
            k_spacing,
            smearing_width,
            spin_polarized: spin,
            initial_magnetic_moments: moments,
            density_tolerance,
            max_scf_steps: _,
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
    ) -> Result<CalculationInput, Failure> {
        input::write(self, &PaddedStructure::new(structure, self.settings.vacuum)?, adjustments)
    }

    fn read(
        &self,
        structure: &Structure,
        directory: &Path,
        exit: Exit,
    ) -> Result<CalculationResults, Failure> {
        let padded = PaddedStructure::new(structure, self.settings.vacuum)?;
        match output::read(&padded.structure, directory, &self.version)? {
            Some(calculated) => Ok(padded.without_padding_stress(calculated)),
            None => Err(validation::failure_without_result(exit, directory, &[OUTPUT, "stdout", "stderr"])),
        }
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        let Cp2kSettings { vacuum, k_spacing, .. } = self.settings;
        padded_structure::size(structure, vacuum, k_spacing, self.electrons(structure))
    }
}
