//! Labelled structures of one version, in the order in which their labels came.

use std::collections::VecDeque;

use analysis::GradedError;
use atoms::cell::{norm, sub};
use store::{LabelArrival, LabelledCandidate, Store, StoreError, WalkVersions};
use wire::ContentHash;

use super::CalibrationState;

/// Rows read from the store at a time.
pub(super) const PAGE_ROWS: u32 = 256;

/// A labelled structure.
pub struct ArrivedLabel {
    /// Hash of the structure.
    pub content: ContentHash,
    /// Whether the queue chose it by value.
    pub ordered_by_value: bool,
    /// γ_nbr under the original mixture, |ΔF| in eV/Å and element of each atom.
    pub atoms: Vec<GradedError<&'static str>>,
}

/// Reads labelled structures page by page. A structure that several walks found has one label, and counts once.
pub struct ArrivedLabels<'a> {
    store: &'a Store,
    protocol: ContentHash,
    versions: WalkVersions,
    version: u32,
    page: VecDeque<LabelArrival>,
    /// Label and decision of the last row that was read.
    after: Option<(i64, i64)>,
    /// The last label that was returned.
    last: i64,
}

impl<'a> ArrivedLabels<'a> {
    pub async fn new(store: &'a Store, protocol: ContentHash, version: u32) -> Result<Self, StoreError> {
        let versions = store.walk_versions().await?;
        Ok(Self { store, protocol, versions, version, page: VecDeque::new(), after: None, last: 0 })
    }

    /// The next structure that a walk with the version found.
    pub async fn next(&mut self) -> Result<Option<ArrivedLabel>, StoreError> {
        loop {
            let Some(arrival) = self.page.pop_front() else {
                self.page = self.store.label_arrivals(self.protocol, self.after, PAGE_ROWS).await?.into();
                let Some(last) = self.page.back() else { return Ok(None) };
                self.after = Some((last.number, last.candidate.decision));
                continue;
            };
            if arrival.number != self.last && version_of(&arrival, &self.versions) == self.version {
                self.last = arrival.number;
                return Ok(Some(labelled_structure(&arrival.candidate)));
            }
        }
    }
}

/// The version of the potential of the walk that found a structure.
pub(super) fn version_of(arrival: &LabelArrival, versions: &WalkVersions) -> u32 {
    versions.version_of(arrival.candidate.block.view().id().walk.0)
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
