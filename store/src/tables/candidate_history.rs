//! One candidate or imported structure, and everything related to it. All queries use indexes or stay near it in
//! the decision log.

use wire::{ContentHash, WalkId};

use super::label_row::LabelRow;
use super::status::walks;
use crate::Store;
use crate::candidate_history::{
    CoveredCandidate, ImportedStructure, LaterCoveredCandidates, SameStructure, StructureLabel,
};
use crate::checksum::{IMPORT, Names, joined};
use crate::database::{FromRow, SqlRow, from_columns, query};
use crate::encoding::{decode_hash, read_structure};
use crate::error::{Result, StoreError};
use crate::jobs::JobDetails;
use crate::records::{CandidateRef, LoggedOperation, Protocol, StoredCandidate};
use crate::status::WalkStatus;

/// Number of candidates shown if a name fits none or several.
const MAX_SUGGESTIONS: u32 = 5;
/// Decisions read at a time when the log is followed from one decision on, and the most that are read.
const PAGE: u32 = 1000;
const MAX_DECISIONS: i64 = 20_000;
/// A structure rarely occurs more than twice: as a candidate and as a frame of its control.
const MAX_OCCURRENCES: u32 = 100;

pub(crate) const NUMBERED: &str = "SELECT decision, id AS candidate FROM candidate WHERE decision = $1";

pub(crate) const BEGINNING: &str = "SELECT decision, id AS candidate FROM candidate
    WHERE id >= $1 AND id < $1 || '~' ORDER BY id LIMIT $2";

pub(crate) const FIRST: &str = "SELECT decision, id AS candidate FROM candidate WHERE decision >= $1
    ORDER BY decision LIMIT 1";

pub(crate) const LAST: &str = "SELECT decision, id AS candidate FROM candidate WHERE decision <= $1
    ORDER BY decision DESC LIMIT 1";

pub(crate) const SAME_STRUCTURE: &str =
    "SELECT candidate.decision AS decision, id AS candidate FROM structure
    CROSS JOIN candidate ON candidate.structure = structure.number
    WHERE structure.hash = $1 ORDER BY candidate.decision LIMIT $2";

pub(crate) const JOBS: &str =
    "SELECT job.number FROM structure CROSS JOIN job ON job.structure = structure.number
    WHERE structure.hash = $1";

pub(crate) const LABELS: &str =
    "SELECT protocol.hash AS protocol_hash, protocol.name AS protocol_name, settings,
        label.* FROM structure
    CROSS JOIN label ON label.structure = structure.number
    CROSS JOIN protocol ON protocol.number = label.protocol
    WHERE structure.hash = $1 ORDER BY label.protocol, label.number";

/// The accepted candidate of a walk at a step, found by the walk's names.
pub(crate) const AT_STEP: &str = "SELECT decision, id AS candidate FROM candidate
    WHERE id >= $1 AND id < $1 || '~' AND step = $2 AND fate = 'accepted' ORDER BY id LIMIT 1";

pub(crate) const BEFORE: &str = "SELECT sequence, kind, candidate, mixture_version FROM decision
    WHERE sequence < $1 ORDER BY sequence DESC LIMIT $2";

pub(crate) const AFTER: &str = "SELECT sequence, id, reason, candidate.mixture_version AS seen,
        decision.mixture_version AS decided
    FROM decision LEFT JOIN candidate ON candidate.decision = sequence
    WHERE sequence > $1 ORDER BY sequence LIMIT $2";

const IMPORTED: &str = concat!(
    "SELECT import.number AS place, ",
    joined!(import),
    ", ",
    joined!(structure),
    " FROM import CROSS JOIN structure ON structure.number = import.structure WHERE import.number = $1"
);

/// Manual changes are in the operations log, which does not grow with the candidates.
const MANUAL_OPERATIONS: &str = "SELECT number, time, kind, detail FROM operation
    WHERE kind IN ('drop', 'retry', 'prioritise', 'exclude', 'include', 'lower_state') ORDER BY number";

from_columns!(CandidateRef { decision, candidate });

impl FromRow for ImportedStructure {
    fn from_row(row: &SqlRow) -> Result<Self> {
        IMPORT.verify(row, Names::Joined)?;
        Ok(Self {
            number: row.get("place")?,
            file: row.get("import__file")?,
            frame: row.get("import__frame")?,
            structure: read_structure(row)?,
            content: decode_hash(&row.get::<Vec<u8>>("structure__hash")?)?,
        })
    }
}

struct Before {
    sequence: i64,
    kind: String,
    candidate: Option<String>,
    mixture_version: u64,
}

from_columns!(Before { sequence, kind, candidate, mixture_version });

