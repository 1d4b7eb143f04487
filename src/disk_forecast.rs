//! How much disk a campaign will take, from what bounds it.

use serde::{Deserialize, Serialize};

use crate::campaign::Campaign;

/// Under which name the leader keeps it in the store.
pub const METADATA_KEY: &str = "forecast";

/// Decision, candidate, job, attempt and label without what counts with the atoms, and their indexes, bytes.
const ROW_BYTES: u64 = 4_000;
/// Rows that are longer than a page end in one that is half empty, bytes.
const HALF_PAGE_BYTES: u64 = 8_192;
/// An empty campaign: every table and index has a page, bytes.
const EMPTY_DATABASE_BYTES: u64 = 500_000;
/// A walk's checkpoints, bytes an atom.
const CHECKPOINT_BYTES_PER_ATOM: u64 = 450;
/// What waits in SQLite's log until it is copied into the database, at most, bytes.
pub const WAL_BYTES: u64 = 70_000_000;

/// What a campaign takes when it has collected all that it may, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiskForecast {
    /// Accepted structures and control frames with their labels.
    pub structures: u64,
    /// Walks, the mixture, and what is there in any case.
    pub rest: u64,
    /// Features of declined candidates, at most.
    pub declined: u64,
    /// How many structures and control frames there may be; 0 in campaigns of early versions.
    #[serde(default)]
    pub most_structures: u64,
}

impl DiskForecast {
    /// That of a configuration.
    pub fn from_campaign(campaign: &Campaign) -> Self {
        let config = &campaign.config;
        let features = campaign.artifact.mixture.dimension() as u64;
        let seeds = || campaign.seeds.iter().map(|named| named.seed.structure.len() as u64);
        let number = seeds().len() as u64;
        let per_seed = u64::from(config.collect.per_seed.get());
        let collected = per_seed.saturating_mul(number);
        let collected = config.collect.total.map_or(collected, |total| collected.min(total.get().into()));
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

    /// What is still to come when there are so many structures and control frames, and they and all else take `bytes` now.
    pub fn remaining_bytes(&self, structures: u64, bytes: u64) -> u64 {
        let left = self.most_structures.saturating_sub(structures);
        match self.most_structures {
            0 => self.bytes().saturating_sub(bytes),
            most => (u128::from(self.structures) * u128::from(left) / u128::from(most)) as u64,
        }
    }

    /// Without features of declined candidates, of which nobody knows how many there will be.
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

/// Bytes for people.
pub fn megabytes(bytes: u64) -> String {
    match bytes {
        0..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.1} GB", bytes as f64 / 1e9),
    }
}

impl std::fmt::Display for DiskForecast {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (all, declined) = (megabytes(self.bytes()), megabytes(self.declined));
        write!(f, "{all} when all is collected, and up to {declined} of features of declined candidates")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_to_come_is_what_is_not_yet_collected() {
        let forecast =
            DiskForecast { structures: 1_000_000, rest: 500_000, declined: 7, most_structures: 100 };
        for (structures, expected) in [(0, 1_000_000), (25, 750_000), (100, 0), (120, 0)] {
            assert_eq!(forecast.remaining_bytes(structures, 40_000_000), expected, "{structures}");
        }
        let early = DiskForecast { most_structures: 0, ..forecast };
        assert_eq!((early.remaining_bytes(3, 400_000), early.remaining_bytes(3, 9_000_000)), (1_100_000, 0));
    }
}
