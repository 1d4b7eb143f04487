//! Selects the structures to relabel.

use std::collections::{BTreeMap, HashSet};

use monitor::candidate_details::IMPORT_PREFIX;
use store::{ExportFilter, JobState, PendingJobs, Relabellable, Store, StoreError};
use wire::ContentHash;

use super::CommandError;
use crate::export_frame::facts;
use crate::filter::StructureFilter;
use crate::output;

/// Structures per read.
const PAGE: u32 = 200;

/// Labelled structures: those to relabel, and the numbers of those that are skipped.
#[derive(Default)]
pub struct Selection {
    selected: Vec<Relabellable>,
    /// Already waiting for a new label.
    pub waiting: u64,
    /// Already labelled by the protocol.
    pub labelled: u64,
    /// Dropped from the queue of the protocol.
    pub dropped: u64,
}

impl Selection {
    /// `include_current`: also structures labelled by the protocol.
    pub fn new(all: Vec<Relabellable>, include_current: bool) -> Self {
        let mut selection = Self::default();
        for structure in all {
            match structure.job {
                Some(JobState::Queued | JobState::Leased) => selection.waiting += 1,
                Some(JobState::Dropped) => selection.dropped += 1,
                Some(JobState::Labelled) if !include_current => selection.labelled += 1,
                _ => selection.selected.push(structure),
            }
        }
        selection
    }

    /// The structures of these candidates and imports, whatever the protocol of their labels.
    pub async fn from_ids(
        store: &Store,
        all: Vec<Relabellable>,
        ids: &[String],
    ) -> Result<Self, CommandError> {
        let mut wanted = HashSet::new();
        for id in ids {
            let (name, content) = structure_named(store, id).await?;
            if !all.iter().any(|structure| structure.content == content) {
                return Err(CommandError::Input(format!(
                    "{name} has no label that calmwalk made: see calmwalk explain (to queue a failed or dropped structure again, \
                     use calmwalk queue … retry)"
                )));
            }
            wanted.insert(content.0);
        }
        let selected = all.into_iter().filter(|structure| wanted.contains(&structure.content.0)).collect();
        Ok(Self::new(selected, true))
    }

    /// Hashes of the selected structures.
    pub fn structures(&self) -> Vec<ContentHash> {
        self.selected.iter().map(|structure| structure.content).collect()
    }

    /// Numbers of selected structures by size.
    pub fn sizes(&self) -> Vec<PendingJobs> {
        let mut sizes: BTreeMap<_, u64> = BTreeMap::new();
        for Relabellable { seed_structure, formula, atoms, .. } in &self.selected {
            *sizes.entry((*seed_structure, formula.clone(), *atoms)).or_default() += 1;
        }
        let waiting =
            |((seed_structure, formula, atoms), jobs)| PendingJobs { seed_structure, formula, atoms, jobs };
        sizes.into_iter().map(waiting).collect()
    }

    /// The labels to replace, by protocol, as the end of a sentence.
    pub fn replaced(&self) -> String {
        let mut protocols: BTreeMap<&str, u64> = BTreeMap::new();
        for structure in &self.selected {
            *protocols.entry(&structure.protocol).or_default() += 1;
        }
        let counts: Vec<_> = protocols
            .iter()
            .map(|(name, count)| format!("{} of '{name}'", output::count(*count, "label")))
            .collect();
        if counts.is_empty() { String::new() } else { format!(", to replace {}", counts.join(", ")) }
    }

    /// Lines about the structures that are not relabelled.
    pub fn skipped(&self, protocol: &str) -> Vec<String> {
        let lines = [
            (self.waiting, "already queued".to_owned()),
            (self.labelled, format!("already labelled by '{protocol}' (use --include-current to relabel)")),
            (self.dropped, "dropped".to_owned()),
        ];
        let lines = lines.into_iter().filter(|(count, _)| *count > 0);
        lines
            .map(|(count, reason)| format!("{} skipped: {reason}", output::count(count, "structure")))
            .collect()
    }
}

/// Name and hash of the structure of a candidate, or of `import-N`.
async fn structure_named(store: &Store, id: &str) -> Result<(String, ContentHash), CommandError> {
    if let Some(number) = id.strip_prefix(IMPORT_PREFIX) {
        let found = match number.parse() {
            Ok(number) => store.imported_structure(number).await?,
            Err(_) => None,
        };
        let imported = store.imported_structures().await?;
        let found = found.ok_or_else(|| StoreError::UnknownImport { id: id.to_owned(), imported })?;
        return Ok((id.to_owned(), found.content));
    }
    let candidate = store.find_candidate(id).await?.candidate;
    match store.candidate(&candidate).await? {
        Some(stored) => Ok((candidate, stored.block.view().id().content)),
        None => Err(CommandError::Input(format!("there is no candidate {candidate}"))),
    }
}

/// The structures whose labels match the filter.
pub async fn matching(
    store: &Store,
    all: Vec<Relabellable>,
    condition: &StructureFilter,
) -> Result<Vec<Relabellable>, CommandError> {
    let mut matching = HashSet::new();
    let conditions = store.walk_conditions().await?;
    for protocol in store.protocols().await? {
        let filter = ExportFilter { protocol: protocol.hash, biased: true, control: true, imported: true };
        let mut last = None;
        loop {
            let page = store.labelled(&filter, last, PAGE).await?;
            let Some(row) = page.last() else { break };
            last = Some(row.cursor);
            let rows = page.iter().filter(|row| condition.matches(&facts(row, &conditions)));
            matching.extend(rows.map(|row| ContentHash::from_structure(&row.structure).0));
        }
    }
    let all: Vec<_> = all.into_iter().filter(|structure| matching.contains(&structure.content.0)).collect();
    if all.is_empty() {
        return Err(CommandError::Input(format!("no labelled structure matches --where '{condition}'")));
    }
    Ok(all)
}
