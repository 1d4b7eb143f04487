//! Quantum ESPRESSO (`pw.x`) with plane waves and pseudopotentials in the format UPF: norm-conserving, ultrasoft or
//! PAW.
//!
//! Spin-polarised PBE, no symmetry but time reversal. The energy is the free energy. Non-periodic directions get
//! vacuum; such structures have no stress. All numbers come from the printed output: version 6.7 writes its XML file
//! only together with all wave functions, which may have many GB.
//!
//! Adjustments of a retry:
//! - more steps: three times as many;
//! - slower mixing: mixes one fifth of the new density (default 0.7);
//! - another algorithm: conjugate gradients instead of Davidson, and a local Thomas–Fermi preconditioner of the
//!   mixing;
//! - other moments: half of the initial moments.

mod input;
mod output;
mod pseudopotentials;
#[cfg(test)]
mod tests;
mod upf;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use atoms::{Species, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::checks::{at_least, positive};
use crate::moments::{DEFAULT_MOMENT, InitialMagneticMoments};
use crate::padded_structure::{self, PaddedStructure};
use crate::{
    CalculationInput, CalculationResults, CalculationSize, DftBackend, Exit, Failure, PassedEnvironment,
    RetryAdjustment, SetupError, Smearing, validation, version_query,
};
use pseudopotentials::{SelectedUpf, UpfFile};

/// eV (CODATA 2018).
const RYDBERG: f64 = 13.605_693_122_994;

/// Version of the generated input; raised when a change affects label values.
const INPUT_VERSION: u32 = 1;

/// The settings of `[label.method.espresso]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EspressoSettings {
    /// `pw.x` with its launcher: `["mpirun", "-np", "4", "pw.x", "-nk", "2"]`.
    pub command: Vec<String>,
    /// Additional environment variables. Default: `OMP_NUM_THREADS=1`.
    pub environment: BTreeMap<String, String>,
    /// Directory of the pseudopotentials, such as `Si.UPF`.
    pub pseudopotentials: PathBuf,
    /// Files of elements for which the directory has several: `{ Fe = "Fe.pbe-nd-rrkjus.UPF" }`.
    pub pseudopotential_variants: BTreeMap<Species, String>,
    /// Plane-wave cutoff of the wave functions (ecutwfc), eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub cutoff: f64,
    /// Cutoff of the density (ecutrho), eV. Default: eight times `cutoff`.
    pub density_cutoff: Option<f64>,
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
    /// Tolerance of the estimated error of the cell's energy (conv_thr), eV.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub energy_tolerance: f64,
    /// Maximum number of electronic steps.
    #[schemars(range(min = 1))]
    pub max_scf_steps: u32,
    /// Vacuum along non-periodic directions, Å.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub vacuum: f64,
}

