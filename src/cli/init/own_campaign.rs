//! The options of a user's own campaign.

use std::path::{Path, PathBuf};

use super::label_kind::InitLabelKind;
use crate::exit_status::CommandError;

/// The options of a campaign of one's own.
#[derive(Debug, Default, clap::Args)]
pub struct OwnCampaignArgs {
    /// GRACE model that drives the walks (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    pub model: Option<PathBuf>,
    /// CALM artifact of the model (gmm_artifacts.npz). Without it, the mixture in the model file grades structures, but calmwalk cannot
    /// update it
    #[arg(long, value_name = "ARTIFACT.npz")]
    pub artifact: Option<PathBuf>,
    /// Seed structures, extended XYZ or POSCAR
    #[arg(long, value_name = "FILES", num_args = 1..)]
    pub structures: Vec<PathBuf>,
    /// What makes labels
    #[arg(long, value_name = "KIND")]
    pub label: Option<InitLabelKind>,
    /// What the labels come from. potential: its file (.npz, .eam.alloy, .eam.fs, .sw), required; vasp, abinit, gpaw, cp2k,
    /// espresso: the directory of pseudopotentials; ase: the Python file with calculator(); command: the script
    #[arg(long, value_name = "PATH")]
    pub label_source: Option<PathBuf>,
    /// List every key, those with default values commented out
    #[arg(long)]
    pub full: bool,
}

/// A campaign of which all options are known.
pub struct OwnCampaign {
    /// GRACE model.
    pub model: PathBuf,
    /// CALM artifact.
    pub artifact: Option<PathBuf>,
    /// Files of seed structures.
    pub structures: Vec<PathBuf>,
    /// What makes labels.
    pub label: InitLabelKind,
    /// What the labels come from.
    pub label_source: Option<PathBuf>,
    /// Whether every key is listed.
    pub full: bool,
}

impl OwnCampaignArgs {
    /// Whether any of the options is given.
    pub fn is_given(&self) -> bool {
        let Self { model, artifact, structures, label, label_source, full } = self;
        let paths = [model, artifact, label_source];
        paths.iter().any(|path| path.is_some()) || !structures.is_empty() || label.is_some() || *full
    }

    /// The options that are needed and not given.
    pub fn missing(&self) -> Vec<&'static str> {
        let needs_source = self.label == Some(InitLabelKind::Potential) && self.label_source.is_none();
        let options = [
            ("--model", self.model.is_none()),
            ("--structures", self.structures.is_empty()),
            ("--label", self.label.is_none()),
            ("--label-source", needs_source),
        ];
        options.into_iter().filter(|(_, is_missing)| *is_missing).map(|(option, _)| option).collect()
    }
}

impl OwnCampaign {
    /// Checks that the files exist, and that another potential than the model makes labels.
    pub fn check(&self) -> Result<(), CommandError> {
        let options = [("--artifact", &self.artifact), ("--label-source", &self.label_source)];
        let options = options.into_iter().filter_map(|(option, path)| Some((option, path.as_ref()?)));
        let structures = self.structures.iter().map(|path| ("--structures", path));
        for (option, path) in options.chain(structures).chain([("--model", &self.model)]) {
            check_readable(path).map_err(|problem| CommandError::Input(format!("{option}: {problem}")))?;
        }
        let canonical = |path: &PathBuf| path.canonicalize().ok();
        let source = self.label_source.as_ref().and_then(canonical);
        if self.label == InitLabelKind::Potential && source == canonical(&self.model) {
            return Err(CommandError::Input(format!(
                "--label-source: {} is the model itself, so all labels would agree with it; expected another potential",
                self.model.display()
            )));
        }
        Ok(())
    }
}

/// Checks that there is a file or directory.
pub fn check_readable(path: &Path) -> Result<(), String> {
    std::fs::metadata(path).map(drop).map_err(|error| format!("cannot read {}: {error}", path.display()))
}
