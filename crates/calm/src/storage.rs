//! Where the large arrays of a component are: in memory of their own, or lent by somebody, such as a block of
//! memory shared between processes.

use std::fmt;
use std::sync::Arc;

/// Who lends the numbers of a component and keeps them as they are while it lives. It must give the same slice
/// every time.
pub type SharedNumbers = dyn AsRef<[f64]> + Send + Sync;

/// Centroid **μ**, `[D]`, and inverse covariance S, `[D × D]`, of a component.
#[derive(Clone)]
pub(crate) enum Storage {
    /// In private memory.
    Owned { centroid: Vec<f64>, inverse: Vec<f64> },
    /// S and behind it **μ**, `[D² + D]`, in memory of somebody else.
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

/// Equal by value, wherever the numbers are.
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
