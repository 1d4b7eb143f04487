//! Which structures are labelled again.

use std::collections::{BTreeMap, HashSet};

use store::{ExportFilter, JobState, Relabellable, Store, Waiting};
use wire::ContentHash;

use super::Failure;
use crate::cli::export::frame::facts;
use crate::condition::Condition;
use crate::output;

/// Structures read at a time.
const PAGE: u32 = 200;

/// Structures that have their labels, by what becomes of them.
#[derive(Default)]
pub struct Choice {
    /// Those that are labelled again.
    again: Vec<Relabellable>,
    /// Number of those that wait for another label already.
    pub waiting: u64,
    /// Number of those that have their label by the protocol, and keep it.
    pub labelled: u64,
    /// Number of those that were dropped for that protocol.
    pub dropped: u64,
}

impl Choice {
    /// `again`: also those that have their labels by that protocol.
    pub fn of(all: Vec<Relabellable>, again: bool) -> Self {
        let mut choice = Self::default();
        for one in all {
            match one.job {
                Some(JobState::Queued | JobState::Leased) => choice.waiting += 1,
                Some(JobState::Dropped) => choice.dropped += 1,
                Some(JobState::Labelled) if !again => choice.labelled += 1,
                _ => choice.again.push(one),
            }
        }
        choice
    }

    /// Those of that name, whatever their labels are.
    pub async fn named(store: &Store, all: Vec<Relabellable>, ids: &[String]) -> Result<Self, Failure> {
        let mut wanted = HashSet::new();
        for id in ids {
            let candidate = store.find_candidate(id).await?.candidate;
            let content = match store.candidate(&candidate).await? {
                Some(stored) => stored.block.view().id().content,
                None => return Err(Failure::Input(format!("there is no candidate {candidate}"))),
            };
            if !all.iter().any(|one| one.content == content) {
                return Err(Failure::Input(format!(
                    "{candidate} has no label that could be made again: calmwalk explain tells why (calmwalk queue … retry \
                     puts failed and dropped ones back)"
                )));
            }
            wanted.insert(content.0);
        }
        Ok(Self::of(all.into_iter().filter(|one| wanted.contains(&one.content.0)).collect(), true))
    }

    /// Their hashes.
    pub fn structures(&self) -> Vec<ContentHash> {
        self.again.iter().map(|one| one.content).collect()
    }

    /// How many there are of each size.
    pub fn sizes(&self) -> Vec<Waiting> {
        let mut sizes: BTreeMap<_, u64> = BTreeMap::new();
        for Relabellable { seed_structure, formula, atoms, .. } in &self.again {
            *sizes.entry((*seed_structure, formula.clone(), *atoms)).or_default() += 1;
        }
        let waiting =
            |((seed_structure, formula, atoms), jobs)| Waiting { seed_structure, formula, atoms, jobs };
        sizes.into_iter().map(waiting).collect()
    }

    /// The protocols of their labels, in words.
    pub fn by(&self) -> String {
        let mut protocols: BTreeMap<&str, u64> = BTreeMap::new();
        for one in &self.again {
            *protocols.entry(&one.protocol).or_default() += 1;
        }
        let counts: Vec<_> = protocols
            .iter()
            .map(|(name, count)| format!("{} by '{name}'", output::count(*count, "label")))
            .collect();
        if counts.is_empty() { String::new() } else { format!(", in the place of {}", counts.join(", ")) }
    }

    /// What is said of the others.
    pub fn left_alone(&self, protocol: &str) -> Vec<String> {
        let lines = [
            (self.waiting, "waiting for it already".to_owned()),
            (self.labelled, format!("labelled by '{protocol}' already; --again asks for others")),
            (self.dropped, "dropped".to_owned()),
        ];
        let said = lines.into_iter().filter(|(count, _)| *count > 0);
        said.map(|(count, what)| format!("{} left alone: {what}", output::count(count, "structure")))
            .collect()
    }
}

/// Those whose labels meet a condition.
pub async fn meeting(
    store: &Store,
    all: Vec<Relabellable>,
    condition: &Condition,
) -> Result<Vec<Relabellable>, Failure> {
    let mut meeting = HashSet::new();
    for protocol in store.protocols().await? {
        let filter = ExportFilter { protocol: protocol.hash, biased: true, control: true, imported: false };
        let mut last = None;
        loop {
            let page = store.labelled(&filter, last, PAGE).await?;
            let Some(row) = page.last() else { break };
            last = Some(row.place);
            let met = page.iter().filter(|row| condition.is_met(&facts(row)));
            meeting.extend(met.map(|row| ContentHash::from_structure(&row.structure).0));
        }
    }
    let all: Vec<_> = all.into_iter().filter(|one| meeting.contains(&one.content.0)).collect();
    if all.is_empty() {
        return Err(Failure::Input(format!("no labelled structure meets --where '{condition}'")));
    }
    Ok(all)
}
