//! `calmwalk init`

mod create;
mod label_kind;
mod label_section;
mod one_phase;
mod own_campaign;
mod questions;
mod suggestion;
mod text;
mod written_section;

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use super::{CommandError, ExitStatus};
use crate::config::schema_text;
use crate::output::print;
use own_campaign::OwnCampaignArgs;

/// Create the campaign.toml of your own campaign, or a small example that runs
///
/// With --model, --structures and --label, writes a configuration of about twenty keys, with units and usual ranges in comments. Suggests
/// temperatures, τ, supercells, ZBL windows and collection rule from model and structures. On a terminal, asks for missing options.
/// Complete the values that begin with FILL IN, such as the version of VASP; `calmwalk validate` refuses them until then. Paths are
/// relative to DIR for files below it, absolute for others.
///
/// Without these options, writes a small example with all of its files, which lists every key.
///
/// Also writes campaign.schema.json, with which an editor completes and checks campaign.toml. Never overwrites existing files.
#[derive(Debug, clap::Args)]
pub struct InitArgs {
    /// Directory for the files; created if it does not exist
    #[arg(value_name = "DIR")]
    directory: PathBuf,
    #[command(flatten)]
    own: OwnCampaignArgs,
}

macro_rules! example {
    ($path:literal) => {
        ($path, include_bytes!(concat!("../../configs/", $path)).as_slice())
    };
}

/// The example campaign and its files, from `configs/`.
const CAMPAIGN: &[u8] = include_bytes!("../../configs/aluminium.toml");
const FILES: [(&str, &[u8]); 11] = [
    example!("data/al_eam_1l/kokkos.npz"),
    example!("data/al_eam_1l/gmm_artifacts.npz"),
    example!("data/al_eam_1l/seed_frames.extxyz"),
    example!("data/aluminium_seeds.extxyz"),
    example!("data/Al_mm.eam.fs"),
    example!("data/aluminium_tests/cold.extxyz"),
    example!("data/aluminium_tests/hot.extxyz"),
    example!("data/aluminium_tests/liquid.extxyz"),
    example!("data/aluminium_tests/surface.extxyz"),
    example!("data/aluminium_tests/vacancy.extxyz"),
    example!("data/aluminium_tests/cold-dynamics.extxyz"),
];

/// Name of the configuration.
const CONFIG: &str = "campaign.toml";

/// The schema of the configuration, and the line by which editors find it.
const SCHEMA: &str = "campaign.schema.json";
const SCHEMA_LINE: &str = "#:schema ./campaign.schema.json\n\n";

impl InitArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        if self.own.is_given() {
            return create::create(&self.directory, self.own);
        }
        let config = self.directory.join(CONFIG);
        let written = [SCHEMA_LINE.as_bytes(), CAMPAIGN].concat();
        write_all(&self.directory, FILES.into_iter().chain([(CONFIG, &written[..])]))?;
        print(|out| {
            writeln!(out, "created {} and the files it refers to; next:", config.display())?;
            writeln!(out, "  calmwalk run {}", config.display())?;
            writeln!(out, "  calmwalk status {}", self.directory.display())
        })?;
        Ok(ExitStatus::Done)
    }
}

/// Writes these files, and the schema, into the directory.
///
/// # Errors
/// One of them exists, in which case none is written.
fn write_all<'a>(
    directory: &Path,
    files: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> Result<(), CommandError> {
    let schema = schema_text();
    let mut files: Vec<(PathBuf, &[u8])> =
        files.into_iter().map(|(path, content)| (directory.join(path), content)).collect();
    files.push((directory.join(SCHEMA), schema.as_bytes()));
    refuse_existing(files.iter().map(|(path, _)| path.as_path()))?;
    files.iter().try_for_each(|(path, content)| write(path, content))
}

fn refuse_existing<'a>(mut paths: impl Iterator<Item = &'a Path>) -> Result<(), CommandError> {
    match paths.find(|path| path.exists()) {
        Some(existing) => {
            let existing = existing.display();
            Err(CommandError::Input(format!(
                "{existing} already exists: choose another directory or remove the file"
            )))
        }
        None => Ok(()),
    }
}

fn write(path: &Path, content: &[u8]) -> Result<(), CommandError> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory)
        .and_then(|()| File::create_new(path)?.write_all(content))
        .map_err(|error| CommandError::Failed(format!("cannot write {}: {error}", path.display())))
}
