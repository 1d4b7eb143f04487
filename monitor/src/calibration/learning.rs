//! Labelled structures of one version, in the order in which their labels came.

use std::collections::VecDeque;

use analysis::GradedError;
use atoms::cell::{norm, sub};
use store::{LabelArrival, LabelledCandidate, Store, StoreError, WalkVersions};
use wire::ContentHash;

use super::CalibrationState;

/// Rows read from the store at a time.
const PAGE_ROWS: u32 = 256;

/// A labelled structure.
pub struct ArrivedLabel {
    /// Hash of the structure.
    pub content: ContentHash,
    /// Whether the queue chose it by value.
    pub ordered_by_value: bool,
    /// γ_nbr under the original mixture, |ΔF| in eV/Å and element of each atom.
    pub atoms: Vec<GradedError<&'static str>>,
}

/// Reads the rows of labelled structures page by page, with the version of the potential of the walk that found each.
pub(super) struct ArrivalPages<'a> {
    store: &'a Store,
    protocol: ContentHash,
    /// Label and decision of the last row that was read.
    after: Option<(i64, i64)>,
    versions: WalkVersions,
    /// The versions of the walks of all decisions up to this one are known.
    known_until: i64,
}

impl<'a> ArrivalPages<'a> {
    pub fn new(store: &'a Store, protocol: ContentHash, after: Option<(i64, i64)>) -> Self {
        Self { store, protocol, after, versions: WalkVersions::default(), known_until: 0 }
    }

    /// The next rows; none at the end.
    pub async fn next(&mut self) -> Result<Vec<(u32, LabelArrival)>, StoreError> {
        let page = self.store.label_arrivals(self.protocol, self.after, PAGE_ROWS).await?;
        // Versions that were read before the page may lack walks that have begun meanwhile.
        if page.iter().any(|arrival| arrival.candidate.decision > self.known_until) {
            self.known_until = self.store.newest_candidate().await?;
            self.versions = self.store.walk_versions().await?;
        }
        self.after = page.last().map(|last| (last.number, last.candidate.decision)).or(self.after);
        let version_of =
            |arrival: &LabelArrival| self.versions.version_of(arrival.candidate.block.view().id().walk.0);
        Ok(page.into_iter().map(|arrival| (version_of(&arrival), arrival)).collect())
    }

    /// Label and decision of the last row that was read.
    pub fn after(&self) -> Option<(i64, i64)> {
        self.after
    }
}

/// Reads labelled structures one by one. A structure that several walks found has one label, and counts once.
pub struct ArrivedLabels<'a> {
    pages: ArrivalPages<'a>,
    version: u32,
    page: VecDeque<(u32, LabelArrival)>,
    /// The last label that was returned.
    last: i64,
}

impl<'a> ArrivedLabels<'a> {
    pub fn new(store: &'a Store, protocol: ContentHash, version: u32) -> Self {
        Self { pages: ArrivalPages::new(store, protocol, None), version, page: VecDeque::new(), last: 0 }
    }

    /// The next structure that a walk with the version found.
    pub async fn next(&mut self) -> Result<Option<ArrivedLabel>, StoreError> {
        loop {
            let Some((version, arrival)) = self.page.pop_front() else {
                self.page = self.pages.next().await?.into();
                if self.page.is_empty() {
                    return Ok(None);
                }
                continue;
            };
            if arrival.number != self.last && version == self.version {
                self.last = arrival.number;
                return Ok(Some(labelled_structure(&arrival.candidate)));
            }
        }
    }
}

/// What is learned from a structure.
pub(super) fn labelled_structure(candidate: &LabelledCandidate) -> ArrivedLabel {
    let LabelledCandidate { structure, block, original, label, .. } = candidate;
    let view = block.view();
    let errors = view.forces.iter().zip(&label.forces).map(|(model, label)| norm(sub(*model, *label)));
    let species = structure.species.iter().map(|species| species.symbol());
    let atoms = original.gamma_nbr.iter().zip(errors).zip(species);
    ArrivedLabel {
        content: view.id().content,
        ordered_by_value: label.details.ordered_by_value,
        atoms: atoms.map(|((grade, error), group)| GradedError { grade: *grade, error, group }).collect(),
    }
}

impl CalibrationState {
    /// Compares a labelled structure with the bounds, then learns from it.
    pub(super) fn learn(&mut self, labelled: &ArrivedLabel) {
        let number = self.structures();
        let map = if labelled.ordered_by_value { &mut self.by_value } else { &mut self.found };
        map.learn(number, &labelled.atoms);
    }
}
