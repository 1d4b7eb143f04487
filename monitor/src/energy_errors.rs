//! Errors of the potential's energies against labels, after removing element offsets.

use analysis::{EnergyOffsets, SystematicSample, TooFewLabels, quantile};
use atoms::{Structure, element_symbol};
use serde::Serialize;
use store::{Store, StoreError};
use wire::ContentHash;

use crate::energy_offsets::{energy_offsets, labelled_energy};

/// Minimum number of labelled structures that must support a composition before its energy error is shown. One alone
/// would have no error.
const MIN_SUPPORT: f64 = 2.0;
/// Largest number of errors kept for quantiles. Beyond it a systematic sample is kept.
const MAX_SAMPLES: usize = 1 << 20;

/// Element offsets between the energies of one label protocol and those of the potential.
#[derive(Clone, Debug)]
pub struct ProtocolEnergyOffsets(Result<EnergyOffsets, TooFewLabels>);

/// The fitted offsets, for display and JSON.
#[derive(Clone, Debug, Serialize)]
pub struct OffsetSummary {
    /// Labelled structures used in the fit. 0 without a fit.
    pub structures: usize,
    /// Outliers that the fit excludes.
    pub left_out: usize,
    /// The offset of each element. Empty without a fit.
    pub elements: Vec<OffsetEntry>,
    /// Why there is no fit. `None` with a fit.
    #[serde(skip)]
    pub too_few: Option<TooFewLabels>,
}

/// The offset of an element.
#[derive(Clone, Debug, Serialize)]
pub struct OffsetEntry {
    /// Chemical symbol.
    pub element: &'static str,
    /// E_label − E_model per atom, eV.
    pub offset: f64,
    /// Whether the labelled compositions determine the offset of this element. If not, only sums over compositions
    /// are meaningful.
    pub separate: bool,
}

/// Energy errors of labelled structures.
#[derive(Clone, Debug)]
pub struct EnergyErrors {
    reference: ProtocolEnergyOffsets,
    /// Absolute errors, eV/atom.
    errors: SystematicSample<f64>,
    sum: f64,
    largest: f64,
    left_out: u64,
}

/// Summary of the errors.
#[derive(Clone, Debug, Serialize)]
pub struct EnergySummary {
    /// Labelled structures with an error.
    pub structures: u64,
    /// Labelled structures without an error, since too few labels support their compositions.
    pub left_out: u64,
    /// Mean of |E_model − E_label| after removing the offsets, eV/atom. `None` without structures, like the following
    /// fields.
    pub mean: Option<f64>,
    /// Median, eV/atom.
    pub median: Option<f64>,
    /// 90 % quantile, eV/atom.
    pub p90: Option<f64>,
    /// Maximum, eV/atom.
    pub largest: Option<f64>,
    /// The offsets that were removed.
    pub offsets: OffsetSummary,
}

impl ProtocolEnergyOffsets {
    /// Fits the element offsets to the labels of this protocol from walks with this version of the potential.
    pub async fn fit(store: &Store, protocol: ContentHash, version: u32) -> Result<Self, StoreError> {
        energy_offsets(store, protocol, version).await.map(Self)
    }

    /// E_model − E_label per atom after removing the offsets, eV. `None` if too few labels support the composition.
    pub fn error_per_atom(&self, structure: &Structure, model: f64, label: f64) -> Option<f64> {
        let found = labelled_energy(structure, model, label);
        self.0.as_ref().ok()?.error_per_atom(&found, MIN_SUPPORT).filter(|error| error.is_finite())
    }

    /// The fit for display and JSON.
    pub fn summary(&self) -> OffsetSummary {
        let fit = match &self.0 {
            Ok(fit) => fit,
            Err(too_few) => {
                let too_few = Some(*too_few);
                return OffsetSummary { structures: 0, left_out: 0, elements: Vec::new(), too_few };
            }
        };
        let elements = fit.elements().map(|found| OffsetEntry {
            element: element_symbol(found.element),
            offset: found.offset,
            separate: found.is_separate,
        });
        OffsetSummary {
            structures: fit.structures(),
            left_out: fit.left_out(),
            elements: elements.collect(),
            too_few: None,
        }
    }
}

impl EnergyErrors {
    /// Starts without errors.
    pub fn new(reference: ProtocolEnergyOffsets) -> Self {
        Self { reference, errors: SystematicSample::new(MAX_SAMPLES), sum: 0.0, largest: 0.0, left_out: 0 }
    }

    /// See [`ProtocolEnergyOffsets::error_per_atom`].
    pub fn error_per_atom(&self, structure: &Structure, model: f64, label: f64) -> Option<f64> {
        self.reference.error_per_atom(structure, model, label)
    }

    /// Adds a labelled structure with its [`Self::error_per_atom`].
    pub fn add(&mut self, error: Option<f64>) {
        match error {
            Some(error) => {
                self.errors.add(error.abs());
                self.sum += error.abs();
                self.largest = self.largest.max(error.abs());
            }
            None => self.left_out += 1,
        }
    }

    /// Summarizes the errors.
    pub fn summary(&self) -> EnergySummary {
        let mut sorted: Vec<f64> = self.errors.items().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let structures = self.errors.total();
        let any = |x: f64| (structures > 0).then_some(x);
        EnergySummary {
            structures,
            left_out: self.left_out,
            mean: any(self.sum / structures.max(1) as f64),
            median: quantile(&sorted, 0.5),
            p90: quantile(&sorted, 0.9),
            largest: any(self.largest),
            offsets: self.reference.summary(),
        }
    }
}
