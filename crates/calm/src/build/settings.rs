//! What a build is made with.

use serde::{Deserialize, Serialize};

use super::error::BuildError;

/// Settings of a build. The same settings and the same stream give the same mixture; the artifact records them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BuildSettings {
    /// Feature dimension D.
    pub dimension: usize,
    /// Random seed.
    pub seed: u64,
    /// Numbers of clusters to choose from, ascending; the paper's are 1, 2, 4, 8 and 16.
    pub candidates: Vec<usize>,
    /// Structures of a shard, into which the caller divides the training data. Recorded only.
    pub shard_size: u64,
}

impl BuildSettings {
    /// Fewest atoms of a component: D + 1 (paper, Methods).
    pub fn min_atoms(&self) -> usize {
        self.dimension + 1
    }

    /// # Errors
    /// No feature; candidates that are not ascending from 1.
    pub(super) fn check(&self) -> Result<(), BuildError> {
        check_dimension(self.dimension)?;
        let ascending = self.candidates.windows(2).all(|pair| pair[0] < pair[1]);
        match self.candidates.first() {
            Some(1..) if ascending => Ok(()),
            _ => Err(BuildError::Candidates { found: self.candidates.clone() }),
        }
    }
}

pub(super) fn check_dimension(dimension: usize) -> Result<(), BuildError> {
    if dimension == 0 { Err(BuildError::NoFeature) } else { Ok(()) }
}
