//! Attempts at labels that are under way.

use serde::Serialize;

use crate::database::{FromRow, SqlRow};
use crate::error::Result;

/// A label that is being made.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunningLabel {
    /// Id of the job.
    pub job: i64,
    /// Name of the candidate, or `import-N`.
    pub candidate: String,
    /// Name of the protocol.
    pub protocol: String,
    /// Index of the seed structure; [`u32::MAX`] if it was imported.
    #[serde(skip)]
    pub seed_structure: u32,
    /// Formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: u32,
    /// Number of the attempt, from 1.
    pub attempt: u32,
    /// The labeller that makes it.
    pub holder: String,
    /// When the attempt began, ms since 1970.
    pub started: i64,
    /// Its cores; `None` before its calculation is recorded.
    pub cores: Option<u32>,
}

impl FromRow for RunningLabel {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self {
            job: row.get("job")?,
            candidate: row.get("candidate")?,
            protocol: row.get("protocol")?,
            seed_structure: row.get("seed_structure")?,
            formula: row.get("formula")?,
            atoms: row.get("atoms")?,
            attempt: row.get("attempt")?,
            holder: row.get("holder")?,
            started: row.get("started")?,
            cores: row.get("cores")?,
        })
    }
}
