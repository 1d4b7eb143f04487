//! Other extrapolation scores on the same features, to compare γ with: D-optimality, last-layer prediction rigidity,
//! distances and likelihood.
//!
//! A [`Builder`] receives the training data, structure by structure, once or several times ([`Builder::end_sweep`]
//! tells); its memory does not depend on the amount of data. The [`Baseline`] that it returns scores atoms: one number
//! for each, larger further outside. [`BaselineFile`] stores baselines with the features that they belong to.
//!
//! | kind | score of an atom with features **z** |
//! | --- | --- |
//! | [`BaselineKind::DOptimalityElement`] | max_j \|(**z** A⁺)_j\|, rows of A selected from the element's atoms |
//! | [`BaselineKind::DOptimalityCentred`] | the same for each component, of **z** − **μ** |
//! | [`BaselineKind::DOptimalityComponent`] | the same for each component, of **z** |
//! | [`BaselineKind::Llpr`], [`BaselineKind::LlprSum`], [`BaselineKind::LlprForces`] | √(**z**ᵀ(G + λI)⁻¹**z**) |
//! | [`BaselineKind::Euclidean`] | distance to the nearest centroid |
//! | [`BaselineKind::KNearest`] | distance to the k-th nearest of a sample of training atoms |
//! | [`BaselineKind::Likelihood`] | −log of the mixture's density |
//!
//! The plain Mahalanobis distance σ is [`crate::Grades::sigma`]. One Gaussian for each element (K = 1) is a mixture
//! that is built with a single candidate, 1.

mod builder;
mod d_optimality;
mod distances;
mod error;
mod file;
mod groups;
mod kind;
mod likelihood;
mod llpr;
mod max_vol;
mod origin;
mod settings;
mod stored;

pub use builder::Builder;
pub use d_optimality::DOptimality;
pub use distances::{Euclidean, KNearest};
pub use error::{BaselineError, OriginMismatch};
pub use file::BaselineFile;
pub use kind::BaselineKind;
pub use likelihood::Likelihood;
pub use llpr::Llpr;
pub use origin::FeatureOrigin;
pub use settings::BaselineSettings;

/// A score that is ready for use.
#[derive(Debug, Clone, PartialEq)]
pub enum Baseline {
    /// Active sets.
    DOptimality(DOptimality),
    /// A Gram matrix.
    Llpr(Llpr),
    /// Centroids.
    Euclidean(Euclidean),
    /// A sample of training atoms.
    KNearest(KNearest),
    /// A mixture with its weights.
    Likelihood(Likelihood),
}

impl Baseline {
    /// What it is.
    pub fn kind(&self) -> BaselineKind {
        match self {
            Self::DOptimality(found) => found.kind(),
            Self::Llpr(found) => found.kind(),
            Self::Euclidean(_) => BaselineKind::Euclidean,
            Self::KNearest(_) => BaselineKind::KNearest,
            Self::Likelihood(_) => BaselineKind::Likelihood,
        }
    }

    /// Feature dimension D.
    pub fn dimension(&self) -> usize {
        match self {
            Self::DOptimality(found) => found.dimension(),
            Self::Llpr(found) => found.dimension(),
            Self::Euclidean(found) => found.dimension(),
            Self::KNearest(found) => found.dimension(),
            Self::Likelihood(found) => found.dimension(),
        }
    }

    /// One score for each atom, larger further outside; ∞ where the training data have no atom of its element, but not
    /// with [`Llpr`], which has one matrix for all elements. `elements` has the element index of each atom, `features` is `[atoms × D]`.
    ///
    /// # Errors
    /// Wrong lengths, an unknown element, features that are not finite.
    pub fn score(&self, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, BaselineError> {
        error::check(self.dimension(), elements, features)?;
        match self {
            Self::DOptimality(found) => found.score(elements, features),
            Self::Llpr(found) => Ok(found.score_rows(features)),
            Self::Euclidean(found) => found.score(elements, features),
            Self::KNearest(found) => found.score(elements, features),
            Self::Likelihood(found) => found.score(elements, features),
        }
    }

    /// The uncertainty of the force of each atom, √(u_x² + u_y² + u_z²), where the baseline has one
    /// ([`BaselineKind::has_force_form`]); otherwise `None`. `rows` has the gradient of the sum of the structure's features
    /// with respect to the coordinates of its atoms, `[3 atoms × D]`.
    ///
    /// # Errors
    /// A wrong length, rows that are not finite.
    pub fn score_forces(&self, rows: &[f64]) -> Result<Option<Vec<f64>>, BaselineError> {
        match self {
            Self::Llpr(found) if self.kind().has_force_form() => found.score_forces(rows).map(Some),
            _ => Ok(None),
        }
    }
}
