//! One Gaussian of the mixture: immutable and reference counted.

use std::sync::Arc;

use crate::linear::{self, LinearError, regularised_inverse, symmetrised, view};
use crate::storage::{SharedNumbers, Storage};

/// The slices of a component that grading needs, from a [`Component`] or from a block of shared memory.
#[derive(Debug, Clone, Copy)]
pub struct ComponentView<'a> {
    /// Centroid **μ**, `[D]`.
    pub centroid: &'a [f64],
    /// Inverse covariance S, `[D × D]`, exactly symmetric.
    pub inverse: &'a [f64],
    /// Calibrated threshold θ of σ.
    pub threshold: f64,
}

/// What an update needs to know about the data behind a component.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Scatter Σ w δδᵀ about the fixed centroid, `[D × D]`, exactly symmetric.
    pub scatter: Vec<f64>,
    /// Number of environments.
    pub count: f64,
    /// Sum of their weights.
    pub effective_count: f64,
}

impl Statistics {
    /// The covariance C = scatter / effective count; zero for an empty component.
    pub fn covariance(&self) -> Vec<f64> {
        if self.effective_count > 0.0 {
            self.scatter.iter().map(|value| value / self.effective_count).collect()
        } else {
            vec![0.0; self.scatter.len()]
        }
    }
}

/// One Gaussian of the mixture, for one species. Immutable: an update makes a new one.
#[derive(Debug, Clone, PartialEq)]
pub struct Component {
    numbers: Storage,
    threshold: f64,
    statistics: Option<Statistics>,
}

/// Numbers that are not a valid component.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ComponentError {
    /// A feature dimension of zero.
    #[error("a component needs at least one feature dimension")]
    Empty,
    /// A matrix or vector of the wrong length.
    #[error("{what}: found {found} numbers, expected {expected}")]
    Length {
        /// Which array.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that fits the centroid.
        expected: usize,
    },
    /// An infinite or undefined number, or a negative count or threshold.
    #[error("{what}: found {found}, expected a finite number{}", if *.not_negative { " that is not negative" } else { "" })]
    Number {
        /// Which quantity.
        what: &'static str,
        /// The number.
        found: f64,
        /// Whether it also must not be negative.
        not_negative: bool,
    },
}

impl Component {
    /// Checks the numbers of a component and takes ownership. Makes inverse and scatter exactly symmetric, (M +
    /// Mᵀ)/2.
    ///
    /// For a symmetric S, S**δ** equals (S + Sᵀ)**δ**/2, and **δ**ᵀS**δ** does not change, so the grade keeps
    /// its exact value.
    ///
    /// # Errors
    /// Wrong lengths, numbers that are not finite, negative counts or threshold.
    pub fn new(
        centroid: Vec<f64>,
        inverse: Vec<f64>,
        threshold: f64,
        statistics: Option<Statistics>,
    ) -> Result<Self, ComponentError> {
        let dimension = centroid.len();
        if dimension == 0 {
            return Err(ComponentError::Empty);
        }
        finite("centroid", &centroid)?;
        not_negative("threshold", threshold)?;
        let inverse = symmetric("inverse covariance", &inverse, dimension)?;
        let statistics = statistics.map(|found| checked_statistics(found, dimension)).transpose()?;
        Ok(Self { numbers: Storage::Owned { centroid, inverse }, threshold, statistics })
    }

    /// A component of dimension D that is evaluated in place: `shared` holds S, `[D × D]`, followed by **μ**,
    /// `[D]`. It has no statistics.
    ///
    /// The numbers are not checked, because reading all of them would cost as much as a copy. The provider
    /// guarantees that they come from a component made by [`Component::new`]. Other numbers give meaningless
    /// grades or [`crate::GradeError::Distance`].
    ///
    /// # Errors
    /// A dimension of zero, a length that is not D² + D, a threshold that is negative or not finite.
    pub fn from_shared(
        shared: Arc<SharedNumbers>,
        dimension: usize,
        threshold: f64,
    ) -> Result<Self, ComponentError> {
        if dimension == 0 {
            return Err(ComponentError::Empty);
        }
        not_negative("threshold", threshold)?;
        let (found, expected) =
            ((*shared).as_ref().len(), dimension.saturating_mul(dimension.saturating_add(1)));
        if found != expected {
            return Err(ComponentError::Length { what: "lent component", found, expected });
        }
        Ok(Self { numbers: Storage::Shared { shared, dimension }, threshold, statistics: None })
    }

