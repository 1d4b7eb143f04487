//! Labelled structures, page by page.

use wire::{CandidateBlock, ContentHash};

use super::labels::decode_label;
use super::restore::{grades, origin};
use crate::Store;
use crate::database::{FromRow, Row, query};
use crate::encoding::decode_structure;
use crate::error::{Result, StoreError};
use crate::export::{ExportFilter, ExportPlace, ExportRow, ExportSource};

pub(crate) const CANDIDATES: &str = "SELECT candidate.decision, id, candidate.seed_structure,
        coalesce(seed_structure.name, '') AS seed_name, origin, decision.mixture_version AS version_after,
        block, original_grades, hash, data, label.*
    FROM candidate
    CROSS JOIN label ON label.structure = candidate.structure AND label.protocol = $1 AND standing = 'label'
    CROSS JOIN structure ON structure.number = candidate.structure
    CROSS JOIN decision ON decision.sequence = candidate.decision
    CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
    LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure
    WHERE candidate.decision > $2 AND CASE origin WHEN 'biased' THEN $3 ELSE $4 END = 1
    AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure AND job.protocol = $1
                    AND state = 'dropped')
    ORDER BY candidate.decision LIMIT $5";

/// Imported structures that are not rows of candidates already.
pub(crate) const IMPORTS: &str =
    "SELECT import.number AS place, import.file AS from_file, import.frame AS from_frame, hash, data, label.*
    FROM import
    CROSS JOIN label ON label.structure = import.structure AND label.protocol = $1 AND standing = 'label'
    CROSS JOIN structure ON structure.number = import.structure
    WHERE import.number > $2
    AND NOT EXISTS (SELECT 1 FROM candidate WHERE candidate.structure = import.structure)
    ORDER BY import.number LIMIT $3";

struct CandidateRow {
    decision: i64,
    id: String,
    seed_structure: u32,
    seed_name: String,
    origin: String,
    version_after: u64,
    block: Vec<u8>,
    original_grades: Option<Vec<u8>>,
    labelled: Labelled,
}

impl FromRow for CandidateRow {
    fn from_row(row: &Row) -> Result<Self> {
        Ok(Self {
            decision: row.get("decision")?,
            id: row.get("id")?,
            seed_structure: row.get("seed_structure")?,
            seed_name: row.get("seed_name")?,
            origin: row.get("origin")?,
            version_after: row.get("version_after")?,
            block: row.get("block")?,
            original_grades: row.get("original_grades")?,
            labelled: Labelled::from_row(row)?,
        })
    }
}

struct ImportRow {
    number: i64,
    file: String,
    frame: u64,
    labelled: Labelled,
}

impl FromRow for ImportRow {
    fn from_row(row: &Row) -> Result<Self> {
        let (number, file, frame) = (row.get("place")?, row.get("from_file")?, row.get("from_frame")?);
        Ok(Self { number, file, frame, labelled: Labelled::from_row(row)? })
    }
}

struct Labelled {
    hash: Vec<u8>,
    data: Vec<u8>,
    energy: f64,
    forces: Vec<u8>,
    stress: Option<Vec<u8>>,
    details: Option<String>,
}

impl FromRow for Labelled {
    fn from_row(row: &Row) -> Result<Self> {
        Ok(Self {
            hash: row.get("hash")?,
            data: row.get("data")?,
            energy: row.get("energy")?,
            forces: row.get("forces")?,
            stress: row.get("stress")?,
            details: row.get_or_default("details")?,
        })
    }
}

impl Store {
    /// At most `limit` labelled structures behind `after` (`None`: from the first on): candidates in decision order, then
    /// imports as they came, whatever the order in which the labels came. An empty page is the end. What was dropped by
    /// hand is left out.
    pub async fn labelled(
        &self,
        filter: &ExportFilter,
        after: Option<ExportPlace>,
        limit: u32,
    ) -> Result<Vec<ExportRow>> {
        let name = query("SELECT name FROM protocol WHERE hash = $1").bind(filter.protocol.0.to_vec());
        let name: Option<String> = name.fetch_optional(&self.database).await?;
        let name = name.ok_or_else(|| StoreError::UnknownProtocol(filter.protocol.to_string()))?;
        let sql = "SELECT number FROM protocol WHERE hash = $1";
        let number = query(sql).bind(filter.protocol.0.to_vec());
        let number: i64 = number.fetch_one(&self.database).await?;
        let (decision, import) = match after {
            None => (Some(0), 0),
            Some(ExportPlace::Candidate(decision)) => (Some(decision), 0),
            Some(ExportPlace::Import(import)) => (None, import),
        };
        let mut rows = Vec::new();
        if let Some(decision) = decision {
            let query = query(CANDIDATES).bind(number).bind(decision);
            let query = query.bind(filter.biased).bind(filter.control).bind(limit);
            let found: Vec<CandidateRow> = query.fetch_all(&self.database).await?;
            for row in found {
                rows.push(row.into_export(&name, filter.protocol)?);
            }
        }
        let left = limit.saturating_sub(rows.len() as u32);
        if filter.imported && left > 0 {
            let query = query(IMPORTS).bind(number).bind(import).bind(left);
            let found: Vec<ImportRow> = query.fetch_all(&self.database).await?;
            for row in found {
                rows.push(row.into_export(&name, filter.protocol)?);
            }
        }
        Ok(rows)
    }
}

impl CandidateRow {
    fn into_export(self, protocol_name: &str, protocol: ContentHash) -> Result<ExportRow> {
        let source = ExportSource::Candidate {
            id: self.id,
            seed_structure: self.seed_structure,
            seed_structure_name: self.seed_name,
            origin: origin(&self.origin)?,
            mixture_version_after: self.version_after,
            block: CandidateBlock::from_bytes(&self.block)?,
            original: grades(self.original_grades.as_deref())?,
        };
        self.labelled.into_export(ExportPlace::Candidate(self.decision), source, protocol_name, protocol)
    }
}

impl ImportRow {
    fn into_export(self, protocol_name: &str, protocol: ContentHash) -> Result<ExportRow> {
        let source = ExportSource::Import { file: self.file, frame: self.frame };
        self.labelled.into_export(ExportPlace::Import(self.number), source, protocol_name, protocol)
    }
}

impl Labelled {
    fn into_export(
        self,
        place: ExportPlace,
        source: ExportSource,
        protocol_name: &str,
        protocol: ContentHash,
    ) -> Result<ExportRow> {
        let (stress, details) = (self.stress.as_deref(), self.details.as_deref());
        Ok(ExportRow {
            place,
            source,
            structure: decode_structure(&self.data, &self.hash)?,
            label: decode_label(self.energy, &self.forces, stress, details)?,
            protocol_name: protocol_name.to_owned(),
            protocol,
        })
    }
}
