//! Pages of labelled structures.

use std::collections::{BTreeMap, HashSet};

use wire::ContentHash;

use super::decision_list::{decision_list, lists};
use super::label_row::LabelRow;
use super::labelled::{labelled_candidates, labelled_columns, labelled_joins};
use super::restore::origin;
use crate::Store;
use crate::checksum::{DECISION, IMPORT, Names, SEED_STRUCTURE, WALK, joined};
use crate::database::{FromRow, SqlRow, from_columns, query};
use crate::encoding::{decode_hash, read_structure};
use crate::error::{Result, StoreError};
use crate::export::{ExportCursor, ExportFilter, ExportRow, ExportSource, LabelMark};
use crate::labelled::LabelledCandidate;

macro_rules! candidates {
    ($which:expr, $limit:literal) => {
        labelled_candidates!(
            concat!(", seed_structure.seed AS seed, ", joined!(decision), ", ", joined!(seed_structure)),
            " CROSS JOIN decision ON decision.sequence = candidate.decision
            LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure",
            $which,
            $limit
        )
    };
}

pub(crate) const CANDIDATES: &str =
    candidates!("> $2 AND CASE origin WHEN 'biased' THEN $3 ELSE $4 END = 1", " LIMIT $5");

/// Those of a list of decisions.
pub(crate) const LISTED: &str = candidates!(concat!("IN ", decision_list!()), "");

/// Imported structures that are not exported as candidates.
pub(crate) const IMPORTS: &str = concat!(
    "SELECT import.number AS place, ",
    joined!(import),
    ", ",
    joined!(structure),
    ", label.*
    FROM import
    CROSS JOIN label ON label.structure = import.structure AND label.protocol = $1 AND status = 'label'
    CROSS JOIN structure ON structure.number = import.structure
    WHERE import.number > $2
    AND NOT EXISTS (SELECT 1 FROM candidate WHERE candidate.structure = import.structure)
    AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = import.structure AND job.protocol = $1
                    AND state = 'dropped')
    ORDER BY import.number LIMIT $3"
);

/// The rows of [`CANDIDATES`] with few of their columns.
const CANDIDATE_MARKS: &str =
    "SELECT candidate.decision AS place, candidate.origin AS origin, seed_structure.name AS name,
    label.energy AS energy
    FROM candidate
    CROSS JOIN label ON label.structure = candidate.structure AND label.protocol = $1 AND status = 'label'
    LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure
    WHERE NOT EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure AND job.protocol = $1
                    AND state = 'dropped')
    ORDER BY candidate.decision";

/// The rows of [`IMPORTS`] with few of their columns.
const IMPORT_MARKS: &str = "SELECT import.number AS place, label.energy AS energy
    FROM import
    CROSS JOIN label ON label.structure = import.structure AND label.protocol = $1 AND status = 'label'
    WHERE NOT EXISTS (SELECT 1 FROM candidate WHERE candidate.structure = import.structure)
    AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = import.structure AND job.protocol = $1
                    AND state = 'dropped')
    ORDER BY import.number";

/// Hashes of structures collected from both biased and control walks.
const OF_BOTH_ORIGINS: &str = "SELECT DISTINCT content FROM candidate WHERE origin = 'control'
    AND EXISTS (SELECT 1 FROM candidate other WHERE other.structure = candidate.structure AND other.origin = 'biased')";

const CONTROL_WALKS: &str =
    concat!("SELECT ", joined!(walk), " FROM walk WHERE origin = 'control' ORDER BY walk.walk");

/// A protocol by its hash.
struct ProtocolRow {
    number: i64,
    name: String,
}

from_columns!(ProtocolRow { number, name });

impl Store {
    /// The control walks, each with the biased walk that it matches. A control frame matches the candidate that its biased walk found
    /// at the same step.
    pub async fn matched_walks(&self) -> Result<BTreeMap<u32, u32>> {
        let mut matched = BTreeMap::new();
        for row in query(CONTROL_WALKS).rows(&self.database).await? {
            WALK.verify(&row, Names::Joined)?;
            if let Some(partner) = row.get::<Option<u32>>("walk__partner")? {
                matched.insert(row.get("walk__walk")?, partner);
            }
        }
        Ok(matched)
    }

    /// Structures found by both a biased walk and its control: the two share random numbers and agree until the
    /// bias acts. Such a structure has one label.
    pub async fn structures_of_both_origins(&self) -> Result<HashSet<ContentHash>> {
        let hashes: Vec<Vec<u8>> = query(OF_BOTH_ORIGINS).fetch_all(&self.database).await?;
        hashes.iter().map(|hash| decode_hash(hash)).collect()
    }