    /// The placeholder for an element that the artifact does not hold: **μ** = 0, S = 10⁶ I, θ = 1, no data.
    ///
    /// Its grade is huge, so structures with the element are collected and updates can learn it.
    pub fn unknown_element(dimension: usize) -> Self {
        let mut inverse = vec![0.0; dimension * dimension];
        inverse.iter_mut().step_by(dimension + 1).for_each(|value| *value = 1.0 / linear::REGULARISATION);
        let scatter = vec![0.0; dimension * dimension];
        Self {
            numbers: Storage::Owned { centroid: vec![0.0; dimension], inverse },
            threshold: 1.0,
            statistics: Some(Statistics { scatter, count: 0.0, effective_count: 0.0 }),
        }
    }

    /// The same centroid and threshold with a new covariance and the statistics and regularised inverse that
    /// follow from it.
    pub(crate) fn with_covariance(
        &self,
        covariance: &[f64],
        count: f64,
        effective_count: f64,
    ) -> Result<Self, LinearError> {
        let inverse = regularised_inverse(covariance, self.dimension())?;
        let scatter = covariance.iter().map(|value| value * effective_count).collect();
        Ok(Self {
            numbers: Storage::Owned { centroid: self.centroid().to_vec(), inverse },
            threshold: self.threshold,
            statistics: Some(Statistics { scatter, count, effective_count }),
        })
    }

    /// Feature dimension D.
    pub fn dimension(&self) -> usize {
        self.numbers.dimension()
    }

    /// Centroid **μ**, `[D]`; constant during a campaign.
    pub fn centroid(&self) -> &[f64] {
        self.numbers.centroid()
    }

    /// Inverse covariance S, `[D × D]`, exactly symmetric.
    pub fn inverse(&self) -> &[f64] {
        self.numbers.inverse()
    }

    /// Calibrated threshold θ; constant during a campaign.
    pub fn threshold(&self) -> f64 {
        self.threshold
    }

    /// Scatter and counts; `None` if the mixture came from an export alone or is in shared memory, so that it
    /// cannot be updated.
    pub fn statistics(&self) -> Option<&Statistics> {
        self.statistics.as_ref()
    }

    /// The slices for grading.
    pub fn view(&self) -> ComponentView<'_> {
        ComponentView { centroid: self.centroid(), inverse: self.inverse(), threshold: self.threshold }
    }
}

fn checked_statistics(found: Statistics, dimension: usize) -> Result<Statistics, ComponentError> {
    not_negative("count", found.count)?;
    not_negative("effective count", found.effective_count)?;
    Ok(Statistics { scatter: symmetric("scatter", &found.scatter, dimension)?, ..found })
}

fn symmetric(what: &'static str, matrix: &[f64], dimension: usize) -> Result<Vec<f64>, ComponentError> {
    let expected = dimension.saturating_mul(dimension);
    if matrix.len() != expected {
        return Err(ComponentError::Length { what, found: matrix.len(), expected });
    }
    finite(what, matrix)?;
    Ok(symmetrised(view(matrix, dimension, dimension)))
}

fn finite(what: &'static str, numbers: &[f64]) -> Result<(), ComponentError> {
    match numbers.iter().find(|value| !value.is_finite()) {
        Some(&found) => Err(ComponentError::Number { what, found, not_negative: false }),
        None => Ok(()),
    }
}

fn not_negative(what: &'static str, found: f64) -> Result<(), ComponentError> {
    if found.is_finite() && found >= 0.0 {
        Ok(())
    } else {
        Err(ComponentError::Number { what, found, not_negative: true })
    }
}
