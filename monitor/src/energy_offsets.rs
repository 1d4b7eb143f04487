//! Offsets of the elements between the energies of labels and those of the potential, fitted to the newest labels.

use analysis::{EnergyOffsets, LabelledEnergy, TooFewLabels};
use atoms::{Structure, composition};
use store::{Store, StoreError};
use wire::ContentHash;

/// Number of labels in the fit: the newest ones.
const MAX_FIT_LABELS: u32 = 2_000;

/// Fits the energy offsets of elements to the newest labels of a protocol, without excluded ones, and the energies of one version
/// of the potential: another version may have another zero.
///
/// # Errors
/// Errors of the database; in the inner result, [`TooFewLabels`] for a fit.
pub async fn energy_offsets(
    store: &Store,
    protocol: ContentHash,
    version: u32,
) -> Result<Result<EnergyOffsets, TooFewLabels>, StoreError> {
    let labels = store.labelled_energies(protocol, version, MAX_FIT_LABELS).await?;
    let labels = labels.into_iter().map(|found| LabelledEnergy {
        composition: found.composition.iter().map(|(species, n)| (species.atomic_number(), *n)).collect(),
        model: found.model,
        label: found.label,
    });
    Ok(EnergyOffsets::fit(&labels.collect::<Vec<_>>()))
}

/// A structure's energies by the potential and by its label, eV, for the fit.
pub fn labelled_energy(structure: &Structure, model: f64, label: f64) -> LabelledEnergy {
    LabelledEnergy { composition: composition(&structure.species), model, label }
}
