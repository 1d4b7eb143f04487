//! Errors of the potential for single labelled candidates.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use atoms::cell::{norm, sub};
use serde::Serialize;
use store::{LabelledCandidate, Store, StoreError};
use wire::ContentHash;

use crate::energy_errors::ProtocolEnergyOffsets;
use crate::label_statistics::frames::{mean, stress_error};

/// Errors of a candidate against its label under the protocol in force; `None` where they are not known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CandidateErrors {
    /// E_model − E_label per atom without the offsets of the elements, eV.
    pub energy: Option<f64>,
    /// Mean absolute error of the force components, eV/Å.
    pub force_mae: Option<f64>,
    /// Largest |F_model − F_label| of an atom, eV/Å.
    pub max_force_error: Option<f64>,
    /// Root mean square error of the six components of the stress, eV/Å³.
    pub stress: Option<f64>,
}

/// Candidates whose labels are in memory at a time.
const PAGE: usize = 32;

/// Reads errors of single candidates, and keeps what all have in common.
#[derive(Debug)]
pub struct ErrorReader {
    /// `None` without a label protocol.
    protocol: Option<ContentHash>,
    /// Offsets of the elements, by version of the potential.
    offsets: BTreeMap<u32, ProtocolEnergyOffsets>,
}

impl ErrorReader {
    /// For the labels of the protocol in force.
    pub async fn new(store: &Store) -> Result<Self, StoreError> {
        let protocol = store.protocol_in_force().await?.map(|protocol| protocol.hash);
        Ok(Self { protocol, offsets: BTreeMap::new() })
    }

    /// The errors of candidates, each given by its decision and the version of the potential of its walk; `None` without a label.
    pub async fn read(
        &mut self,
        store: &Store,
        candidates: &[(i64, u32)],
    ) -> Result<Vec<Option<CandidateErrors>>, StoreError> {
        let mut found = BTreeMap::new();
        if let Some(protocol) = self.protocol {
            for page in candidates.chunks(PAGE) {
                self.read_page(store, protocol, page, &mut found).await?;
            }
        }
        Ok(candidates.iter().map(|(decision, _)| found.get(decision).copied()).collect())
    }

    async fn read_page(
        &mut self,
        store: &Store,
        protocol: ContentHash,
        page: &[(i64, u32)],
        found: &mut BTreeMap<i64, CandidateErrors>,
    ) -> Result<(), StoreError> {
        let decisions: Vec<_> = page.iter().map(|(decision, _)| *decision).collect();
        let versions: BTreeMap<_, _> = page.iter().copied().collect();
        for row in store.labelled_of_decisions(protocol, &decisions).await? {
            let version = versions.get(&row.decision).copied().unwrap_or_default();
            let offsets = match self.offsets.entry(version) {
                Entry::Occupied(known) => known.into_mut(),
                Entry::Vacant(place) => {
                    place.insert(ProtocolEnergyOffsets::fit(store, protocol, version).await?)
                }
            };
            found.insert(row.decision, errors(&row, offsets));
        }
        Ok(())
    }
}

fn errors(row: &LabelledCandidate, offsets: &ProtocolEnergyOffsets) -> CandidateErrors {
    let view = row.block.view();
    let differences: Vec<_> =
        view.forces.iter().zip(&row.label.forces).map(|(model, label)| sub(*model, *label)).collect();
    CandidateErrors {
        energy: offsets.error_per_atom(&row.structure, view.energy(), row.label.energy),
        force_mae: mean(differences.iter().flatten().map(|component| component.abs())),
        max_force_error: differences.iter().map(|difference| norm(*difference)).reduce(f64::max),
        stress: row.label.stress.and_then(|label| stress_error(&row.structure, view.virial(), label)),
    }
}
