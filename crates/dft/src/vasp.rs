//! VASP with the user's own POTCAR files.
//!
//! Spin-polarised PBE with PAW potentials; the defaults are the protocol of the paper. The energy is the free
//! energy. Numbers come from `vasprun.xml` or, if that is truncated, from a complete `OUTCAR`; moments always
//! come from `OUTCAR`. VASP's files group atoms by element; results are returned in the structure's order.
//! Non-periodic directions get vacuum; such structures have no stress.
//!
//! Adjustments of a retry:
//! - more steps: three times as many;
//! - slower mixing: almost linear (`BMIX` 0.0001) with a tenth of the new density;
//! - another algorithm: conjugate gradients for all bands at once (`ALGO = All`), without mixing;
//! - other moments: half of the initial moments;
//! - more memory: all processes share each k-point (`KPAR = 1`).

mod element_table;
mod fixed_width;
mod incar;
mod outcar;
mod output;
mod potcar;
#[cfg(test)]
mod real_output_tests;
mod result;
mod vasprun;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use atoms::poscar::write_poscar;
use atoms::{Species, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::checks::{at_least, positive};
use crate::moments::{self, InitialMagneticMoments};
use crate::padded_structure::{self, PaddedStructure};
use crate::{
    CalculationInput, CalculationResults, CalculationSize, DftBackend, Exit, Failure, FailureClass,
    RetryAdjustment, SetupError, Smearing, executable, version_query,
};
use potcar::Potcar;

pub use element_table::ElementTable;

/// Version of the generated input; raised when a change affects label values.
const INPUT_VERSION: u32 = 1;

/// The settings of `[label.method.vasp]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[schemars(extend("required" = ["version", "pseudopotentials"]))]
pub struct VaspSettings {
    /// VASP with its launcher: `["mpirun", "-np", "16", "vasp_std"]`.
    pub command: Vec<String>,
    /// Additional environment variables. Default: `OMP_NUM_THREADS=1`.
    pub environment: BTreeMap<String, String>,
    /// Version of VASP, `"5.4.4"`. VASP cannot report it before a calculation; each output is checked against
    /// it. Required.
    pub version: String,
    /// Directory of the POTCAR files: `Al_pv/POTCAR`, `POTCAR.Al_pv` or `Al_pv`. Required.
    pub pseudopotentials: PathBuf,
    /// Table of the potentials and initial moments of the elements: `"MPRelaxSet"`, or `{ file = "mine.toml" }`.
    /// Entries of `pseudopotential_variants` and `initial_magnetic_moments` come before those of the table.
    /// Default: none.
    pub element_table: Option<ElementTable>,
    /// With `element_table`: the elements that may occur, besides those of `pseudopotential_variants`. Default:
    /// all of the table.
    #[schemars(with = "Vec<String>")]
    pub elements: Vec<Species>,
    /// The potential of each element that may occur: `{ Al = "Al", Fe = "Fe_pv" }`. Required without
    /// `element_table`.
    pub pseudopotential_variants: BTreeMap<Species, String>,
    /// Plane-wave cutoff, eV (`ENCUT`).
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub cutoff: f64,
    /// Largest spacing of k-points, Å⁻¹, including 2π; the mesh is Γ-centred.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub k_spacing: f64,
    /// Occupation function of the electronic states (`ISMEAR`).
    pub smearing: Smearing,
    /// Width of the smearing, eV (`SIGMA`).
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub smearing_width: f64,
    /// Whether the calculation is spin-polarised (`ISPIN`).
    pub spin_polarized: bool,
    /// Initial magnetic moment of each element, μ_B (`MAGMOM`). Default: 1.
    pub initial_magnetic_moments: InitialMagneticMoments,
    /// Tolerance of the energy in the last electronic step, eV (`EDIFF`).
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub energy_tolerance: f64,
    /// Maximum number of electronic steps (`NELM`).
    #[schemars(range(min = 1))]
    pub max_scf_steps: u32,
    /// Vacuum along non-periodic directions, Å.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub vacuum: f64,
    /// Number of process groups that share the k-points (`KPAR`).
    #[schemars(range(min = 1))]
    pub kpar: u32,
    /// Number of processes that share a band (`NCORE`).
    #[schemars(range(min = 1))]
    pub ncore: u32,
    /// Further INCAR tags, part of the protocol: `{ LASPH = ".TRUE." }`.
    pub tags: BTreeMap<String, String>,
}

impl Default for VaspSettings {
    fn default() -> Self {
        Self {
            command: vec!["vasp_std".into()],
            environment: BTreeMap::new(),
            version: String::new(),
            pseudopotentials: PathBuf::new(),
            element_table: None,
            elements: Vec::new(),
            pseudopotential_variants: BTreeMap::new(),
            cutoff: 500.0,
            k_spacing: 0.125,
            smearing: Smearing::Gaussian,
            smearing_width: 0.1,
            spin_polarized: true,
            initial_magnetic_moments: InitialMagneticMoments::new(),
            energy_tolerance: 1e-6,
            max_scf_steps: 100,
            vacuum: 10.0,
            kpar: 1,
            ncore: 1,
            tags: BTreeMap::new(),
        }
    }
}

impl VaspSettings {
    /// Finds the program and reads the POTCAR files.
    ///
    /// # Errors
    /// A missing program, a POTCAR file that is missing or does not match its name, an invalid setting.
    pub fn prepare(&self) -> Result<Vasp, SetupError> {
        positive("cutoff", self.cutoff)?;
        positive("k_spacing", self.k_spacing)?;
        positive("smearing_width", self.smearing_width)?;
        positive("energy_tolerance", self.energy_tolerance)?;
        positive("vacuum", self.vacuum)?;
        at_least("max_scf_steps", self.max_scf_steps, 1)?;
        at_least("kpar", self.kpar, 1)?;
        at_least("ncore", self.ncore, 1)?;
        let needed = |key, missing: bool, expected: &str| match missing {
            true => {
                Err(SetupError::Setting { key, found: "nothing".to_owned(), expected: expected.to_owned() })
            }
            false => Ok(()),
        };
        needed("version", self.version.is_empty(), "the version of your VASP, such as \"5.4.4\"")?;
        needed(
            "pseudopotentials",
            self.pseudopotentials.as_os_str().is_empty(),
            "the directory of your POTCAR files",
        )?;
        needed(
            "pseudopotential_variants",
            self.pseudopotential_variants.is_empty() && self.element_table.is_none(),
            "the potential of each element, such as { Al = \"Al\" }, or an element_table",
        )?;
        self.check_elements()?;
        needed(
            "command",
            self.command.is_empty(),
            "VASP, such as [\"mpirun\", \"-np\", \"16\", \"vasp_std\"]",
        )?;
        incar::check(self)?;
        executable::find(&self.command[0])?;
        let settings = match &self.element_table {
            Some(table) => table.fill(self)?,
            None => self.clone(),
        };
        let potcars = settings.pseudopotential_variants.iter().map(|(species, variant)| {
            let potcar = Potcar::find(&self.pseudopotentials, *species, variant);
            Ok((*species, potcar.map_err(|error| self.with_table(error, *species, variant))?))
        });
        Ok(Vasp { potcars: potcars.collect::<Result<_, _>>()?, settings })
    }

    /// All paths in the settings.
    pub(crate) fn paths(&mut self) -> Vec<&mut PathBuf> {
        let table = match &mut self.element_table {
            Some(ElementTable::File(path)) => Some(path),
            _ => None,
        };
        [&mut self.pseudopotentials].into_iter().chain(table).collect()
    }

    fn check_elements(&self) -> Result<(), SetupError> {
        if self.element_table.is_some() || self.elements.is_empty() {
            return Ok(());
        }
        Err(SetupError::Setting {
            key: "elements",
            found: "elements without an element_table".to_owned(),
            expected: "an element_table, such as \"MPRelaxSet\", or each element in pseudopotential_variants"
                .to_owned(),
        })
    }

    /// Names the table if it has selected this potential.
    fn with_table(&self, error: SetupError, species: Species, variant: &str) -> SetupError {
        match (error, &self.element_table) {
            (SetupError::Pseudopotential { reason, .. }, Some(table))
                if !self.pseudopotential_variants.contains_key(&species) =>
            {
                let hint = "or list the elements that may occur in `elements`";
                let reason = format!("{table} selects {variant}, but {reason}, {hint}");
                SetupError::Pseudopotential { species, reason }
            }
            (error, _) => error,
        }
    }
}

/// A configured VASP.
#[derive(Clone, Debug)]
pub struct Vasp {
    settings: VaspSettings,
    potcars: BTreeMap<Species, Potcar>,
}

impl Vasp {
    fn potcar(&self, species: Species) -> Result<&Potcar, SetupError> {
        self.potcars.get(&species).ok_or_else(|| {
            let reason = format!(
                "none is selected; name one in `pseudopotential_variants`, such as {species} = \"{species}\""
            );
            SetupError::Pseudopotential { species, reason }
        })
    }
}

impl DftBackend for Vasp {
    fn identity(&self) -> Value {
        let potcar = |(species, potcar): (&Species, &Potcar)| {
            (species.symbol(), json!({ "title": potcar.title, "hash": potcar.hash }))
        };
        let pseudopotentials: BTreeMap<&str, Value> = self.potcars.iter().map(potcar).collect();
        // Destructure, so that a new setting cannot be forgotten here.
        let VaspSettings {
            command: _,
            environment: _,
            version,
            pseudopotentials: _,
            element_table: _,
            elements: _,
            pseudopotential_variants: _,
            cutoff,
            k_spacing,
            smearing,
            smearing_width,
            spin_polarized: spin,
            initial_magnetic_moments: moments,
            energy_tolerance,
            max_scf_steps: _,
            vacuum,
            kpar: _,
            ncore: _,
            tags,
        } = &self.settings;
        json!({
            "code": "vasp", "version": version, "recipe": INPUT_VERSION, "functional": "PBE", "precision": "Accurate",
            "cutoff": cutoff, "k_spacing": k_spacing, "smearing": smearing, "smearing_width": smearing_width,
            "spin": spin, "moments": moments, "energy_tolerance": energy_tolerance, "vacuum": vacuum, "tags": tags,
            "pseudopotentials": pseudopotentials,
        })
    }

    fn supports(&self, species: &BTreeSet<Species>) -> Result<(), SetupError> {
        species.iter().try_for_each(|species| self.potcar(*species).map(drop))
    }

    fn input(
        &self,
        structure: &Structure,
        adjustments: &BTreeSet<RetryAdjustment>,
    ) -> Result<CalculationInput, Failure> {
        let padded = PaddedStructure::new(structure, self.settings.vacuum)?;
        let (poscar, order) = poscar(&padded.structure)?;
        let mut potcar = Vec::new();
        for species in order.chunk_by(|a, b| structure.species[*a] == structure.species[*b]) {
            let part = self.potcar(structure.species[species[0]]);
            potcar.extend(
                &part.map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?.content,
            );
        }
        let moments = moments::initial(structure, &self.settings.initial_magnetic_moments, adjustments);
        let moments: Vec<f64> = order.iter().map(|atom| moments[*atom]).collect();
        let k_spacing = self.settings.k_spacing;
        let files = [
            ("POSCAR", poscar),
            ("POTCAR", potcar),
            ("INCAR", incar::incar(&self.settings, &moments, adjustments).into_bytes()),
            ("KPOINTS", incar::kpoints(padded.mesh(k_spacing), k_spacing).into_bytes()),
        ];
        Ok(CalculationInput {
            files: files.map(|(name, content)| (name.to_owned(), content)).into(),
            command: self.settings.command.clone(),
            environment: version_query::environment(&self.settings.environment),
            ..CalculationInput::default()
        })
    }

    fn read(
        &self,
        structure: &Structure,
        directory: &Path,
        exit: Exit,
    ) -> Result<CalculationResults, Failure> {
        let padded = PaddedStructure::new(structure, self.settings.vacuum)?;
        let (_, order) = poscar(&padded.structure)?;
        let calculated = result::read(&padded.structure, &order, &self.settings.version, directory, exit)?;
        Ok(padded.without_padding_stress(calculated))
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        let VaspSettings { vacuum, k_spacing, .. } = self.settings;
        let potcars = structure.species.iter().filter_map(|species| self.potcars.get(species));
        padded_structure::size(structure, vacuum, k_spacing, potcars.map(|potcar| potcar.valence).sum())
    }
}

/// POSCAR, and the order of its atoms.
fn poscar(structure: &Structure) -> Result<(Vec<u8>, Vec<usize>), Failure> {
    let mut text = Vec::new();
    let order = write_poscar(&mut text, structure, &structure.formula())
        .map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
    Ok((text, order))
}
