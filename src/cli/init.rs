//! `calmwalk init`

use std::fs;
use std::path::{Path, PathBuf};

use super::{CommandError, ExitStatus};
use crate::config::schema_text;
use crate::output::print;

/// Create a small runnable example with a commented campaign.toml
///
/// Also writes campaign.schema.json, which lets an editor complete and check campaign.toml.
#[derive(Debug, clap::Args)]
pub struct InitArgs {
    /// Directory for the files; created if it does not exist
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

macro_rules! example {
    ($path:literal) => {
        ($path, include_bytes!(concat!("../../configs/", $path)).as_slice())
    };
}

/// The example campaign and its files, from `configs/`.
const CAMPAIGN: &[u8] = include_bytes!("../../configs/aluminium.toml");
const FILES: [(&str, &[u8]); 5] = [
    example!("data/al_eam_1l/kokkos.npz"),
    example!("data/al_eam_1l/gmm_artifacts.npz"),
    example!("data/al_eam_1l/seed_frames.extxyz"),
    example!("data/aluminium_seeds.extxyz"),
    example!("data/Al_mm.eam.fs"),
];

/// The schema of the configuration, and the line by which editors find it.
const SCHEMA: &str = "campaign.schema.json";
const SCHEMA_LINE: &str = "#:schema ./campaign.schema.json\n\n";

impl InitArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let config = self.directory.join("campaign.toml");
        let written = [SCHEMA_LINE.as_bytes(), CAMPAIGN].concat();
        let schema = schema_text();
        let written = [("campaign.toml", &written[..]), (SCHEMA, schema.as_bytes())];
        let files: Vec<_> = FILES
            .into_iter()
            .chain(written)
            .map(|(path, content)| (self.directory.join(path), content))
            .collect();
        if let Some((existing, _)) = files.iter().find(|(path, _)| path.exists()) {
            let existing = existing.display();
            return Err(CommandError::Input(format!(
                "{existing} already exists: choose another directory or remove the file"
            )));
        }
        for (path, content) in &files {
            write(path, content)?;
        }
        print(|out| {
            writeln!(out, "created {} and the files it refers to; next:", config.display())?;
            writeln!(out, "  calmwalk run {}", config.display())?;
            writeln!(out, "  calmwalk status {}", self.directory.display())
        })?;
        Ok(ExitStatus::Done)
    }
}

fn write(path: &Path, content: &[u8]) -> Result<(), CommandError> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory)
        .and_then(|()| fs::write(path, content))
        .map_err(|error| CommandError::Failed(format!("cannot write {}: {error}", path.display())))
}
