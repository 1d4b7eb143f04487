//! Labels as rows of their table.

use atoms::Vec3;

use crate::checksum::{LABEL, Names};
use crate::database::{FromRow, SqlRow};
use crate::encoding::{decode_matrix, decode_vectors};
use crate::error::{Result, StoreError};
use crate::exclude::Exclusion;
use crate::jobs::{LabelRecord, LabelSource, LabelStatus, Supersession};
use crate::records::{Label, LabelDetails};

/// A label as a row.
pub(super) struct LabelRow {
    status: String,
    energy: f64,
    forces: Vec<u8>,
    stress: Option<Vec<u8>>,
    job: Option<i64>,
    attempt: Option<u32>,
    file: Option<String>,
    frame: Option<u64>,
    received: i64,
    details: Option<String>,
    superseded: Option<i64>,
    reason: Option<String>,
    excluded: Option<i64>,
    exclusion: Option<String>,
}

impl FromRow for LabelRow {
    fn from_row(row: &SqlRow) -> Result<Self> {
        LABEL.verify(row, Names::Plain)?;
        Ok(Self {
            status: row.get("status")?,
            energy: row.get("energy")?,
            forces: row.get("forces")?,
            stress: row.get("stress")?,
            job: row.get("job")?,
            attempt: row.get("attempt")?,
            file: row.get("file")?,
            frame: row.get("frame")?,
            received: row.get("received")?,
            details: row.get_or_default("details")?,
            superseded: row.get_or_default("superseded")?,
            reason: row.get_or_default("reason")?,
            excluded: row.get_or_default("excluded")?,
            exclusion: row.get_or_default("exclusion")?,
        })
    }
}

impl LabelRow {
    /// Forces, [n], eV/Å.
    pub(super) fn forces(self) -> Result<Vec<Vec3>> {
        decode_vectors(&self.forces)
            .ok_or_else(|| StoreError::damaged("a label", "its forces have a wrong length"))
    }

    /// The label with its source and status.
    pub(super) fn into_record(self) -> Result<LabelRecord> {
        let unknown = || StoreError::damaged("a label", "unknown status or source");
        let status = LabelStatus::named(&self.status).ok_or_else(unknown)?;
        let source = match (self.job, self.attempt, self.file, self.frame) {
            (Some(job), Some(attempt), None, None) => LabelSource::Attempt { job, attempt },
            (None, None, Some(file), Some(frame)) => LabelSource::Import { file, frame },
            _ => return Err(unknown()),
        };
        let label = decode_label(self.energy, &self.forces, self.stress.as_deref(), self.details.as_deref())?;
        let superseded = self.superseded.zip(self.reason).map(|(time, reason)| Supersession { time, reason });
        let excluded = self.excluded.zip(self.exclusion).map(|(time, reason)| Exclusion { time, reason });
        Ok(LabelRecord { status, label, source, received: self.received, superseded, excluded })
    }
}

/// Decodes a label from its columns.
pub(crate) fn decode_label(
    energy: f64,
    forces: &[u8],
    stress: Option<&[u8]>,
    details: Option<&str>,
) -> Result<Label> {
    let damaged = || StoreError::damaged("a label", "its forces or stress have a wrong length");
    let details = details.map(serde_json::from_str).transpose();
    Ok(Label {
        energy,
        forces: decode_vectors(forces).ok_or_else(damaged)?,
        stress: stress.map(|bytes| decode_matrix(bytes).ok_or_else(damaged)).transpose()?,
        details: details
            .map_err(|error| StoreError::damaged("the details of a label", error))?
            .unwrap_or_default(),
    })
}

/// The column with the details of a label; `None` without any.
pub(super) fn encode_details(details: &LabelDetails) -> Option<String> {
    let is_empty = *details == LabelDetails::default();
    (!is_empty).then(|| serde_json::to_string(details).expect("plain data becomes JSON"))
}
