//! `calmwalk versions … export`

use std::fs;
use std::io::{Cursor, ErrorKind, Write};
use std::path::{Path, PathBuf};

use calm::build::ArtifactVersion;
use serde_json::json;
use store::Location;

use super::files::VersionSource;
use super::{CommandError, ExitStatus};
use crate::atomic_file::{AtomicFile, cannot_create, cannot_write};
use crate::mixture_files::open;
use crate::output::{print, print_json};
use crate::replay::RelocatedFilesArgs;
use crate::versions::{MIXTURE_FILE, MODEL_FILE};

/// Write the files of a version: its model and the artifact of its mixture
///
/// Writes kokkos.npz and gmm_artifacts.npz, byte for byte as the store has them; for version 0, copies of the campaign's files. The mixture
/// is the one with which the walks of the version began; `calmwalk calm export` writes it with the updates since. Never replaces a file
/// with other content.
#[derive(Debug, clap::Args)]
pub struct VersionsExportArgs {
    /// Number of the version; 0 is the potential of the configuration
    #[arg(value_name = "N")]
    number: u32,
    /// Directory for the files; created if it does not exist
    #[arg(long, value_name = "DIR")]
    output_dir: PathBuf,
    /// Also write a copy of the model with its mixture, for LAMMPS and calmwalk
    #[arg(long, value_name = "MODEL.npz")]
    embed: Option<PathBuf>,
    #[command(flatten)]
    moved: RelocatedFilesArgs,
}

impl VersionsExportArgs {
    pub fn run(self, location: &Location, json: bool) -> Result<ExitStatus, CommandError> {
        let files =
            super::read(location, async |store| VersionSource::find(store, self.number, &self.moved).await)?;
        let outputs = self.outputs(&files)?;
        let written = write_all(&outputs, &self.output_dir)?;
        if json {
            let files = outputs
                .iter()
                .zip(written)
                .map(|((path, _), written)| json!({ "path": path, "written": written }));
            print_json(&json!({ "version": self.number, "files": files.collect::<Vec<_>>() }))?;
        } else {
            print(|out| {
                outputs.iter().zip(written).try_for_each(|((path, _), written)| match written {
                    true => writeln!(out, "wrote {}", path.display()),
                    false => writeln!(out, "{} already exists with the same content", path.display()),
                })
            })?;
        }
        Ok(ExitStatus::Done)
    }

    /// The files to write, with their contents.
    fn outputs(&self, files: &VersionSource) -> Result<Vec<(PathBuf, Vec<u8>)>, CommandError> {
        let read = |path: &Path| {
            fs::read(path)
                .map_err(|error| CommandError::Input(format!("cannot read {}: {error}", path.display())))
        };
        let mut outputs = vec![
            (self.output_dir.join(MODEL_FILE), read(&files.model.path)?),
            (self.output_dir.join(MIXTURE_FILE), read(&files.mixture.path)?),
        ];
        if let Some(path) = &self.embed {
            if outputs.iter().any(|(other, _)| other == path) {
                let shown = path.display();
                return Err(CommandError::Input(format!(
                    "--embed {shown} is a file of the version: name another one"
                )));
            }
            outputs.push((path.clone(), embedded(files)?));
        }
        Ok(outputs)
    }
}

/// The model with its mixture.
fn embedded(files: &VersionSource) -> Result<Vec<u8>, CommandError> {
    let mixture = files.artifact()?.mixture;
    let version =
        ArtifactVersion::new(&files.mixture.path, &mixture, &mixture).map_err(CommandError::input)?;
    let out = version.write_export(open(&files.model.path)?, Cursor::new(Vec::new()));
    Ok(out.map_err(CommandError::failed)?.into_inner())
}

/// Writes the files that are not there yet. Returns which it wrote.
///
/// # Errors
/// A file is there with another content; then none is written.
fn write_all(outputs: &[(PathBuf, Vec<u8>)], directory: &Path) -> Result<Vec<bool>, CommandError> {
    let missing =
        outputs.iter().map(|(path, bytes)| is_missing(path, bytes)).collect::<Result<Vec<_>, _>>()?;
    fs::create_dir_all(directory).map_err(|error| cannot_create(directory, error))?;
    for ((path, bytes), _) in outputs.iter().zip(&missing).filter(|(_, missing)| **missing) {
        let mut file = AtomicFile::create(path)?;
        file.write_all(bytes).map_err(|error| cannot_write(path, error))?;
        file.finish()?;
    }
    Ok(missing)
}

/// Whether there is no such file. One with the same content is there already.
fn is_missing(path: &Path, bytes: &[u8]) -> Result<bool, CommandError> {
    let shown = path.display();
    match fs::read(path) {
        Ok(found) if found == bytes => Ok(false),
        Ok(_) => Err(CommandError::Input(format!(
            "{shown} exists and has another content, which is not replaced: remove it, or name another place"
        ))),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(true),
        Err(error) => Err(CommandError::Input(format!("cannot write {shown}: {error}"))),
    }
}
