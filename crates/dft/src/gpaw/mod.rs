//! GPAW with plane waves and PAW setups, run by our script ([`SCRIPT`]).
//!
//! Spin-polarised PBE, no symmetry but time reversal. The energy is the free energy. Non-periodic directions
//! get vacuum; such structures have no stress.
//!
//! Adjustments of a retry:
//! - more steps: three times as many;
//! - slower mixing: Pulay mixing with β 0.02 instead of 0.05, a history of 8 densities instead of 5, and twice
//!   the weight of long waves;
//! - another algorithm: conjugate gradients instead of Davidson;
//! - other moments: half of the initial moments.

mod input;
mod setups;
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
    RetryAdjustment, SetupError, Smearing, script_output, validation, version_query,
};
use setups::Setup;

/// The script that runs GPAW.
pub const SCRIPT: &str = concat!(include_str!("../script.py"), include_str!("job.py"));

/// Version of the generated input; raised when a change affects label values.
const INPUT_VERSION: u32 = 1;

/// The settings of `[label.method.gpaw]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GpawSettings {
    /// A Python with GPAW and its launcher: `["mpirun", "-np", "4", "gpaw", "python"]`.
    pub command: Vec<String>,
    /// Additional environment variables. Default: `OMP_NUM_THREADS=1`.
    pub environment: BTreeMap<String, String>,
    /// Directory of the setups. Default: GPAW's own search path.
    pub pseudopotentials: Option<PathBuf>,
    /// Setups other than the default one of an element: `{ Ni = "10" }`.
    pub pseudopotential_variants: BTreeMap<Species, String>,
    /// Plane-wave cutoff, eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub cutoff: f64,
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
    /// Tolerance of the energy over the last three electronic steps, eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub energy_tolerance: f64,
    /// Tolerance of the forces in the last electronic step, eV/Å.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub force_tolerance: f64,
    /// Maximum number of electronic steps.
    #[schemars(range(min = 1))]
    pub max_scf_steps: u32,
    /// Vacuum along non-periodic directions, Å.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub vacuum: f64,
}

impl Default for GpawSettings {
    fn default() -> Self {
        Self {
            command: vec!["/usr/bin/python3".into()],
            environment: BTreeMap::new(),
            pseudopotentials: None,
            pseudopotential_variants: BTreeMap::new(),
            cutoff: 500.0,
            k_spacing: 0.125,
            smearing: Smearing::Gaussian,
            smearing_width: 0.1,
            spin_polarized: true,
            initial_magnetic_moments: InitialMagneticMoments::new(),
            energy_tolerance: 1e-6,
            force_tolerance: 1e-3,
            max_scf_steps: 200,
            vacuum: 10.0,
        }
    }
}

impl GpawSettings {
    /// Queries GPAW's version and finds the setups.
    ///
    /// # Errors
    /// A program that does not answer, an invalid setting.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Gpaw, SetupError> {
        positive("cutoff", self.cutoff)?;
        positive("k_spacing", self.k_spacing)?;
        positive("smearing_width", self.smearing_width)?;
        positive("energy_tolerance", self.energy_tolerance)?;
        positive("force_tolerance", self.force_tolerance)?;
        positive("vacuum", self.vacuum)?;
        at_least("max_scf_steps", self.max_scf_steps, 1)?;
        let environment = self.environment();
        let versions = GpawVersions::query(&self.command, &environment, passed)?;
        let setups = setups::find(&versions.setup_paths, &self.pseudopotential_variants)?;
        Ok(Gpaw { settings: self.clone(), environment, versions, setups })
    }

    fn environment(&self) -> BTreeMap<String, String> {
        let mut environment = version_query::environment(&self.environment);
        if let Some(directory) = &self.pseudopotentials {
            environment.insert("GPAW_SETUP_PATH".into(), directory.to_string_lossy().into_owned());
        }
        environment
    }
}

