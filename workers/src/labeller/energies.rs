//! Reference for the energies of labels: the potential's energies plus offsets of the elements, fitted to labels.

use std::collections::BTreeMap;

use analysis::{EnergyOffsets, LabelledEnergy, TooFewLabels};
use atoms::Structure;
use dft::Results;
use store::records::{Lease, Protocol};
use store::{Store, StoreError};
use wire::ContentHash;

use super::{Shutdown, retry_until_written};

/// Number of labels in the fit: the newest ones.
const MAX_FIT_LABELS: u32 = 2_000;
/// The fit is repeated when this labeller has made 1/8 as many new labels as the last fit used.
const REFIT_DIVISOR: usize = 8;

/// Fits the energy offsets of elements to the newest labels of a protocol, without excluded ones.
///
/// # Errors
/// Errors of the database; in the inner result, [`TooFewLabels`] for a fit.
pub async fn energy_offsets(
    store: &Store,
    protocol: ContentHash,
) -> Result<Result<EnergyOffsets, TooFewLabels>, StoreError> {
    let labels = store.labelled_energies(protocol, MAX_FIT_LABELS).await?;
    let labels = labels.into_iter().map(|found| LabelledEnergy {
        composition: found.composition.iter().map(|(species, n)| (species.atomic_number(), *n)).collect(),
        model: found.model,
        label: found.label,
    });
    Ok(EnergyOffsets::fit(&labels.collect::<Vec<_>>()))
}

/// A structure's energies by the potential and by its label, eV, for the fit.
pub fn labelled_energy(structure: &Structure, model: f64, label: f64) -> LabelledEnergy {
    let mut counts = BTreeMap::new();
    for species in &structure.species {
        *counts.entry(species.atomic_number()).or_default() += 1;
    }
    LabelledEnergy { composition: counts.into_iter().collect(), model, label }
}

/// The reference for the energy of a label.
#[derive(Clone, Copy, Debug)]
pub(super) struct EnergyReference<'a> {
    /// Energy by the potential, eV.
    pub model: f64,
    /// Offsets of the elements, fitted to the labels so far.
    pub offsets: &'a EnergyOffsets,
}

/// A labeller's current offsets.
#[derive(Debug, Default)]
pub(super) struct Offsets {
    fitted: Option<EnergyOffsets>,
    /// Labels until the next fit.
    until_refit: usize,
}

impl Offsets {
    /// The reference for the energy of a result; `None` if there is none yet.
    pub async fn energy_reference(
        &mut self,
        store: &Store,
        protocol: &Protocol,
        lease: &Lease,
        result: &Result<Results, dft::Failure>,
        shutdown: &Shutdown,
    ) -> Result<Option<EnergyReference<'_>>, StoreError> {
        let Some(model) = lease.model_energy.filter(|_| result.is_ok()) else { return Ok(None) };
        if self.until_refit == 0 {
            self.fitted = retry_until_written(shutdown, || energy_offsets(store, protocol.hash)).await?.ok();
            self.until_refit =
                self.fitted.as_ref().map_or(0, |fitted| fitted.structures() / REFIT_DIVISOR).max(1);
        }
        self.until_refit -= 1;
        Ok(self.fitted.as_ref().map(|offsets| EnergyReference { model, offsets }))
    }
}
