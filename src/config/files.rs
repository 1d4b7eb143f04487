//! Potentials that a configuration names: the label source and the potential of `calmwalk md`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::Potential;
use potentials::grace::{Grace, GraceModel};
use potentials::{Eam, EamStyle, StillingerWeber};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use toml::Spanned;

/// What a potential file holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PotentialKind {
    /// GRACE, the exported `kokkos.npz`.
    Grace,
    /// Embedded atom, setfl (`.eam.alloy`).
    EamAlloy,
    /// Embedded atom with Finnis–Sinclair densities, setfl (`.eam.fs`).
    EamFs,
    /// Stillinger–Weber (`.sw`).
    StillingerWeber,
}

/// `{ kind, file }`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PotentialConfig {
    /// Format of the file.
    pub kind: PotentialKind,
    /// Path of the potential file.
    #[schemars(with = "PathBuf")]
    pub file: Spanned<PathBuf>,
}

impl PotentialConfig {
    /// Reads it; an error names the file and what is wrong with it.
    pub fn load(&self) -> Result<Box<dyn Potential>, String> {
        self.kind.load(self.file.get_ref())
    }
}

impl PotentialKind {
    /// Reads a file of this kind; an error names the file and what is wrong with it.
    pub fn load(self, path: &Path) -> Result<Box<dyn Potential>, String> {
        let eam = |style| Eam::load_as(path, style).map(|p| Box::new(p) as Box<dyn Potential>);
        match self {
            Self::Grace => GraceModel::load(path)
                .map(|model| Box::new(Grace::new(Arc::new(model))) as Box<dyn Potential>)
                .map_err(|error| error.to_string()),
            Self::EamAlloy => eam(EamStyle::Alloy).map_err(|error| error.to_string()),
            Self::EamFs => eam(EamStyle::FinnisSinclair).map_err(|error| error.to_string()),
            Self::StillingerWeber => StillingerWeber::load(path)
                .map(|p| Box::new(p) as Box<dyn Potential>)
                .map_err(|error| error.to_string()),
        }
    }
}
