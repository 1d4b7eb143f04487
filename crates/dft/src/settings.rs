//! The settings of each supported program.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{DftBackend, PassedEnvironment, SetupError, abinit, ase, command, cp2k, espresso, gpaw, vasp};

/// Which program makes labels, with its settings: `[label.method.<name>]` of a campaign.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DftSettings {
    /// ABINIT.
    Abinit(abinit::AbinitSettings),
    /// An ASE calculator.
    Ase(ase::AseSettings),
    /// A user's program.
    Command(command::CommandSettings),
    /// CP2K.
    Cp2k(cp2k::Cp2kSettings),
    /// Quantum ESPRESSO.
    Espresso(espresso::EspressoSettings),
    /// GPAW.
    Gpaw(gpaw::GpawSettings),
    /// VASP.
    Vasp(vasp::VaspSettings),
}

impl DftSettings {
    /// Names of the programs.
    pub const NAMES: [&str; 7] = ["abinit", "ase", "command", "cp2k", "espresso", "gpaw", "vasp"];

    /// The program's name in the configuration.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Abinit(_) => "abinit",
            Self::Ase(_) => "ase",
            Self::Command(_) => "command",
            Self::Cp2k(_) => "cp2k",
            Self::Espresso(_) => "espresso",
            Self::Gpaw(_) => "gpaw",
            Self::Vasp(_) => "vasp",
        }
    }

    /// All paths in the settings, to be resolved relative to the configuration.
    pub fn paths(&mut self) -> Vec<&mut PathBuf> {
        match self {
            Self::Abinit(settings) => vec![&mut settings.pseudopotentials],
            Self::Ase(settings) => vec![&mut settings.calculator],
            Self::Command(settings) => settings.files.iter_mut().collect(),
            Self::Cp2k(settings) => vec![&mut settings.pseudopotentials],
            Self::Espresso(settings) => vec![&mut settings.pseudopotentials],
            Self::Gpaw(settings) => settings.pseudopotentials.iter_mut().collect(),
            Self::Vasp(settings) => settings.paths(),
        }
    }

    /// Finds the program, its version and its pseudopotentials. Queries run with the variables `passed` from
    /// the current environment.
    ///
    /// # Errors
    /// Missing programs or files and invalid settings, before any calculation runs.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Box<dyn DftBackend>, SetupError> {
        Ok(match self {
            Self::Abinit(settings) => Box::new(settings.prepare(passed)?),
            Self::Ase(settings) => Box::new(settings.prepare(passed)?),
            Self::Command(settings) => Box::new(settings.prepare()?),
            Self::Cp2k(settings) => Box::new(settings.prepare(passed)?),
            Self::Espresso(settings) => Box::new(settings.prepare(passed)?),
            Self::Gpaw(settings) => Box::new(settings.prepare(passed)?),
            Self::Vasp(settings) => Box::new(settings.prepare()?),
        })
    }
}
