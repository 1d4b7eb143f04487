//! The files of a mixture: an artifact, and a copy of the model's export.

use std::fs::File;
use std::io::{BufReader, BufWriter, Write};
use std::path::Path;

use calm::build::{ArtifactVersion, BuiltMixture};
use tempfile::TempPath;

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::exit_status::CommandError;

/// Where to write a mixture.
#[derive(Clone, Copy)]
pub struct MixtureFiles<'a> {
    /// The model's export, and the copy of it with the mixture, if asked for.
    pub embed: Option<(&'a Path, &'a Path)>,
    /// The artifact.
    pub output: &'a Path,
}

impl MixtureFiles<'_> {
    /// Writes a mixture as it was built: first the copy of the model, then the artifact.
    pub fn write_built(self, mixture: &BuiltMixture) -> Result<(), CommandError> {
        if let Some((model, path)) = self.embed {
            let mut file = AtomicFile::create(path)?;
            mixture.write_export(open(model)?, &mut file).map_err(|error| cannot_write(path, error))?;
            file.finish()?;
        }
        let mut file = AtomicFile::create(self.output)?;
        mixture.write(&mut file).map_err(|error| cannot_write(self.output, error))?;
        file.finish()
    }

    /// Writes a later version of the mixture of `artifact`, whose updates are from `campaign`: first the copy of the model, then the
    /// artifact.
    pub fn write_version(
        self,
        version: &ArtifactVersion,
        artifact: &Path,
        campaign: &str,
    ) -> Result<(), CommandError> {
        if let Some((model, path)) = self.embed {
            let mut file = AtomicFile::create(path)?;
            version.write_export(open(model)?, &mut file).map_err(|error| cannot_write(path, error))?;
            file.finish()?;
        }
        let mut file = AtomicFile::create(self.output)?;
        version
            .write_artifact(open(artifact)?, &mut file, campaign)
            .map_err(|error| cannot_write(self.output, error))?;
        file.finish()
    }
}

/// Opens a file that is copied in parts.
pub fn open(path: &Path) -> Result<BufReader<File>, CommandError> {
    let file = File::open(path);
    file.map(BufReader::new)
        .map_err(|error| CommandError::Input(format!("{}: cannot be opened: {error}", path.display())))
}

/// Writes the artifact before the updates to a temporary file beside the output.
pub fn write_beside(mixture: &BuiltMixture, output: &Path) -> Result<TempPath, CommandError> {
    let parent = output.parent().filter(|parent| !parent.as_os_str().is_empty());
    let mut builder = tempfile::Builder::new();
    let part = builder.prefix(".built.").suffix(".part").tempfile_in(parent.unwrap_or(Path::new(".")));
    let mut part = part.map_err(|error| cannot_write(output, error))?;
    let mut out = BufWriter::new(&mut part);
    let written = mixture.write(&mut out).and_then(|out| out.flush());
    written.map_err(|error| cannot_write(output, error))?;
    drop(out);
    Ok(part.into_temp_path())
}
