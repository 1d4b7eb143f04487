//! `calmwalk init`

use std::fs;
use std::path::{Path, PathBuf};

use super::{ExitStatus, Failure};
use crate::output::print;

/// Write a commented campaign.toml and a small example that runs
#[derive(Debug, clap::Args)]
pub struct Init {
    /// Directory to write into; made if it does not exist
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

macro_rules! example {
    ($path:literal) => {
        ($path, include_bytes!(concat!("../../configs/", $path)).as_slice())
    };
}

/// The example campaign and its files, as they stand in `configs/`.
const CAMPAIGN: &[u8] = include_bytes!("../../configs/aluminium.toml");
const FILES: [(&str, &[u8]); 5] = [
    example!("data/al_eam_1l/kokkos.npz"),
    example!("data/al_eam_1l/gmm_artifacts.npz"),
    example!("data/al_eam_1l/seed_frames.extxyz"),
    example!("data/aluminium_seeds.extxyz"),
    example!("data/Al_mm.eam.fs"),
];

impl Init {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let config = self.directory.join("campaign.toml");
        let files = FILES.iter().map(|(path, content)| (self.directory.join(path), *content));
        let files: Vec<_> = files.chain([(config.clone(), CAMPAIGN)]).collect();
        if let Some((existing, _)) = files.iter().find(|(path, _)| path.exists()) {
            let existing = existing.display();
            return Err(Failure::Input(format!(
                "{existing} exists already: name another directory, or remove it"
            )));
        }
        for (path, content) in &files {
            write(path, content)?;
        }
        print(|out| {
            writeln!(out, "wrote {} and the files it names", config.display())?;
            writeln!(out, "run it with:     calmwalk run {}", config.display())?;
            writeln!(out, "look at it with: calmwalk status {}", self.directory.display())
        })?;
        Ok(ExitStatus::Done)
    }
}

fn write(path: &Path, content: &[u8]) -> Result<(), Failure> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory)
        .and_then(|()| fs::write(path, content))
        .map_err(|error| Failure::Failed(format!("cannot write {}: {error}", path.display())))
}
