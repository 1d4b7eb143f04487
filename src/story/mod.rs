//! The whole story of one candidate, as far as the store records it: who found it, under which grades, what was decided by
//! which rule, what became of its label, and what it covered later.
//!
//! Reading is here, and printing is up to whoever shows it: `calmwalk explain` in words, others as they like. What it gives as
//! JSON is described in docs/explain.md; [`FORMAT`] changes with it.

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

pub use decision::{Coverage, Decided, ELEMENTS, Update};
pub use grades::{Atom, Grades, Trigger};
pub use labels::{ForceError, LabelJob, StoryLabel};
pub use walk::{Distances, Found};

/// Version of the JSON form: fields may be added to it under one number, and none taken away or changed.
pub const FORMAT: u32 = 1;

/// How imported structures are named: `import-1` is the first.
pub const IMPORT: &str = "import-";

/// The story of one structure.
#[derive(Clone, Debug, Serialize)]
pub struct Story {
    /// [`FORMAT`].
    pub format: u32,
    /// Id of the campaign.
    pub campaign: String,
    /// Name of the candidate, or `import-N`.
    pub id: String,
    /// `biased`, `control` or `imported`.
    pub kind: &'static str,
    /// What it is.
    pub structure: Description,
    /// The file that an imported structure came from.
    pub file: Option<String>,
    /// The frame in it, from 0.
    pub frame: Option<u64>,
    /// The walk that found it.
    pub found: Option<Found>,
    /// Its grades under three mixtures.
    pub grades: Option<Grades>,
    /// What was decided.
    pub decision: Option<Decided>,
    /// Other candidates with the very same structure.
    pub same_structure: Vec<CandidateRef>,
    /// The import with the very same structure.
    pub same_import: Option<i64>,
    /// Its label jobs, one a protocol at most.
    pub jobs: Vec<LabelJob>,
    /// Its labels, checks and superseded labels.
    pub labels: Vec<StoryLabel>,
    /// What one may ask, and the store cannot answer.
    pub not_recorded: Vec<&'static str>,
}

/// A structure in a few words.
#[derive(Clone, Debug, Serialize)]
pub struct Description {
    /// Formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: usize,
    /// Number of atoms of each element.
    pub elements: BTreeMap<&'static str, usize>,
    /// Periodic along each lattice vector.
    pub periodic: [bool; 3],
    /// Å³; none without a cell.
    pub volume: Option<f64>,
    /// BLAKE3 of species, positions, cell and periodicity.
    pub hash: String,
}

/// Reads the story of the candidate or imported structure that is called so: the number of the decision about it, its name or the
/// beginning of that, or `import-N`.
pub async fn read(store: &Store, id: &str) -> Result<Story, StoreError> {
    match id.strip_prefix(IMPORT) {
        Some(number) => of_import(store, id, number).await,
        None => {
            let named = store.find_candidate(id).await?;
            of_candidate(store, named).await
        }
    }
}

async fn of_import(store: &Store, id: &str, number: &str) -> Result<Story, StoreError> {
    let found = match number.parse() {
        Ok(number) => store.imported_structure(number).await?,
        Err(_) => None,
    };
    let Some(found) = found else {
        let imported = store.imported_structures().await?;
        return Err(StoreError::UnknownImport { id: id.to_owned(), imported });
    };
    let mut story = Story::new(store, id, "imported", &found.structure, found.content).await?;
    story.file = Some(found.file);
    story.frame = Some(found.frame);
    story.same_import = None;
    story.labels = labels::labels(store, found.content, None).await?;
    story
        .not_recorded
        .push("grades: the store has none of imported structures (calmwalk calm score gives them)");
    Ok(story)
}

async fn of_candidate(store: &Store, named: CandidateRef) -> Result<Story, StoreError> {
    let stored = store.candidate(&named.candidate).await?;
    let stored = stored.ok_or_else(|| damaged(&named, "it is not there"))?;
    let logged = store.decisions(stored.decision..=stored.decision).await?.into_iter().next();
    let logged = logged.ok_or_else(|| damaged(&named, "the decision about it is not there"))?;
    let rules = rules(store).await?;
    let view = stored.block.view();
    let (structure, content) = (view.structure(), view.id().content);
    let kind = view.origin().name();
    let mut story = Story::new(store, &named.candidate, kind, &structure, content).await?;
    story.same_structure.retain(|other| *other != named);
    story.found = Some(Found::read(store, &stored, &rules).await?);
    story.grades = Some(Grades::of(&stored, &rules, &logged));
    story.decision = Some(Decided::read(store, &logged, &stored, &rules).await?);
    story.labels = labels::labels(store, content, Some(&view)).await?;
    story.not_recorded = not_recorded(&stored);
    Ok(story)
}

impl Story {
    /// What candidates and imported structures have in common.
    async fn new(
        store: &Store,
        id: &str,
        kind: &'static str,
        structure: &Structure,
        content: ContentHash,
    ) -> Result<Self, StoreError> {
        let same = store.same_structure(content).await?;
        Ok(Self {
            format: FORMAT,
            campaign: store.campaign().await?.id.to_string(),
            id: id.to_owned(),
            kind,
            structure: Description::of(structure, content),
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

impl Description {
    fn of(structure: &Structure, content: ContentHash) -> Self {
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
            hash: content.to_string(),
        }
    }
}

/// The configuration with which the campaign began: what its rules for collecting, updating and guarding are, they stay.
async fn rules(store: &Store) -> Result<Value, StoreError> {
    let text = store.campaign().await?.resolved_configuration;
    serde_json::from_str(&text).map_err(|error| StoreError::damaged("the configuration", error))
}

/// What somebody might look for in vain.
fn not_recorded(stored: &StoredCandidate) -> Vec<&'static str> {
    let view = stored.block.view();
    let mut missing = vec!["what other walks would have offered without it: only what was offered is known"];
    if view.origin() == wire::Origin::Biased {
        missing.push("components as they were before: the store keeps the newest of each (calmwalk replay makes the others again)");
    }
    if stored.features.is_none() {
        missing.push("features: not kept (collect.declined_features_mb), so other grades cannot be computed from the store");
    }
    missing
}

fn damaged(named: &CandidateRef, problem: &str) -> StoreError {
    StoreError::damaged("a candidate", format!("{}: {problem}", named.candidate))
}