struct After {
    sequence: i64,
    id: Option<String>,
    reason: Option<String>,
    seen: Option<u64>,
    decided: u64,
}

from_columns!(After { sequence, id, reason, seen, decided });

impl Store {
    /// Finds a candidate by the sequence number of its decision, by its name or by a prefix of the name. The
    /// campaign's part of the name may be omitted.
    pub async fn find_candidate(&self, id: &str) -> Result<CandidateRef> {
        if let Ok(decision) = id.parse::<i64>() {
            let found = query(NUMBERED).bind(decision).fetch_optional(&self.database).await?;
            return match found {
                Some(found) => Ok(found),
                None => Err(self.unknown_candidate(id).await?),
            };
        }
        let mut found = self.names_with_prefix(id).await?;
        if found.is_empty() {
            found = self.names_with_prefix(&format!("{}-{id}", self.campaign_prefix().await?)).await?;
        }
        let exact = found.iter().position(|named| named.candidate == id);
        match (exact, found.len()) {
            (Some(k), _) => Ok(found.swap_remove(k)),
            (None, 1) => Ok(found.swap_remove(0)),
            (None, 0) => Err(self.unknown_candidate(id).await?),
            (None, _) => {
                let matches = found.into_iter().map(|named| named.candidate).collect();
                Err(StoreError::AmbiguousJob { id: id.into(), matches })
            }
        }
    }

    async fn names_with_prefix(&self, begin: &str) -> Result<Vec<CandidateRef>> {
        query(BEGINNING).bind(begin).bind(MAX_SUGGESTIONS).fetch_all(&self.database).await
    }

    async fn campaign_prefix(&self) -> Result<String> {
        let campaign = self.campaign_value("id").await?;
        Ok(campaign.get(..8).unwrap_or_default().to_owned())
    }

    async fn unknown_candidate(&self, id: &str) -> Result<StoreError> {
        let first: Option<CandidateRef> = query(FIRST).bind(0).fetch_optional(&self.database).await?;
        let last: Option<CandidateRef> = query(LAST).bind(i64::MAX).fetch_optional(&self.database).await?;
        Ok(StoreError::UnknownCandidate { id: id.into(), range: first.zip(last) })
    }

    /// The imported structure with that number, from 1.
    pub async fn imported_structure(&self, number: i64) -> Result<Option<ImportedStructure>> {
        query(IMPORTED).bind(number).fetch_optional(&self.database).await
    }

    /// Number of imported structures.
    pub async fn imported_structures(&self) -> Result<u64> {
        query("SELECT coalesce(max(number), 0) FROM import").fetch_one(&self.database).await
    }

    /// Other occurrences of this structure.
    pub async fn same_structure(&self, content: ContentHash) -> Result<SameStructure> {
        let candidates = query(SAME_STRUCTURE).bind(&content.0[..]).bind(MAX_OCCURRENCES);
        let import = query(
            "SELECT import.number FROM structure CROSS JOIN import ON import.structure = structure.number
             WHERE structure.hash = $1",
        );
        Ok(SameStructure {
            candidates: candidates.fetch_all(&self.database).await?,
            import: import.bind(&content.0[..]).fetch_optional(&self.database).await?,
        })
    }

    /// Label jobs of a structure under every protocol, with their attempts, oldest first.
    pub async fn jobs_of(&self, content: ContentHash) -> Result<Vec<JobDetails>> {
        let mut numbers: Vec<i64> = query(JOBS).bind(&content.0[..]).fetch_all(&self.database).await?;
        numbers.sort_unstable();
        let mut jobs = Vec::new();
        for number in numbers {
            jobs.push(self.job_details(number).await?);
        }
        Ok(jobs)
    }

    /// Labels and checks of a structure under every protocol, oldest first in each.
    pub async fn labels_of(&self, content: ContentHash) -> Result<Vec<StructureLabel>> {
        query(LABELS).bind(&content.0[..]).fetch_all(&self.database).await
    }

    /// Manual changes of a job, oldest first.
    pub async fn manual_operations(&self, job: i64) -> Result<Vec<LoggedOperation>> {
        let rows: Vec<(i64, i64, String, String)> =
            query(MANUAL_OPERATIONS).fetch_all(&self.database).await?;
        let mut operations = Vec::new();
        for (number, time, kind, detail) in rows {
            let detail: serde_json::Value = serde_json::from_str(&detail)
                .map_err(|error| StoreError::damaged("the operations log", error))?;
            // The campaign's rule makes lower states labels as well.
            let is_by_rule = detail.get("by").is_some_and(|by| by != "user");
            if detail["job"] == job && !is_by_rule {
                operations.push(LoggedOperation { number, time, kind, detail });
            }
        }
        Ok(operations)
    }

