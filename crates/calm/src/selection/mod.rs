//! Selection of structures for labelling from a pool.
//!
//! A [`Pool`] has the atoms of the structures that a selection may look at, with their features. [`Greedy`] picks the structure
//! with the largest γ and updates a copy of the mixture with it; [`FarthestPoints`] picks structures whose atoms are far from
//! those picked already; [`DOptimal`] picks those that add most to the determinant of the information matrices;
//! [`random_structures`] draws without replacement; [`floors`] makes sure that each element has enough atoms.
//!
//! [`Greedy`], [`FarthestPoints`] and [`DOptimal`] keep upper bounds and compute only the largest again (`lazy_heap`): γ only falls
//! when covariances grow, distances to the nearest picked atom only fall when atoms are picked, and so do gains in information.

mod d_optimal;
mod farthest_points;
pub mod floors;
mod greedy;
mod inverse_factor;
mod lazy_heap;
mod learned_mixture;
mod pool;
mod random;
mod rows;

pub use d_optimal::{DOptimal, DOptimalPick};
pub use farthest_points::{FarthestPoint, FarthestPoints, Metric};
pub use greedy::{Greedy, GreedyPick};
pub use pool::{Pool, PoolAtom, Window};
pub use random::random_structures;
pub use rows::FeatureRows;

use std::io;

use crate::grade::GradeError;
use crate::linear::LinearError;
use crate::update::UpdateError;

/// Why a selection failed.
#[derive(Debug, thiserror::Error)]
pub enum SelectionError {
    /// The copy of the mixture cannot be updated.
    #[error(transparent)]
    Update(#[from] UpdateError),
    /// Features that cannot be graded.
    #[error(transparent)]
    Grade(#[from] GradeError),
    /// A covariance that cannot be inverted.
    #[error("covariance of component {slot} of element {element}: {source}")]
    Linear {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What failed.
        source: LinearError,
    },
    /// An information matrix without a factor.
    #[error("information matrix of element {element}: {source}")]
    Information {
        /// Element index.
        element: usize,
        /// What failed.
        source: LinearError,
    },
    /// The temporary file of the features.
    #[error("the temporary file of the features: {0}")]
    File(#[from] io::Error),
}
