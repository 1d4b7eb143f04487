//! ABINIT with plane waves and norm-conserving pseudopotentials (psp8) or PAW setups (xml).
//!
//! Spin-polarised PBE, no symmetry but time reversal. The energy is the free energy; with PAW it is the
//! double-counting expression, as in ABINIT's own summary. Non-periodic directions get vacuum; such structures
//! have no stress.
//!
//! Adjustments of a retry:
//! - more steps: three times as many;
//! - slower mixing: mixes a quarter of the residual at first (default 0.7) with a history of 15 steps (default
//!   7);
//! - another algorithm: mixes densities instead of potentials (with PAW the reverse) and converges wave
//!   functions further in each step;
//! - other moments: half of the initial moments.

mod input;
mod output;
mod pseudopotentials;
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
    RetryAdjustment, SetupError, Smearing, validation, version_query,
};
use pseudopotentials::Pseudopotential;

/// eV (CODATA 2018).
const HARTREE: f64 = 27.211_386_245_988;

/// Version of the generated input; raised when a change affects label values.
const INPUT_VERSION: u32 = 1;

/// The settings of `[label.method.abinit]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AbinitSettings {
    /// ABINIT with its launcher: `["mpirun", "-np", "4", "abinit"]`.
    pub command: Vec<String>,
    /// Additional environment variables. Default: `OMP_NUM_THREADS=1`.
    pub environment: BTreeMap<String, String>,
    /// Directory of the pseudopotentials, `Si.psp8` or `Si.xml`.
    pub pseudopotentials: PathBuf,
    /// File names other than `Si.psp8` and `Si.xml`: `{ Zn = "Zn-sp.psp8" }`.
    pub pseudopotential_variants: BTreeMap<Species, String>,
    /// Plane-wave cutoff, eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub cutoff: f64,
    /// Cutoff of the fine PAW grid, eV. Default: twice `cutoff`.
    pub fine_cutoff: Option<f64>,
    /// Largest spacing of k-points, Å⁻¹, including 2π; the mesh is Γ-centred.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub k_spacing: f64,
    /// Occupation function of the electronic states.
    pub smearing: Smearing,
    /// Width of the smearing, eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub smearing_width: f64,
    /// Whether the calculation is spin-polarised.
    pub spin_polarized: bool,
    /// Initial magnetic moment of each element, μ_B. Default: 1.
    pub initial_magnetic_moments: InitialMagneticMoments,
    /// Tolerance of the energy between electronic steps, met twice in a row, eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub energy_tolerance: f64,
    /// Maximum number of electronic steps.
    #[schemars(range(min = 1))]
    pub max_scf_steps: u32,
    /// Vacuum along non-periodic directions, Å.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub vacuum: f64,
}

impl Default for AbinitSettings {
    fn default() -> Self {
        Self {
            command: vec!["abinit".into()],
            environment: BTreeMap::new(),
            pseudopotentials: "/usr/share/abinit/psp/Pseudodojo_nc_sr_04_pbe_standard_psp8".into(),
            pseudopotential_variants: BTreeMap::new(),
            cutoff: 1000.0,
            fine_cutoff: None,
            k_spacing: 0.125,
            smearing: Smearing::Gaussian,
            smearing_width: 0.1,
            spin_polarized: true,
            initial_magnetic_moments: InitialMagneticMoments::new(),
            energy_tolerance: 1e-6,
            max_scf_steps: 200,
            vacuum: 10.0,
        }
    }
}

impl AbinitSettings {
    /// Queries ABINIT's version and finds the pseudopotentials.
    ///
    /// # Errors
    /// A program that does not answer, an invalid setting, a file that does not match its name.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Abinit, SetupError> {
        positive("cutoff", self.cutoff)?;
        at_least("fine_cutoff", self.fine_cutoff.unwrap_or(self.cutoff), self.cutoff)?;
        positive("k_spacing", self.k_spacing)?;
        positive("smearing_width", self.smearing_width)?;
        positive("energy_tolerance", self.energy_tolerance)?;
        positive("vacuum", self.vacuum)?;
        at_least("max_scf_steps", self.max_scf_steps, 1)?;
        let environment = version_query::environment(&self.environment);
        let version = version(&self.command, &environment, passed)?;
        let pseudopotentials =
            pseudopotentials::find(&self.pseudopotentials, &self.pseudopotential_variants)?;
        Ok(Abinit { settings: self.clone(), environment, version, pseudopotentials })
    }
}

