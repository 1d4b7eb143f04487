//! Everything that the store records about one candidate: its walk, grades, decision and labels, and which candidates
//! it covered later.
//!
//! This module reads the details; `calmwalk explain` and the dashboard show them. docs/explain.md describes the JSON
//! form, whose version is [`FORMAT`].

mod decision;
mod grades;
mod labels;
mod walk;

use std::collections::BTreeMap;

use atoms::Structure;
use serde::Serialize;
use serde_json::Value;
use store::{CandidateRef, CoveredCandidate, Store, StoreError, StoredCandidate};
use wire::ContentHash;

pub use decision::{Coverage, DecisionDetails, ELEMENTS_KEY, UpdateDetails};
pub use grades::{CandidateGrades, GradedAtom, Trigger};
pub use labels::{CandidateLabel, ForceError, LabelJob};
pub use walk::{Discovery, GuardDistances, GuardPairDistance};

/// Version of the JSON form. Adding fields keeps the version; removing or changing them increments it.
pub const FORMAT: u32 = 1;

/// Prefix of the names of imported structures, which start with `import-1`.
pub const IMPORT_PREFIX: &str = "import-";

/// Details of one structure.
#[derive(Clone, Debug, Serialize)]
pub struct CandidateDetails {
    /// [`FORMAT`].
    pub format: u32,
    /// Id of the campaign.
    pub campaign: String,
    /// Name of the candidate, or `import-N`.
    pub id: String,
    /// `biased`, `control` or `imported`.
    pub origin: &'static str,
    /// Summary of the structure.
    pub structure: StructureSummary,
    /// Source file of an imported structure.
    pub file: Option<String>,
    /// Frame in that file, from 0.
    pub frame: Option<u64>,
    /// Where the walk found it.
    pub found: Option<Discovery>,
    /// Its grades under three mixtures.
    pub grades: Option<CandidateGrades>,
    /// The decision about it.
    pub decision: Option<DecisionDetails>,
    /// Other candidates with an identical structure.
    pub same_structure: Vec<CandidateRef>,
    /// The import with an identical structure.
    pub same_import: Option<i64>,
    /// Its label jobs, at most one per protocol.
    pub jobs: Vec<LabelJob>,
    /// Its labels of any status.
    pub labels: Vec<CandidateLabel>,
    /// Questions that the store cannot answer.
    pub not_recorded: Vec<&'static str>,
}

/// Summary of a structure.
#[derive(Clone, Debug, Serialize)]
pub struct StructureSummary {
    /// Chemical formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: usize,
    /// Number of atoms of each element.
    pub elements: BTreeMap<&'static str, usize>,
    /// Periodic along each lattice vector.
    pub periodic: [bool; 3],
    /// Å³. `None` without a cell.
    pub volume: Option<f64>,
    /// Sets of atoms that bonds join ([`atoms::fragments`]). `None` if its distances cannot be measured.
    pub fragments: Option<usize>,
    /// BLAKE3 hash of species, positions, cell and periodicity.
    pub hash: String,
}

/// Reads the details of a candidate or an imported structure. `id` is the number of its decision, its name or a
/// prefix of it, or `import-N`.
pub async fn read(store: &Store, id: &str) -> Result<CandidateDetails, StoreError> {
    match id.strip_prefix(IMPORT_PREFIX) {
        Some(number) => read_import(store, id, number).await,
        None => {
            let named = store.find_candidate(id).await?;
            read_candidate(store, named).await
        }
    }
}

async fn read_import(store: &Store, id: &str, number: &str) -> Result<CandidateDetails, StoreError> {
    let found = match number.parse() {
        Ok(number) => store.imported_structure(number).await?,
        Err(_) => None,
    };
    let Some(found) = found else {
        let imported = store.imported_structures().await?;
        return Err(StoreError::UnknownImport { id: id.to_owned(), imported });
    };
    let mut details = CandidateDetails::new(store, id, "imported", &found.structure, found.content).await?;
    details.file = Some(found.file);
    details.frame = Some(found.frame);
    details.same_import = None;
    details.labels = labels::labels(store, found.content, None).await?;
    details
        .not_recorded
        .push("grades: the store has none of imported structures (calmwalk calm score computes them)");
    Ok(details)
}

async fn read_candidate(store: &Store, named: CandidateRef) -> Result<CandidateDetails, StoreError> {
    let stored = store.candidate(&named.candidate).await?;
    let stored = stored.ok_or_else(|| damaged(&named, "it is missing"))?;
    let logged = store.decisions(stored.decision..=stored.decision).await?.into_iter().next();
    let logged = logged.ok_or_else(|| damaged(&named, "its decision is missing"))?;
    let rules = rules(store).await?;
    let view = stored.block.view();
    let (structure, content) = (view.structure(), view.id().content);
    let origin = view.origin().name();
    let mut details = CandidateDetails::new(store, &named.candidate, origin, &structure, content).await?;
    details.same_structure.retain(|other| *other != named);
    details.found = Some(Discovery::read(store, &stored, &rules).await?);
    details.grades = Some(CandidateGrades::new(&stored, &rules, &logged));
    details.decision = Some(DecisionDetails::read(store, &logged, &stored, &rules).await?);
    details.labels = labels::labels(store, content, Some(&view)).await?;
    details.not_recorded = not_recorded(&stored);
    Ok(details)
}

impl CandidateDetails {
    /// The fields that candidates and imported structures share.
    async fn new(
        store: &Store,
        id: &str,
        origin: &'static str,
        structure: &Structure,
        content: ContentHash,
    ) -> Result<Self, StoreError> {
        let same = store.same_structure(content).await?;
        Ok(Self {
            format: FORMAT,
            campaign: store.campaign().await?.id.to_string(),
            id: id.to_owned(),
            origin,
            structure: StructureSummary::new(structure, content),
            file: None,
            frame: None,
            found: None,
            grades: None,
            decision: None,
            same_structure: same.candidates,
            same_import: same.import,
            jobs: labels::jobs(store, content).await?,
            labels: Vec::new(),
            not_recorded: Vec::new(),
        })
    }
}

impl StructureSummary {
    fn new(structure: &Structure, content: ContentHash) -> Self {
        let mut elements = BTreeMap::new();
        for species in &structure.species {
            *elements.entry(species.symbol()).or_default() += 1;
        }
        Self {
            formula: structure.formula(),
            atoms: structure.len(),
            elements,
            periodic: structure.periodic,
            volume: Some(structure.cell.volume()).filter(|volume| *volume > 0.0),
            fragments: atoms::fragments(structure).ok(),
            hash: content.to_string(),
        }
    }
}

/// The configuration with which the campaign began. Its rules for collection, updates and guards are fixed.
async fn rules(store: &Store) -> Result<Value, StoreError> {
    let text = store.campaign().await?.resolved_configuration;
    serde_json::from_str(&text).map_err(|error| StoreError::damaged("the configuration", error))
}

/// What the store does not record.
fn not_recorded(stored: &StoredCandidate) -> Vec<&'static str> {
    let view = stored.block.view();
    let mut missing =
        vec!["what other walks would have offered without it: the store has only what they did offer"];
    if view.origin() == wire::Origin::Biased {
        missing.push(
            "earlier components: the store keeps the newest of each (calmwalk replay recomputes the others)",
        );
    }
    if stored.features.is_none() {
        missing.push("features: not kept (collect.declined_features_mb), so other grades cannot be computed from the store");
    }
    missing
}

fn damaged(named: &CandidateRef, problem: &str) -> StoreError {
    StoreError::damaged("a candidate", format!("{}: {problem}", named.candidate))
}
