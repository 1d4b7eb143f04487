//! Disk space of a campaign: its current use, and the forecast for its end.

use serde::{Deserialize, Serialize};
use store::{CampaignStatus, Candidates};

/// Metadata key of the forecast in the store.
pub const METADATA_KEY: &str = "forecast";

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
    pub max_structures: u64,
}

/// Disk use of the store.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct DiskUse {
    /// Current size.
    pub bytes: u64,
    /// Last forecast of the orchestrator for the end of the campaign.
    pub forecast: Option<DiskForecast>,
}

impl DiskUse {
    /// Expected size at the end, bytes. `None` if it is unknown or the campaign is finished.
    pub fn at_the_end(&self, status: &CampaignStatus) -> Option<u64> {
        let Candidates { accepted, control, .. } = status.candidates;
        let forecast = self.forecast.filter(|_| !status.finished)?;
        Some(self.bytes + forecast.remaining_bytes(accepted + control, self.bytes))
    }
}

impl DiskForecast {
    /// What will be added to `structures` structures and control frames, which take `bytes` together with everything
    /// else.
    pub fn remaining_bytes(&self, structures: u64, bytes: u64) -> u64 {
        let left = self.max_structures.saturating_sub(structures);
        match self.max_structures {
            0 => self.bytes().saturating_sub(bytes),
            most => (u128::from(self.structures) * u128::from(left) / u128::from(most)) as u64,
        }
    }

    /// Total without the features of declined candidates, whose number is unknown.
    pub fn bytes(&self) -> u64 {
        self.structures + self.rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remaining_space_is_that_of_structures_not_yet_collected() {
        let forecast =
            DiskForecast { structures: 1_000_000, rest: 500_000, declined: 7, max_structures: 100 };
        for (structures, expected) in [(0, 1_000_000), (25, 750_000), (100, 0), (120, 0)] {
            assert_eq!(forecast.remaining_bytes(structures, 40_000_000), expected, "{structures}");
        }
        let early = DiskForecast { max_structures: 0, ..forecast };
        assert_eq!((early.remaining_bytes(3, 400_000), early.remaining_bytes(3, 9_000_000)), (1_100_000, 0));
    }
}
