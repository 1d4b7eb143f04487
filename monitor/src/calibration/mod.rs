//! From the grade of an atom to a bound of its force error, learned from the labels of one version of the potential, and how
//! often such bounds held.

mod expected;
mod learning;
mod reader;
mod summary;
#[cfg(test)]
mod tests;

use analysis::{Bins, ConformalMap, ConformalSettings};
use store::{Store, StoreError};
use wire::ContentHash;

use self::learning::ArrivedLabels;

pub use expected::{AtomErrorBound, ExpectedErrors, expected_errors};
pub use reader::CalibrationReader;
pub use summary::{CalibrationBin, CalibrationCoverage, CalibrationMap, CalibrationSummary};

/// What the bounds promise, and from how many structures they follow. Each bin has the bound of its newest 50 structures: with
/// more, bounds of a changing collection lag behind. Synthetic campaigns have bounds that hold for 88 to 92 % with this step size,
/// whether errors fall or rise (the tests of `analysis::conformal`).
pub const CALIBRATION: ConformalSettings =
    ConformalSettings { level: 0.9, least: 20, window: 50, step: 0.05, counted: 200 };

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
    let mut labelled = ArrivedLabels::new(store, protocol, version);
    let mut state = CalibrationState::new(version);
    while let Some(structure) = labelled.next().await? {
        state.learn(&structure);
    }
    Ok(state)
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
        self.map_at(gamma_nbr).bound(gamma_nbr, Some(&element))
    }

    /// Expected |ΔF|, eV/Å, of an atom with this γ_nbr under the original mixture of the version. Without enough labels in its bin,
    /// that of the nearest bin below that has them, which large grades exceed; without any below, of the nearest above. `None`
    /// without such a bin, and for a grade that is not finite.
    pub fn expected_error(&self, gamma_nbr: f64) -> Option<f64> {
        let bins = self.found.bins();
        let own = gamma_nbr.is_finite().then(|| bins.index_of(gamma_nbr))?;
        let nearest_first = (0..=own).rev().chain(own + 1..bins.count());
        nearest_first.filter_map(|bin| self.map_of(bin).window(bin)?.mean()).next()
    }

    /// Labels as found: the covered share of the atoms of each structure with a bound, in the order in which labels came.
    pub fn outcomes(&self) -> Vec<f64> {
        self.found.outcomes()
    }

    /// The same of labels by value.
    pub fn outcomes_by_value(&self) -> Vec<f64> {
        self.by_value.outcomes()
    }

    /// The map that counts at a grade.
    fn map_at(&self, gamma_nbr: f64) -> &ConformalMap<&'static str> {
        self.map_of(self.found.bins().index_of(gamma_nbr))
    }

    fn is_by_value_at(&self, gamma_nbr: f64) -> bool {
        self.is_by_value(self.found.bins().index_of(gamma_nbr))
    }

    fn map_of(&self, bin: usize) -> &ConformalMap<&'static str> {
        if self.is_by_value(bin) { &self.by_value } else { &self.found }
    }

    /// Whether labels by value count in a bin: with too few of the others for a bound, or when most of these are older than as many
    /// labels by value as a bin keeps. The others are a fairer sample of what the campaign finds, but not of what it finds now.
    fn is_by_value(&self, bin: usize) -> bool {
        match (self.found.window(bin), self.by_value.window(bin)) {
            (Some(found), Some(by_value)) => found.is_outdated_by(by_value),
            (found, by_value) => found.is_none() && by_value.is_some(),
        }
    }
}
