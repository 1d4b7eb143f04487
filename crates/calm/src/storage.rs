//! Storage of a component's large arrays: private memory, or memory shared by its owner, such as a block shared
//! between processes.

use std::fmt;
use std::sync::Arc;

/// Provides the numbers of a component and keeps them unchanged while it lives. Must return the same slice on
/// every call.
pub type SharedNumbers = dyn AsRef<[f64]> + Send + Sync;

/// Centroid **μ**, `[D]`, and inverse covariance S, `[D × D]`, of a component.
#[derive(Clone)]
pub(crate) enum Storage {
    /// In private memory.
    Owned { centroid: Vec<f64>, inverse: Vec<f64> },
    /// S followed by **μ**, `[D² + D]`, in memory that is shared.
    Shared { shared: Arc<SharedNumbers>, dimension: usize },
}

impl Storage {
    pub(crate) fn dimension(&self) -> usize {
        match self {
            Self::Owned { centroid, .. } => centroid.len(),
            Self::Shared { dimension, .. } => *dimension,
        }
    }

    pub(crate) fn centroid(&self) -> &[f64] {
        match self {
            Self::Owned { centroid, .. } => centroid,
            Self::Shared { shared, dimension } => {
                (**shared).as_ref().get(dimension * dimension..).unwrap_or_default()
            }
        }
    }

    pub(crate) fn inverse(&self) -> &[f64] {
        match self {
            Self::Owned { inverse, .. } => inverse,
            Self::Shared { shared, dimension } => {
                (**shared).as_ref().get(..dimension * dimension).unwrap_or_default()
            }
        }
    }
}

/// Compares values, independent of the storage.
impl PartialEq for Storage {
    fn eq(&self, other: &Self) -> bool {
        self.centroid() == other.centroid() && self.inverse() == other.inverse()
    }
}

impl fmt::Debug for Storage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self {
            Self::Owned { .. } => "Owned",
            Self::Shared { .. } => "Shared",
        };
        f.debug_struct(kind).field("centroid", &self.centroid()).field("inverse", &self.inverse()).finish()
    }
}
