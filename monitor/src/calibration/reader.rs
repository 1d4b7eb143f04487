//! Calibrations that are kept up to date with the labels of a campaign.

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use store::{ArrivalSum, LabelArrival, Store, StoreError};
use wire::ContentHash;

use super::learning::{ArrivalPages, labelled_structure};
use super::{CalibrationState, CalibrationSummary};

/// Keeps the calibrations of all versions of the potential, so that each reading costs what is new.
///
/// A calibration depends on the order of its labels. Each reading therefore first compares a sum over the labels that it knows
/// ([`ArrivalSum`]) with that of the database, and reads all again if they differ.
#[derive(Debug, Default)]
pub struct CalibrationReader {
    protocol: Option<ContentHash>,
    /// Label and decision of the last row that was read.
    after: Option<(i64, i64)>,
    /// Over all rows that were read.
    sum: ArrivalSum,
    versions: BTreeMap<u32, LearnedVersion>,
}

#[derive(Debug)]
struct LearnedVersion {
    state: CalibrationState,
    /// The last label that it learned from.
    last: i64,
}

impl CalibrationReader {
    /// Reads the labels that came since the last reading, under `protocol`. Returns the number of labelled candidates that it read.
    pub async fn read(&mut self, store: &Store, protocol: ContentHash) -> Result<u64, StoreError> {
        let known = store.label_arrivals_until(protocol, self.after).await?;
        if self.protocol != Some(protocol) || self.sum != known {
            *self = Self { protocol: Some(protocol), ..Self::default() };
        }
        let (mut pages, mut read) = (ArrivalPages::new(store, protocol, self.after), 0);
        loop {
            let page = pages.next().await?;
            if page.is_empty() {
                return Ok(read);
            }
            page.iter().for_each(|(version, arrival)| self.learn(*version, arrival));
            self.after = pages.after();
            read += page.len() as u64;
        }
    }

    /// The calibration of a version; `None` before its first label.
    pub fn of_version(&self, version: u32) -> Option<&CalibrationState> {
        self.versions.get(&version).map(|learned| &learned.state)
    }

    /// What the bounds of a version are, also before its first label.
    pub fn summary(&self, version: u32) -> CalibrationSummary {
        self.of_version(version)
            .map_or_else(|| CalibrationState::new(version).summary(), CalibrationState::summary)
    }

    /// Learns from a structure, once for each version whose walks found it.
    fn learn(&mut self, version: u32, arrival: &LabelArrival) {
        self.sum.add(arrival);
        let empty = || LearnedVersion { state: CalibrationState::new(version), last: 0 };
        let learned = self.versions.entry(version).or_insert_with(empty);
        if learned.last != arrival.number {
            learned.last = arrival.number;
            learned.state.learn(&labelled_structure(&arrival.candidate));
        }
    }
}