impl Default for EspressoSettings {
    fn default() -> Self {
        Self {
            command: vec!["pw.x".into()],
            environment: BTreeMap::new(),
            pseudopotentials: "/usr/share/espresso/pseudo".into(),
            pseudopotential_variants: BTreeMap::new(),
            cutoff: 1000.0,
            density_cutoff: None,
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

impl EspressoSettings {
    /// Queries the version of `pw.x` and finds the pseudopotentials.
    ///
    /// # Errors
    /// A program that does not answer, an invalid setting, a file in `pseudopotential_variants` that cannot be used.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Espresso, SetupError> {
        positive("cutoff", self.cutoff)?;
        positive("density_cutoff", self.density_cutoff())?;
        // The density has plane waves up to twice the largest wave vector of the wave functions.
        at_least("density_cutoff", self.density_cutoff(), 4.0 * self.cutoff)?;
        positive("k_spacing", self.k_spacing)?;
        positive("smearing_width", self.smearing_width)?;
        positive("energy_tolerance", self.energy_tolerance)?;
        positive("vacuum", self.vacuum)?;
        at_least("max_scf_steps", self.max_scf_steps, 1)?;
        let environment = version_query::environment(&self.environment);
        let version = version(&self.command, &environment, passed)?;
        let pseudopotentials =
            pseudopotentials::find(&self.pseudopotentials, &self.pseudopotential_variants)?;
        Ok(Espresso { settings: self.clone(), environment, version, pseudopotentials })
    }

    /// Cutoff of the density, eV. One value for all pseudopotentials keeps the energies of all structures comparable;
    /// ultrasoft and PAW need about this one.
    fn density_cutoff(&self) -> f64 {
        self.density_cutoff.unwrap_or(8.0 * self.cutoff)
    }
}

/// The version, such as `6.7MaX`. Without input, `pw.x` prints it and fails.
pub(crate) fn version(
    command: &[String],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
) -> Result<String, SetupError> {
    let said = version_query::run_without_input(command, environment, passed)?;
    output::stated_version(&said).map(str::to_owned).ok_or_else(|| {
        let first = said.lines().find(|line| !line.trim().is_empty()).unwrap_or("nothing").trim();
        version_query::wrong_program(
            command,
            format!("is not pw.x: expected 'Program PWSCF v.…', found: {first}"),
        )
    })
}

/// A configured Quantum ESPRESSO.
#[derive(Clone, Debug)]
pub struct Espresso {
    settings: EspressoSettings,
    environment: BTreeMap<String, String>,
    version: String,
    pseudopotentials: BTreeMap<Species, SelectedUpf>,
}

impl Espresso {
    fn pseudopotential(&self, species: Species) -> Result<&UpfFile, SetupError> {
        let EspressoSettings { pseudopotentials: directory, pseudopotential_variants, .. } = &self.settings;
        match self.pseudopotentials.get(&species) {
            Some(selected) => selected.as_ref().map_err(Clone::clone),
            None => Err(pseudopotentials::missing(species, directory, pseudopotential_variants)),
        }
    }

    /// Valence electrons of a structure; elements without a pseudopotential count none.
    fn electrons(&self, structure: &Structure) -> f64 {
        let usable = structure.species.iter().filter_map(|species| self.pseudopotential(*species).ok());
        usable.map(|pseudopotential| pseudopotential.valence).sum()
    }
}

impl DftBackend for Espresso {
    fn identity(&self) -> Value {
        let usable =
            self.pseudopotentials.iter().filter_map(|(species, p)| Some((species, p.as_ref().ok()?)));
        let hashes: BTreeMap<&str, &str> =
            usable.map(|(species, p)| (species.symbol(), p.pinned.hash())).collect();
        // Destructure, so that a new setting cannot be forgotten here.
        let EspressoSettings {
            command: _,
            environment: _,
            pseudopotentials: _,
            pseudopotential_variants: _,
            cutoff,
            density_cutoff: _,
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
            "code": "espresso", "version": self.version, "recipe": INPUT_VERSION, "functional": "PBE", "cutoff": cutoff,
            "density_cutoff": self.settings.density_cutoff(), "k_spacing": k_spacing, "smearing": smearing,
            "smearing_width": smearing_width, "spin": spin, "moments": moments, "energy_tolerance": energy_tolerance,
            "vacuum": vacuum, "pseudopotentials": hashes,
        })
    }

    fn supports(&self, species: &BTreeSet<Species>) -> Result<(), SetupError> {
        for species in species {
            let valence = self.pseudopotential(*species)?.valence;
            let moments = &self.settings.initial_magnetic_moments;
            let moment = moments.get(species).copied().unwrap_or(DEFAULT_MOMENT);
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
        match output::read(&padded.structure, directory, &self.version, &self.settings)? {
            Some(calculated) => Ok(padded.without_padding_stress(calculated)),
            None => Err(validation::failure_without_result(exit, directory, &["stdout", "stderr"])),
        }
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        let EspressoSettings { vacuum, k_spacing, .. } = self.settings;
        padded_structure::size(structure, vacuum, k_spacing, self.electrons(structure))
    }
}
