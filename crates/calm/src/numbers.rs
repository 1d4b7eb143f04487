//! Where the large arrays of a component are: in memory of their own, or lent by somebody, such as a block of
//! memory shared between processes.

use std::fmt;
use std::sync::Arc;

/// Who lends the numbers of a component and keeps them as they are while it lives. It must give the same slice
/// every time.
pub type Lender = dyn AsRef<[f64]> + Send + Sync;

/// Centroid **μ**, `[D]`, and inverse covariance S, `[D × D]`, of a component.
#[derive(Clone)]
pub(crate) enum Numbers {
    /// In private memory.
    Owned { centroid: Vec<f64>, inverse: Vec<f64> },
    /// S and behind it **μ**, `[D² + D]`, in memory of somebody else.
    Lent { lender: Arc<Lender>, dimension: usize },
}

impl Numbers {
    pub(crate) fn dimension(&self) -> usize {
        match self {
            Self::Owned { centroid, .. } => centroid.len(),
            Self::Lent { dimension, .. } => *dimension,
        }
    }

    pub(crate) fn centroid(&self) -> &[f64] {
        match self {
            Self::Owned { centroid, .. } => centroid,
            Self::Lent { lender, dimension } => {
                (**lender).as_ref().get(dimension * dimension..).unwrap_or_default()
            }
        }
    }

    pub(crate) fn inverse(&self) -> &[f64] {
        match self {
            Self::Owned { inverse, .. } => inverse,
            Self::Lent { lender, dimension } => {
                (**lender).as_ref().get(..dimension * dimension).unwrap_or_default()
            }
        }
    }
}

/// Equal by value, wherever the numbers are.
impl PartialEq for Numbers {
    fn eq(&self, other: &Self) -> bool {
        self.centroid() == other.centroid() && self.inverse() == other.inverse()
    }
}

impl fmt::Debug for Numbers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self {
            Self::Owned { .. } => "Owned",
            Self::Lent { .. } => "Lent",
        };
        f.debug_struct(kind).field("centroid", &self.centroid()).field("inverse", &self.inverse()).finish()
    }
}
