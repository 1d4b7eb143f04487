//! The version of the potential in force, with its files on this host.

use std::fs;
use std::io::Write;
use std::path::Path;

use orchestrator::selector::{PotentialVersion, VERSION};
use serde::Deserialize;
use store::{LoggedDecision, Store, StoreError, VersionRecord};
use toml::Spanned;

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::config::Config;
use crate::exit_status::CommandError;
use crate::file_hash::verify_hash;
use crate::process_config::HashedFile;

/// Folder of the campaign's directory with the files of versions. The store has them too: what is missing here is written again.
const FOLDER: &str = "versions";
/// Names of the files of a version.
pub const MODEL_FILE: &str = "kokkos.npz";
pub const MIXTURE_FILE: &str = "gmm_artifacts.npz";

/// A registered version and its files.
#[derive(Clone, Debug)]
pub struct VersionOnDisk {
    /// The version, as the decision log has it.
    pub version: PotentialVersion,
    /// The model's export.
    pub model: HashedFile,
    /// The artifact of its mixture.
    pub mixture: HashedFile,
}

impl VersionOnDisk {
    /// A registered version, whose files are written to `directory` unless they are there.
    ///
    /// # Errors
    /// A damaged database, a full disk.
    pub async fn find(store: &Store, record: &VersionRecord, directory: &Path) -> Result<Self, CommandError> {
        let folder = directory.join(FOLDER).join(record.number.to_string());
        let file = |name: &str, hash: &String| HashedFile { path: folder.join(name), hash: hash.clone() };
        let model = file(MODEL_FILE, &record.model_hash);
        let mixture = file(MIXTURE_FILE, &record.mixture_hash);
        if [&model, &mixture].into_iter().any(|file| verify_hash(&file.path, &file.hash).is_err()) {
            let files = store.version_files(record.number).await?.ok_or_else(|| {
                CommandError::Failed(format!(
                    "version {} has no files: the database is damaged; restore the campaign from a backup",
                    record.number
                ))
            })?;
            fs::create_dir_all(&folder).map_err(|error| cannot_write(&folder, error))?;
            for (file, bytes) in [(&model, &files.model), (&mixture, &files.mixture)] {
                let mut out = AtomicFile::create(&file.path)?;
                out.write_all(bytes).map_err(|error| cannot_write(&file.path, error))?;
                out.finish()?;
            }
        }
        Ok(Self { version: record.into(), model, mixture })
    }

    /// The version that a decision of the log switches to, with its files in `directory`.
    ///
    /// # Errors
    /// A damaged database, a full disk.
    pub async fn taken_up_by(
        store: &Store,
        decision: &LoggedDecision,
        directory: &Path,
    ) -> Result<Self, CommandError> {
        let damaged = |problem: &str| {
            CommandError::Failed(format!(
                "decision {}: {problem}: the database is damaged; restore the campaign from a backup",
                decision.sequence
            ))
        };
        let logged = PotentialVersion::deserialize(&decision.detail);
        let logged = logged.map_err(|error| damaged(&error.to_string()))?;
        let records = store.versions().await?;
        let record = records.iter().find(|record| record.number == logged.version);
        let record = record.ok_or_else(|| damaged(&format!("there is no version {}", logged.version)))?;
        let found = Self::find(store, record, directory).await?;
        if found.version != logged {
            return Err(damaged(&format!("version {} has other files than recorded", logged.version)));
        }
        Ok(found)
    }

    /// A configuration with the files of this version in place of its own.
    pub fn applied_to(&self, config: &Config) -> Config {
        let mut config = config.clone();
        let mixture = config.calm.artifact.as_ref().map_or(0..0, Spanned::span);
        config.potential.model = Spanned::new(config.potential.model.span(), self.model.path.clone());
        config.calm.artifact = Some(Spanned::new(mixture, self.mixture.path.clone()));
        config
    }
}

/// The decision that switched to the version of the potential to which this version of the mixture belongs; `None` for that of the
/// configuration.
pub async fn taken_up_before(
    store: &Store,
    mixture_version: u64,
) -> Result<Option<LoggedDecision>, StoreError> {
    let decisions = store.decisions_of_kind(VERSION).await?;
    Ok(decisions.into_iter().rfind(|decision| decision.mixture_version <= mixture_version))
}