    /// The labels of a protocol that [`Self::labelled`] reads, in its order. For questions that are asked often.
    pub async fn label_marks(&self, protocol: ContentHash) -> Result<Vec<LabelMark>> {
        let number = query("SELECT number FROM protocol WHERE hash = $1").bind(protocol.0.to_vec());
        let Some(number) = number.fetch_optional::<i64>(&self.database).await? else { return Ok(Vec::new()) };
        let mut marks = Vec::new();
        for row in query(CANDIDATE_MARKS).bind(number).rows(&self.database).await? {
            marks.push(LabelMark {
                cursor: ExportCursor::Candidate(row.get("place")?),
                walk: Some((
                    row.get::<Option<String>>("name")?.unwrap_or_default(),
                    origin(&row.get::<String>("origin")?)?,
                )),
                energy: row.get("energy")?,
            });
        }
        for row in query(IMPORT_MARKS).bind(number).rows(&self.database).await? {
            let cursor = ExportCursor::Import(row.get("place")?);
            marks.push(LabelMark { cursor, walk: None, energy: row.get("energy")? });
        }
        Ok(marks)
    }

    /// At most `limit` labelled structures after `after` (`None`: from the first): candidates in decision order,
    /// then imports in import order, independent of when labels arrived. Leaves out structures dropped by hand. An
    /// empty page is the end.
    pub async fn labelled(
        &self,
        filter: &ExportFilter,
        after: Option<ExportCursor>,
        limit: u32,
    ) -> Result<Vec<ExportRow>> {
        let ProtocolRow { number, name } = self.protocol_row(filter.protocol).await?;
        let (decision, last_import) = match after {
            None => (Some(0), 0),
            Some(ExportCursor::Candidate(decision)) => (Some(decision), 0),
            Some(ExportCursor::Import(import)) => (None, import),
        };
        let mut rows = Vec::new();
        if let Some(decision) = decision {
            let query = query(CANDIDATES).bind(number).bind(decision);
            let query = query.bind(filter.biased).bind(filter.control).bind(limit);
            for row in query.rows(&self.database).await? {
                rows.push(candidate(&row, &name, filter.protocol)?);
            }
        }
        let left = limit.saturating_sub(rows.len() as u32);
        if filter.imported && left > 0 {
            let query = query(IMPORTS).bind(number).bind(last_import).bind(left);
            for row in query.rows(&self.database).await? {
                rows.push(import(&row, &name, filter.protocol)?);
            }
        }
        Ok(rows)
    }

    /// The labelled ones among the candidates and frames of control walks of these decisions, as [`Self::labelled`] reads them.
    pub async fn labelled_candidates(
        &self,
        protocol: ContentHash,
        decisions: &[i64],
    ) -> Result<Vec<ExportRow>> {
        let ProtocolRow { number, name } = self.protocol_row(protocol).await?;
        let mut found = Vec::new();
        for list in lists(decisions) {
            let page = query(LISTED).bind(number).bind_all(list);
            for row in page.rows(&self.database).await? {
                found.push(candidate(&row, &name, protocol)?);
            }
        }
        Ok(found)
    }

    async fn protocol_row(&self, protocol: ContentHash) -> Result<ProtocolRow> {
        let found = query("SELECT number, name FROM protocol WHERE hash = $1").bind(protocol.0.to_vec());
        let found = found.fetch_optional(&self.database).await?;
        found.ok_or_else(|| StoreError::UnknownProtocol(protocol.to_string()))
    }
}

fn candidate(row: &SqlRow, protocol_name: &str, protocol: ContentHash) -> Result<ExportRow> {
    let found = LabelledCandidate::from_row(row)?;
    DECISION.verify(row, Names::Joined)?;
    let seed_structure_name = match row.get::<Option<i64>>("seed")? {
        None => String::new(),
        Some(_) => {
            SEED_STRUCTURE.verify(row, Names::Joined)?;
            row.get("seed_structure__name")?
        }
    };
    let LabelledCandidate { decision, seed_structure, structure, block, original, label, .. } = found;
    let source = ExportSource::Candidate {
        id: row.get("candidate__id")?,
        seed_structure,
        seed_structure_name,
        origin: block.view().origin(),
        mixture_version_after: row.get("decision__mixture_version")?,
        selector_gamma: row.get("candidate__selector_gamma")?,
        original,
        block,
    };
    let (cursor, protocol_name) = (ExportCursor::Candidate(decision), protocol_name.to_owned());
    Ok(ExportRow { cursor, source, structure, label, protocol_name, protocol })
}

fn import(row: &SqlRow, protocol_name: &str, protocol: ContentHash) -> Result<ExportRow> {
    IMPORT.verify(row, Names::Joined)?;
    Ok(ExportRow {
        cursor: ExportCursor::Import(row.get("place")?),
        source: ExportSource::Import { file: row.get("import__file")?, frame: row.get("import__frame")? },
        structure: read_structure(row)?,
        label: LabelRow::from_row(row)?.into_record()?.label,
        protocol_name: protocol_name.to_owned(),
        protocol,
    })
}
