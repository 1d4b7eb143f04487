//! From the grade of an atom to a bound of its force error, learned from the labels of one version of the potential, and how
//! often such bounds held.

mod expected;
mod learning;
mod reader;
mod summary;
#[cfg(test)]
mod tests;

use analysis::{Bins, ConformalMap, ConformalSettings, RollingCoverage};
use store::{Store, StoreError};
use wire::ContentHash;

use self::learning::ArrivedLabels;

pub use expected::{AtomErrorBound, ExpectedErrors, expected_errors};
pub use reader::CalibrationReader;
pub use summary::{CalibrationBin, CalibrationCoverage, CalibrationMap, CalibrationSummary};

/// What the bounds promise, and from how many structures they follow. Each bin has the bound of its newest 100 structures: with
/// more, bounds of a changing collection lag behind. Synthetic campaigns whose grades and errors drift have bounds that hold for
/// 90 % with this step size (the tests of `analysis::conformal`).
pub const CALIBRATION: ConformalSettings =
    ConformalSettings { level: 0.9, least: 20, window: 100, step: 0.03, counted: 200 };

/// The calibration of one version of the potential under one protocol.
#[derive(Clone, Debug)]
pub struct CalibrationState {
    /// Number of the version.
    pub version: u32,
    /// From labels of structures in the order in which they were found.
    found: ConformalMap<&'static str>,
    /// From labels of structures that the queue chose by value. Such a choice prefers large errors, so they are fitted apart.
    by_value: ConformalMap<&'static str>,
}

/// Reads the labels of the structures that walks with this version found, in the order in which they came.
pub async fn read(
    store: &Store,
    protocol: ContentHash,
    version: u32,
) -> Result<CalibrationState, StoreError> {
    let mut labelled = ArrivedLabels::new(store, protocol, version).await?;
    let mut state = CalibrationState::new(version);
    while let Some(structure) = labelled.next().await? {
        state.learn(&structure);
    }
    Ok(state)
}

/// Whether labels by value stand in for the others: with too few others for any bound, and more by value. The first labels of a campaign
/// come before any value is known.
fn is_by_value_in_use(found: u64, by_value: u64) -> bool {
    found < CALIBRATION.least() as u64 && found < by_value
}

impl CalibrationState {
    fn new(version: u32) -> Self {
        let empty = ConformalMap::new(Bins::for_grades(), CALIBRATION);
        Self { version, found: empty.clone(), by_value: empty }
    }

    /// Number of structures with a label.
    pub fn structures(&self) -> u64 {
        self.found.structures() + self.by_value.structures()
    }

    /// The bound of |ΔF|, eV/Å, of an atom of this element with this γ_nbr under the original mixture of the version: 90 % of such
    /// errors are expected to be below. `None` without enough labels in its bin.
    pub fn bound(&self, gamma_nbr: f64, element: &'static str) -> Option<f64> {
        self.in_use().bound(gamma_nbr, Some(&element))
    }

    /// Expected |ΔF|, eV/Å, of an atom with this γ_nbr under the original mixture of the version. `None` without enough labels in
    /// its bin.
    pub fn expected_error(&self, gamma_nbr: f64) -> Option<f64> {
        self.found.expected(gamma_nbr).or_else(|| self.by_value.expected(gamma_nbr))
    }

    /// How often bounds held for the newest structures.
    pub fn coverage(&self) -> Option<RollingCoverage> {
        self.in_use().coverage()
    }

    /// The covered share of the atoms of each structure with a bound, in the order in which labels came.
    pub fn outcomes(&self) -> &[f64] {
        self.in_use().outcomes()
    }

    /// The map for structures as the campaign finds them; with too few labels of these, the map of labels by value.
    fn in_use(&self) -> &ConformalMap<&'static str> {
        match is_by_value_in_use(self.found.structures(), self.by_value.structures()) {
            true => &self.by_value,
            false => &self.found,
        }
    }
}
