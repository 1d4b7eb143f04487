//! The programs that can be chosen, each with its settings.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::{DftBackend, PassedEnvironment, SetupError, abinit, ase, command, cp2k, gpaw, vasp};

/// Which program makes labels, and how: `[label.method.<name>]` of a campaign.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Settings {
    /// ABINIT.
    Abinit(abinit::Settings),
    /// A calculator of ASE's.
    Ase(ase::Settings),
    /// A program of the user's.
    Command(command::Settings),
    /// CP2K.
    Cp2k(cp2k::Settings),
    /// GPAW.
    Gpaw(gpaw::Settings),
    /// VASP.
    Vasp(vasp::Settings),
}

impl Settings {
    /// Name of each.
    pub const NAMES: [&str; 6] = ["abinit", "ase", "command", "cp2k", "gpaw", "vasp"];

    /// The program's name, as a configuration writes it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Abinit(_) => "abinit",
            Self::Ase(_) => "ase",
            Self::Command(_) => "command",
            Self::Cp2k(_) => "cp2k",
            Self::Gpaw(_) => "gpaw",
            Self::Vasp(_) => "vasp",
        }
    }

    /// Every path among the settings, to be resolved from the directory of the configuration.
    pub fn paths(&mut self) -> Vec<&mut PathBuf> {
        match self {
            Self::Abinit(settings) => vec![&mut settings.pseudopotentials],
            Self::Ase(settings) => vec![&mut settings.calculator],
            Self::Command(settings) => settings.files.iter_mut().collect(),
            Self::Cp2k(settings) => vec![&mut settings.pseudopotentials],
            Self::Gpaw(settings) => settings.pseudopotentials.iter_mut().collect(),
            Self::Vasp(settings) => vec![&mut settings.pseudopotentials],
        }
    }

    /// Finds the program, its version and its pseudopotentials. A program that is asked gets these variables of the environment
    /// of this process.
    ///
    /// # Errors
    /// What is missing or impossible, before anything is run.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Box<dyn DftBackend>, SetupError> {
        Ok(match self {
            Self::Abinit(settings) => Box::new(settings.prepare(passed)?),
            Self::Ase(settings) => Box::new(settings.prepare(passed)?),
            Self::Command(settings) => Box::new(settings.prepare()?),
            Self::Cp2k(settings) => Box::new(settings.prepare(passed)?),
            Self::Gpaw(settings) => Box::new(settings.prepare(passed)?),
            Self::Vasp(settings) => Box::new(settings.prepare()?),
        })
    }
}
