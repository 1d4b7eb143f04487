//! Selection of structures for labelling from files and campaigns: reads and grades a pool, and applies strategies to it.

mod campaign;
mod compositions;
mod grading;
mod output;
mod picks;
mod stored_features;
mod strategy;

use std::path::Path;
use std::sync::Arc;

use calm::selection::Pool;

pub use self::campaign::{CampaignCandidates, CandidateChoice};
use self::compositions::Compositions;
pub use self::grading::{PoolFiles, PoolGrading};
pub use self::output::frames;
pub use self::picks::{Pick, Picks, Rules, pick};
pub use self::stored_features::FeatureIdentity;
pub use self::strategy::{Strategy, StrategyQuota};
use crate::left_out::LeftOutStructures;

/// Structures of a pool with the grades of their atoms.
pub struct GradedPool {
    pub pool: Pool,
    pub structures: Vec<PoolStructure>,
    /// Number of elements of the model.
    pub elements: usize,
    /// Many structures share one.
    compositions: Compositions,
    /// Structures whose features were computed; those of the others were in the store of their campaign.
    pub evaluated: u64,
    /// Structures that cannot be graded, and are none of the above.
    pub left_out: LeftOutStructures,
}

/// What is kept of every structure, 40 bytes.
pub struct PoolStructure {
    pub source: StructureSource,
    /// Begin of its hash: files must not change before the picked structures are read again.
    pub hash: u64,
    /// Its number among the compositions.
    pub composition: u32,
    /// Largest γ of all its atoms.
    pub gamma_max: f64,
}

/// Where a structure comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StructureSource {
    /// Structure `frame` of a file, both counted from 0.
    File { file: u32, frame: u32 },
    /// The candidate of a decision of a campaign.
    Candidate { campaign: u32, decision: i64 },
}

impl GradedPool {
    /// Number of atoms of an element in a structure.
    pub fn atoms(&self, structure: usize, element: usize) -> u64 {
        self.compositions.atoms(self.structures[structure].composition, element)
    }

    /// Number of atoms of a structure.
    pub fn total_atoms(&self, structure: usize) -> u64 {
        let counts = self.compositions.counts(self.structures[structure].composition);
        counts.iter().map(|(_, atoms)| u64::from(*atoms)).sum()
    }
}

/// A structure to be graded.
struct PoolItem {
    structure: atoms::Structure,
    source: StructureSource,
    /// Features that are known, `[n × D]`.
    features: Option<Vec<f64>>,
    place: ItemPlace,
}

/// For messages.
enum ItemPlace {
    Line(Arc<Path>, usize),
    Candidate(String),
}

impl std::fmt::Display for ItemPlace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Line(file, line) => write!(f, "{}:{line}", file.display()),
            Self::Candidate(id) => write!(f, "candidate {id}"),
        }
    }
}
