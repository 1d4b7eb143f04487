//! Estimates the disk space of a campaign from its limits.

use serde::{Deserialize, Serialize};

use crate::campaign::Campaign;

/// Metadata key of the forecast in the store.
pub const METADATA_KEY: &str = "forecast";

/// Decision, candidate, job, attempt and label with their indexes, without what scales with the number of atoms,
/// bytes.
const ROW_BYTES: u64 = 4_000;
/// Half a page, which a row longer than a page wastes on average, bytes.
const HALF_PAGE_BYTES: u64 = 8_192;
/// An empty database: every table and index takes a page, bytes.
const EMPTY_DATABASE_BYTES: u64 = 500_000;
/// A walk's checkpoints, bytes per atom.
const CHECKPOINT_BYTES_PER_ATOM: u64 = 450;
/// Largest size of SQLite's write-ahead log, bytes.
pub const WAL_BYTES: u64 = 70_000_000;

/// Disk space of a campaign that has collected all that it may, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiskForecast {
    /// Accepted structures and control frames with their labels.
    pub structures: u64,
    /// Walks, the mixture and the fixed overhead.
    pub rest: u64,
    /// Upper limit of the features of declined candidates.
    pub declined: u64,
    /// Largest number of structures and control frames. 0 in campaigns of early versions.
    #[serde(default)]
    pub most_structures: u64,
}

impl DiskForecast {
    /// Estimates it from a configuration.
    pub fn from_campaign(campaign: &Campaign) -> Self {
        let config = &campaign.config;
        let features = campaign.artifact.mixture.dimension() as u64;
        let seeds = || campaign.seed_structures.iter().map(|named| named.seed.structure.len() as u64);
        let number = seeds().len() as u64;
        let max_per_seed_structure = u64::from(config.collect.max_per_seed_structure.get());
        let collected = max_per_seed_structure.saturating_mul(number);
        let collected =
            config.collect.max_structures.map_or(collected, |total| collected.min(total.get().into()));
        let copies = if config.campaign.control { 2 } else { 1 };
        let mean = seeds().map(|atoms| structure_bytes(atoms, features)).sum::<u64>() / number.max(1);
        let checkpoints =
            seeds().map(|atoms| CHECKPOINT_BYTES_PER_ATOM * atoms + HALF_PAGE_BYTES).sum::<u64>();
        let mixture: usize =
            campaign.artifact.mixture.iter().map(|(.., component)| component.to_bytes().len()).sum();
        Self {
            structures: copies * collected * mean,
            rest: EMPTY_DATABASE_BYTES + copies * checkpoints + mixture as u64,
            declined: config.collect.declined_features_mb * 1_000_000,
            most_structures: copies * collected,
        }
    }

    /// What will be added to `structures` structures and control frames, which take `bytes` together with everything
    /// else.
    pub fn remaining_bytes(&self, structures: u64, bytes: u64) -> u64 {
        let left = self.most_structures.saturating_sub(structures);
        match self.most_structures {
            0 => self.bytes().saturating_sub(bytes),
            most => (u128::from(self.structures) * u128::from(left) / u128::from(most)) as u64,
        }
    }

    /// Total without the features of declined candidates, whose number is unknown.
    pub fn bytes(&self) -> u64 {
        self.structures + self.rest
    }
}

/// A structure with its candidate, features, grades and label.
fn structure_bytes(atoms: u64, features: u64) -> u64 {
    let block = 288 + 72 * atoms;
    let (features, grades) = (8 * atoms * features, 2 * 16 * atoms);
    let (positions, forces) = (25 * atoms, 24 * atoms);
    block + features + grades + positions + forces + ROW_BYTES + HALF_PAGE_BYTES
}

/// Formats a number of bytes.
pub fn megabytes(bytes: u64) -> String {
    match bytes {
        0..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.1} GB", bytes as f64 / 1e9),
    }
}

impl std::fmt::Display for DiskForecast {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (all, declined) = (megabytes(self.bytes()), megabytes(self.declined));
        write!(
            f,
            "{all} at the end of the campaign, and up to {declined} for features of declined candidates"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remaining_space_is_that_of_structures_not_yet_collected() {
        let forecast =
            DiskForecast { structures: 1_000_000, rest: 500_000, declined: 7, most_structures: 100 };
        for (structures, expected) in [(0, 1_000_000), (25, 750_000), (100, 0), (120, 0)] {
            assert_eq!(forecast.remaining_bytes(structures, 40_000_000), expected, "{structures}");
        }
        let early = DiskForecast { most_structures: 0, ..forecast };
        assert_eq!((early.remaining_bytes(3, 400_000), early.remaining_bytes(3, 9_000_000)), (1_100_000, 0));
    }
}