/// The version, such as `9.6.2`.
pub(crate) fn version(
    command: &[String],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
) -> Result<String, SetupError> {
    let said = version_query::run(command, &["--version"], environment, passed, &[])?;
    // Each process of a parallel run may print it.
    let version =
        said.split_whitespace().next().filter(|word| word.starts_with(|c: char| c.is_ascii_digit()));
    version.map(str::to_owned).ok_or_else(|| {
        version_query::wrong_program(
            command,
            format!("is not ABINIT: as its version it reports {:?}", said.trim()),
        )
    })
}

/// A configured ABINIT.
#[derive(Clone, Debug)]
pub struct Abinit {
    settings: AbinitSettings,
    environment: BTreeMap<String, String>,
    version: String,
    pseudopotentials: BTreeMap<Species, Pseudopotential>,
}

impl Abinit {
    /// The pseudopotentials of these elements. ABINIT requires that all are norm-conserving or all are PAW.
    fn matching_pseudopotentials(
        &self,
        species: &BTreeSet<Species>,
    ) -> Result<BTreeMap<Species, &Pseudopotential>, SetupError> {
        let AbinitSettings { pseudopotentials: directory, pseudopotential_variants, .. } = &self.settings;
        let mut chosen: BTreeMap<Species, &Pseudopotential> = BTreeMap::new();
        for species in species {
            let one = self.pseudopotentials.get(species);
            let one =
                one.ok_or_else(|| pseudopotentials::missing(*species, directory, pseudopotential_variants))?;
            if let Some((other, before)) = chosen.iter().find(|(_, before)| before.paw != one.paw) {
                let [file, before] = [one, before].map(|one| one.pinned.path().display());
                let reason = format!(
                    "{file} cannot be combined with {before} of {other}: one is PAW, the other is not"
                );
                return Err(SetupError::Pseudopotential { species: *species, reason });
            }
            chosen.insert(*species, one);
        }
        Ok(chosen)
    }
}

impl DftBackend for Abinit {
    fn identity(&self) -> Value {
        let hashes: BTreeMap<&str, &str> =
            self.pseudopotentials.iter().map(|(species, p)| (species.symbol(), p.pinned.hash())).collect();
        // Destructure, so that a new setting cannot be forgotten here.
        let AbinitSettings {
            command: _,
            environment: _,
            pseudopotentials: _,
            pseudopotential_variants: _,
            cutoff,
            fine_cutoff,
            k_spacing,
            smearing,
            smearing_width,
            spin_polarized: spin,
            initial_magnetic_moments: moments,
            energy_tolerance,
            max_scf_steps: _,
            vacuum,
        } = &self.settings;
        json!({
            "code": "abinit", "version": self.version, "recipe": INPUT_VERSION, "functional": "PBE", "cutoff": cutoff,
            "fine_cutoff": fine_cutoff, "k_spacing": k_spacing, "smearing": smearing,
            "smearing_width": smearing_width, "spin": spin, "moments": moments, "energy_tolerance": energy_tolerance,
            "vacuum": vacuum, "pseudopotentials": hashes,
        })
    }

    fn supports(&self, species: &BTreeSet<Species>) -> Result<(), SetupError> {
        self.matching_pseudopotentials(species).map(|_| ())
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
        match output::read(&padded.structure, directory, &self.version, self.settings.smearing)? {
            Some(calculated) => Ok(padded.without_padding_stress(calculated)),
            None => Err(validation::failure_without_result(exit, directory, &["stdout", "stderr"])),
        }
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        let AbinitSettings { vacuum, k_spacing, .. } = self.settings;
        let valence = structure.species.iter().filter_map(|species| self.pseudopotentials.get(species));
        padded_structure::size(structure, vacuum, k_spacing, valence.map(|p| p.valence).sum())
    }
}
