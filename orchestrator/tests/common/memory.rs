//! The store as the selector sees it, in memory.

use std::collections::{BTreeMap, BTreeSet};

use orchestrator::selector::SelectorSnapshot;
use store::records::{Commit, ComponentRecord, Decision, Fate, WalkRecord};
use wire::{ContentHash, Origin, WalkId};

#[derive(Clone, Debug, Default, PartialEq)]
pub struct MemoryStore {
    pub decisions: Vec<Decision>,
    pub candidates: BTreeSet<String>,
    pub known: Vec<ContentHash>,
    pub imported: Vec<ContentHash>,
    pub components: BTreeMap<(u32, u32), Vec<u8>>,
    pub walks: BTreeMap<WalkId, WalkRecord>,
    pub values: BTreeMap<String, String>,
}

impl MemoryStore {
    /// Applies a commit like the database, with the same checks.
    pub fn commit(&mut self, commit: &Commit) {
        let decided: Vec<_> = commit.decisions.iter().filter_map(|decision| decision.candidate).collect();
        let there: Vec<_> = commit.candidates.iter().map(|candidate| candidate.block.view().id()).collect();
        assert_eq!(decided, there, "every decision about a candidate has it, in the same order");
        for candidate in &commit.candidates {
            let view = candidate.block.view();
            assert!(self.candidates.insert(view.id().to_string()), "{} came twice", view.id());
            if candidate.fate == Fate::Accepted && view.origin() == Origin::Biased {
                self.known.push(view.id().content);
            }
        }
        self.decisions.extend(commit.decisions.iter().cloned());
        if commit.restart_mixture {
            self.components.clear();
        }
        for ComponentRecord { element, slot, bytes } in &commit.components {
            self.components.insert((*element, *slot), bytes.clone());
        }
        self.walks.extend(commit.walks.iter().map(|walk| (walk.walk, walk.clone())));
        self.values.extend(commit.values.iter().cloned());
    }

    pub fn snapshot(&self) -> SelectorSnapshot {
        let components = self.components.iter();
        SelectorSnapshot {
            imported: self.imported.len() as u64,
            walks: self.walks.values().cloned().collect(),
            components: components
                .map(|(&(element, slot), bytes)| ComponentRecord { element, slot, bytes: bytes.clone() })
                .collect(),
            known: [self.known.as_slice(), &self.imported].concat(),
            values: self.values.clone().into_iter().collect(),
        }
    }
}
