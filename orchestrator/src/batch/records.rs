//! The file with the jobs of a campaign in a custom batch system, which does not list jobs by name.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::Path;

use ::batch::{CustomScheduler, JobId};
use serde::{Deserialize, Serialize};

use super::error::BatchError;

/// Name of the file.
const FILE: &str = "jobs.json";

/// The jobs of a campaign in a custom batch system.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobRecords {
    /// The batch system, by which a view without the configuration can ask for their states.
    pub scheduler: CustomScheduler,
    /// The job that was last submitted under each name.
    pub jobs: Vec<JobRecord>,
}

/// A submitted job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobRecord {
    /// Its id.
    pub id: JobId,
    /// Its name.
    pub name: String,
    /// Number of walkers of an agent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub walkers: Option<u32>,
    /// When it was submitted, s since 1970.
    pub submitted: u64,
}

impl JobRecords {
    /// The jobs in this folder; `None` if none were ever submitted.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn read(folder: &Path) -> Result<Option<Self>, BatchError> {
        let path = folder.join(FILE);
        let bytes = match fs::read(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            read => read.map_err(BatchError::records(&path))?,
        };
        let parsed = serde_json::from_slice(&bytes).map_err(io::Error::other);
        parsed.map(Some).map_err(BatchError::records(&path))
    }

    /// Notes a job in place of the one with its name.
    pub(super) fn put(&mut self, job: JobRecord) {
        self.jobs.retain(|other| other.name != job.name);
        self.jobs.push(job);
    }

    /// Writes the file, by rename.
    pub(super) fn write(&self, folder: &Path) -> Result<(), BatchError> {
        let (path, unfinished) = (folder.join(FILE), folder.join(format!("{FILE}.new")));
        let bytes = serde_json::to_vec_pretty(self).map_err(io::Error::other);
        let written = bytes.and_then(|bytes| {
            fs::create_dir_all(folder)?;
            fs::write(&unfinished, bytes)?;
            fs::rename(&unfinished, &path)
        });
        written.map_err(BatchError::records(&path))
    }
}
