//! Reference for the energies of labels: the potential's energies plus offsets of the elements, fitted to labels.

use analysis::EnergyOffsets;
use dft::CalculationResults;
use monitor::energy_offsets::energy_offsets;
use store::records::{Lease, Protocol};
use store::{Store, StoreError};
use tokio_util::sync::CancellationToken;

use super::retry_until_written;

/// The fit is repeated when this labeller has made 1/8 as many new labels as the last fit used.
const REFIT_DIVISOR: usize = 8;

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
    /// The version of the potential whose energies were fitted: another version may have another zero.
    version: u32,
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
        result: &Result<CalculationResults, dft::Failure>,
        stop: &CancellationToken,
    ) -> Result<Option<EnergyReference<'_>>, StoreError> {
        let Some(model) = lease.model_energy.filter(|_| result.is_ok()) else { return Ok(None) };
        let versions = retry_until_written(stop, || store.walk_versions()).await?;
        let version = versions.of_candidate(&lease.candidate);
        if self.until_refit == 0 || self.version != version {
            self.version = version;
            self.fitted =
                retry_until_written(stop, || energy_offsets(store, protocol.hash, version)).await?.ok();
            self.until_refit =
                self.fitted.as_ref().map_or(0, |fitted| fitted.structures() / REFIT_DIVISOR).max(1);
        }
        self.until_refit -= 1;
        Ok(self.fitted.as_ref().map(|offsets| EnergyReference { model, offsets }))
    }
}
