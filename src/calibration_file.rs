//! Bounds of the force error as a file, with the hashes of the model and the mixture whose grades they belong to.

use std::fs;
use std::io::Write;
use std::path::Path;

use monitor::calibration::CalibrationSummary;
use serde::{Deserialize, Serialize};
use store::{Protocol, Store};

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::exit_status::CommandError;
use crate::file_hash;
use crate::replay::{ARTIFACT, MODEL, resolved};

/// Version of the file.
const FORMAT: u32 = 1;

/// The model and the mixture of a version of the potential.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct GradeFiles {
    /// BLAKE3 hash of the model.
    pub model_hash: String,
    /// BLAKE3 hash of the artifact; `None` if the mixture is that of the model's file.
    pub mixture_hash: Option<String>,
}

/// Bounds of the force error of one version.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct CalibrationFile {
    /// [`FORMAT`].
    format: u32,
    /// Id of the campaign.
    pub campaign: String,
    /// Name of the protocol of its labels.
    pub protocol: String,
    /// What the grades are of.
    #[serde(flatten)]
    pub files: GradeFiles,
    /// The bounds.
    #[serde(flatten)]
    pub summary: CalibrationSummary,
}

impl GradeFiles {
    /// The files of these paths.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn of_paths(model: &Path, artifact: Option<&Path>) -> Result<Self, CommandError> {
        let hash = |path: &Path| {
            let cannot = |error| CommandError::Input(format!("cannot read {}: {error}", path.display()));
            file_hash::hash(path).map_err(cannot)
        };
        Ok(Self { model_hash: hash(model)?, mixture_hash: artifact.map(hash).transpose()? })
    }

    /// The files of a version of a campaign.
    ///
    /// # Errors
    /// A damaged database.
    pub async fn of_version(store: &Store, version: u32) -> Result<Self, CommandError> {
        if version == 0 {
            let configuration = resolved(&store.campaign().await?)?;
            let hash = |key: &str| configuration["files"][key].as_str().map(str::to_owned);
            return Ok(Self { model_hash: hash(MODEL).unwrap_or_default(), mixture_hash: hash(ARTIFACT) });
        }
        let versions = store.versions().await?;
        let found = versions.into_iter().find(|found| found.number == version);
        let missing = || CommandError::Failed(format!("damaged database: version {version} is missing"));
        let found = found.ok_or_else(missing)?;
        Ok(Self { model_hash: found.model_hash, mixture_hash: Some(found.mixture_hash) })
    }
}

impl CalibrationFile {
    /// With what identifies the version.
    ///
    /// # Errors
    /// A damaged database.
    pub async fn new(
        store: &Store,
        protocol: &Protocol,
        summary: CalibrationSummary,
    ) -> Result<Self, CommandError> {
        let files = GradeFiles::of_version(store, summary.version).await?;
        let campaign = store.campaign().await?.id.to_string();
        Ok(Self { format: FORMAT, campaign, protocol: protocol.name.clone(), files, summary })
    }

    /// Reads a file.
    ///
    /// # Errors
    /// A file that cannot be read, or that is another one.
    pub fn load(path: &Path) -> Result<Self, CommandError> {
        let wrong = |what: String| CommandError::Input(format!("{}: {what}", path.display()));
        let text = fs::read_to_string(path).map_err(|error| wrong(format!("cannot be read: {error}")))?;
        let file: Self = serde_json::from_str(&text).map_err(|error| {
            wrong(format!("not written by `calmwalk force-errors --calibration`: {error}"))
        })?;
        match file.format {
            FORMAT => Ok(file),
            other => Err(wrong(format!("found format {other}, expected {FORMAT}"))),
        }
    }

    /// Writes the file.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), CommandError> {
        let text = serde_json::to_string_pretty(self).map_err(CommandError::failed)?;
        let mut file = AtomicFile::create(path)?;
        writeln!(file, "{text}").map_err(|error| cannot_write(path, error))?;
        file.finish()
    }
}