    /// The accepted candidate of a walk at a step.
    pub async fn accepted_at(&self, walk: WalkId, step: u64) -> Result<Option<CandidateRef>> {
        let begin = format!("{}-{walk}.", self.campaign_prefix().await?);
        let step = crate::encoding::integer("step", step)?;
        query(AT_STEP).bind(begin).bind(step).fetch_optional(&self.database).await
    }

    /// The candidate of a walk in a segment at a step, `None` if there is none.
    pub async fn candidate_at(
        &self,
        walk: WalkId,
        segment: u32,
        step: u64,
    ) -> Result<Option<StoredCandidate>> {
        let begin = format!("{}-{walk}.{segment}.{step}-", self.campaign_prefix().await?);
        match self.names_with_prefix(&begin).await?.first() {
            Some(found) => self.candidate(&found.candidate).await,
            None => Ok(None),
        }
    }

    /// The state of a walk, and for a control walk the biased walk that it matches.
    pub async fn walk(&self, walk: WalkId) -> Result<Option<(WalkStatus, Option<WalkId>)>> {
        let status = query(walks!("WHERE walk = $1"));
        let status: Option<WalkStatus> = status.bind(walk.0).fetch_optional(&self.database).await?;
        let Some(mut status) = status else { return Ok(None) };
        status.paused = status.is_active() && self.paused_walks().await?.contains(&walk);
        let partner = query("SELECT coalesce(partner, -1) FROM walk WHERE walk = $1").bind(walk.0);
        let partner: i64 = partner.fetch_one(&self.database).await?;
        Ok(Some((status, u32::try_from(partner).ok().map(WalkId))))
    }

    /// Candidates whose updates made the mixture newer than version `seen` before a decision, newest first. Looks
    /// back some thousands of decisions at most.
    pub async fn updates_since(&self, seen: u64, decision: i64) -> Result<Vec<CandidateRef>> {
        let (mut updates, mut first) = (Vec::new(), decision);
        while first > decision - MAX_DECISIONS {
            let page: Vec<Before> = query(BEFORE).bind(first).bind(PAGE).fetch_all(&self.database).await?;
            let Some(last) = page.last() else { break };
            first = last.sequence;
            let is_known = last.mixture_version <= seen;
            let newer = page.into_iter().filter(|row| row.mixture_version > seen && row.kind == "accepted");
            updates.extend(newer.filter_map(|Before { sequence, candidate, .. }| {
                Some(CandidateRef { decision: sequence, candidate: candidate? })
            }));
            if is_known {
                break;
            }
        }
        Ok(updates)
    }

    /// Candidates declined as covered after a decision, whose walkers had seen only mixtures older than `version`.
    /// `staleness` is the largest number of versions by which any walker's mixture was ever behind; without it the
    /// search covers some thousands of decisions.
    pub async fn covered_since(
        &self,
        decision: i64,
        version: u64,
        staleness: Option<u64>,
    ) -> Result<LaterCoveredCandidates> {
        let (mut found, mut last) = (LaterCoveredCandidates::default(), decision);
        let is_over = |decided: u64| staleness.is_some_and(|most| decided >= version.saturating_add(most));
        loop {
            let page: Vec<After> = query(AFTER).bind(last).bind(PAGE).fetch_all(&self.database).await?;
            let Some(end) = page.last() else { return Ok(found) };
            last = end.sequence;
            let over = is_over(end.decided);
            found.candidates.extend(page.into_iter().filter_map(|row| row.covered_before(version)));
            if over {
                return Ok(found);
            }
            if last >= decision + MAX_DECISIONS {
                found.searched_until = Some(last);
                return Ok(found);
            }
        }
    }
}

impl After {
    fn covered_before(self, version: u64) -> Option<CoveredCandidate> {
        let Self { sequence, id, reason, seen, decided } = self;
        let (candidate, seen) = id.zip(seen)?;
        let covered = reason.as_deref() == Some("covered") && seen < version;
        covered.then_some(CoveredCandidate {
            named: CandidateRef { decision: sequence, candidate },
            seen,
            decided,
        })
    }
}

impl FromRow for StructureLabel {
    fn from_row(row: &SqlRow) -> Result<Self> {
        let (hash, settings): (Vec<u8>, String) = (row.get("protocol_hash")?, row.get("settings")?);
        let settings = serde_json::from_str(&settings);
        let protocol = Protocol {
            hash: decode_hash(&hash)?,
            name: row.get("protocol_name")?,
            settings: settings.map_err(|error| StoreError::damaged("a protocol", error))?,
        };
        Ok(Self { protocol, record: LabelRow::from_row(row)?.into_record()? })
    }
}
