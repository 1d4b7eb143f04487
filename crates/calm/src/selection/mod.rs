//! Selection of structures for labelling from a pool.
//!
//! A [`Pool`] has the atoms of the structures that a selection may look at, with their features. [`Greedy`] picks the structure
//! with the largest γ and updates a copy of the mixture with it; [`FarthestPoints`] picks structures whose atoms are far from
//! those picked already; [`random_structures`] draws without replacement; [`floors`] makes sure that each element has enough atoms.
//!
//! Both [`Greedy`] and [`FarthestPoints`] keep an upper bound for each atom and compute it again only when it is the largest
//! (`lazy_heap`): γ only falls when covariances grow, and distances to the nearest picked atom only fall when atoms are picked.

mod farthest_points;
pub mod floors;
mod greedy;
mod lazy_heap;
mod pool;
mod random;
mod rows;

pub use farthest_points::{FarthestPoint, FarthestPoints, Metric};
pub use greedy::{Greedy, GreedyPick, update_settings};
pub use pool::{Pool, PoolAtom, Window};
pub use random::random_structures;
pub use rows::FeatureRows;

use std::io;

use crate::grade::GradeError;
use crate::linear::LinearError;
use crate::mixture::MixtureError;
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
    /// A component that does not belong to the mixture.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
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
    /// The temporary file of the features.
    #[error("the temporary file of the features: {0}")]
    File(#[from] io::Error),
}