/// The versions and paths that GPAW reports.
#[derive(Clone, Debug, Deserialize)]
struct GpawVersions {
    gpaw: String,
    ase: String,
    setup_paths: Vec<PathBuf>,
}

impl GpawVersions {
    fn query(
        command: &[String],
        environment: &BTreeMap<String, String>,
        passed: &PassedEnvironment,
    ) -> Result<Self, SetupError> {
        let files = [(input::SCRIPT_FILE, SCRIPT.as_bytes())];
        let said = version_query::run(command, &[input::SCRIPT_FILE], environment, passed, &files)?;
        said.lines().rev().find_map(|line| serde_json::from_str(line).ok()).ok_or_else(|| {
            let reason = format!("is not a Python with GPAW: expected its version, found {:?}", said.trim());
            version_query::wrong_program(command, reason)
        })
    }
}

/// A configured GPAW.
#[derive(Clone, Debug)]
pub struct Gpaw {
    settings: GpawSettings,
    environment: BTreeMap<String, String>,
    versions: GpawVersions,
    setups: BTreeMap<Species, Setup>,
}

impl Gpaw {
    fn setup(&self, species: Species) -> Result<&Setup, SetupError> {
        self.setups.get(&species).ok_or_else(|| {
            setups::missing(species, &self.versions.setup_paths, &self.settings.pseudopotential_variants)
        })
    }

    /// Valence electrons of a structure; elements without a setup count none.
    fn electrons(&self, structure: &Structure) -> f64 {
        structure
            .species
            .iter()
            .filter_map(|species| self.setups.get(species))
            .map(|setup| setup.valence)
            .sum()
    }
}

impl DftBackend for Gpaw {
    fn identity(&self) -> Value {
        let hashes: BTreeMap<&str, &str> =
            self.setups.iter().map(|(species, setup)| (species.symbol(), setup.pinned.hash())).collect();
        // Destructure, so that a new setting cannot be forgotten here.
        let GpawSettings {
            command: _,
            environment: _,
            pseudopotentials: _,
            pseudopotential_variants: _,
            cutoff,
            k_spacing,
            smearing,
            smearing_width,
            spin_polarized: spin,
            initial_magnetic_moments: moments,
            energy_tolerance,
            force_tolerance,
            max_scf_steps: _,
            vacuum,
        } = &self.settings;
        json!({
            "code": "gpaw", "version": self.versions.gpaw, "ase": self.versions.ase, "recipe": INPUT_VERSION, "functional": "PBE",
            "cutoff": cutoff, "k_spacing": k_spacing, "smearing": smearing, "smearing_width": smearing_width,
            "spin": spin, "moments": moments, "energy_tolerance": energy_tolerance,
            "force_tolerance": force_tolerance, "vacuum": vacuum, "pseudopotentials": hashes,
        })
    }

    fn supports(&self, species: &BTreeSet<Species>) -> Result<(), SetupError> {
        for species in species {
            let valence = self.setup(*species)?.valence;
            let moment = self.settings.initial_magnetic_moments.get(species).copied().unwrap_or_default();
            if self.settings.spin_polarized && moment.abs() > valence {
                return Err(SetupError::Setting {
                    key: "initial_magnetic_moments",
                    found: format!("{species} = {moment}"),
                    expected: format!("at most its {valence} valence electrons"),
                });
            }
        }
        Ok(())
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
        let by = [("gpaw", self.versions.gpaw.as_str()), ("ase", self.versions.ase.as_str())];
        match script_output::read(&padded.structure, directory, &by)? {
            Some(calculated) => Ok(padded.without_padding_stress(calculated)),
            None => Err(validation::failure_without_result(exit, directory, &["stdout", "stderr"])),
        }
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        let GpawSettings { vacuum, k_spacing, .. } = self.settings;
        padded_structure::size(structure, vacuum, k_spacing, self.electrons(structure))
    }
}
