//! Checks whether training data can have produced the numbers of a mixture.
//!
//! A mixture loads if its arrays fit together, and any inverse covariance gives grades: one that is a million
//! times too small grades everything 0.001, so that nothing is ever collected. A build satisfies relations that
//! wrong numbers do not satisfy by accident:
//!
//! - S = (C + εI)⁻¹ with ε = 10⁻⁶, so S is positive definite, no eigenvalue exceeds 1/ε, and tr(S (C + εI)) =
//!   D. The last holds for covariances of any rank.
//! - The mean of σ² over the training data of a component is tr(SC), and θ is a quantile of σ or a multiple of
//!   one.
//! - Features of a normalised basis are no longer than the columns of the projection, and neither are their
//!   means.

use crate::artifact::{Artifact, SENTINEL};
use crate::component::Component;
use crate::linear::{LinearError, REGULARISATION, cholesky, eigenvalues, regularised, view};
use crate::mixture::Mixture;

/// Files store single precision: the relative rounding of a number, with a margin for sums of rounded numbers.
const STORAGE_ROUNDING: f64 = 1.0 / (1 << 22) as f64;

/// Largest deviation of tr(S (C + εI))/D from 1 apart from rounding; builds deviate by 10⁻⁴.
const TRACE_TOLERANCE: f64 = 0.05;

/// Largest condition number of S: above it the build's pseudo-inverse drops directions.
const CONDITION_LIMIT: f64 = 1e15;

/// The σ histograms of builds start here, so no threshold is smaller.
const MIN_THRESHOLD: f64 = 0.01;

/// Largest θ/√⟨σ²⟩: fewer than 1 in 10⁴ environments exceed it (Markov). Builds: 1 to 3.
const MAX_THRESHOLD_RATIO: f64 = 100.0;

/// Smallest θ/√⟨σ²⟩, even for heavy tails of σ.
const MIN_THRESHOLD_RATIO: f64 = 1e-3;

/// Tolerance for centroids that exceed the bound of the features by rounding.
const CENTROID_TOLERANCE: f64 = 1.01;

/// A component that no training data can produce.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("component {slot} of {element}: {fault}")]
pub struct UnsoundComponent {
    /// Chemical symbol.
    pub element: String,
    /// Index among the components of the element.
    pub slot: usize,
    /// What is wrong with it.
    pub fault: ComponentFault,
}

/// What is wrong with a component.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ComponentFault {
    /// S has an eigenvalue that is zero or negative.
    #[error(
        "its inverse covariance has eigenvalues from {least:.3e} to {largest:.3e}; expected a positive definite matrix"
    )]
    NotPositive {
        /// Least eigenvalue.
        least: f64,
        /// Largest eigenvalue.
        largest: f64,
    },
    /// The eigenvalues of S are too far apart.
    #[error(
        "its inverse covariance has a condition number of at least {found:.1e}; expected at most {CONDITION_LIMIT:.0e}"
    )]
    Condition {
        /// Lower bound of the condition number.
        found: f64,
    },
    /// S is larger than the regularisation allows.
    #[error(
        "its inverse covariance has {found:.3e} on the diagonal; expected at most {:.0e}, because 1e-6 is \
         added to every variance",
        1.0 / REGULARISATION
    )]
    TooLarge {
        /// The largest element of its diagonal.
        found: f64,
    },
    /// C has a negative eigenvalue.
    #[error(
        "its scatter has a negative eigenvalue ({least:.3e}, the largest is {largest:.3e}); expected none"
    )]
    Scatter {
        /// Least eigenvalue of scatter/count.
        least: f64,
        /// Largest eigenvalue.
        largest: f64,
    },
    /// Data without weight or weight without data.
    #[error(
        "it has {count} environments with a total weight of {effective_count}; expected both to be \
         positive, or both 0"
    )]
    Counts {
        /// Number of environments.
        count: f64,
        /// Sum of their weights.
        effective_count: f64,
    },
    /// S is not the inverse of C + εI.
    #[error(
        "its inverse covariance does not match its scatter and count: their product has a mean eigenvalue of \
         {found:.3e}; expected 1"
    )]
    Inconsistent {
        /// tr(S (C + εI))/D.
        found: f64,
    },
    /// θ is outside the range of σ.
    #[error("its threshold is {found:.3e}; expected {least:.1e} to {most:.1e}")]
    Threshold {
        /// θ.
        found: f64,
        /// Smallest plausible value.
        least: f64,
        /// Largest plausible value.
        most: f64,
    },
    /// **μ** = 0 for a component with data.
    #[error("its centroid is zero; expected the mean of its features")]
    NoCentroid,
    /// **μ** is outside the range of the features.
    #[error(
        "its centroid is {found:.3e} in feature {feature}, where the model's features are between ±{most:.3e}"
    )]
    Centroid {
        /// Index of the feature.
        feature: usize,
        /// Its value.
        found: f64,
        /// The largest possible value.
        most: f64,
    },
    /// Two components have the same centroid.
    #[error("it shares the centroid of component {first}; expected a distinct one")]
    Duplicate {
        /// The first of the two.
        first: usize,
    },
    /// A matrix for which the linear algebra failed.
    #[error(transparent)]
    Linear(#[from] LinearError),
}

impl Artifact {
    /// The components that no training data can produce, in order, each with its first fault.
    ///
    /// Placeholders of elements without data and unused slots are valid. So is a matrix that is positive
    /// definite up to the rounding of its storage.
    pub fn unsound_components(&self) -> Vec<UnsoundComponent> {
        let reach = self.reach();
        let elements = self.symbols.iter().enumerate();
        let of_element = elements.filter_map(|(element, symbol)| {
            let components: Vec<_> = self.mixture.components(element)?.iter().map(AsRef::as_ref).collect();
            let spread = Spread::new(&components);
            let faults = components.iter().enumerate().filter_map(|(slot, component)| {
                let fault = check(component, &spread, &reach)
                    .and_then(|()| unlike(&components[..slot], component))
                    .err()?;
                Some(UnsoundComponent { element: symbol.clone(), slot, fault })
            });
            Some(faults.collect::<Vec<_>>())
        });
        of_element.flatten().collect()
    }

    /// The largest value of each projected feature: the norm of its column, since the basis has at most norm 1.
    fn reach(&self) -> Vec<f64> {
        let projection = &self.projection;
        if !projection.normalised {
            return Vec::new();
        }
        let mut squares = vec![0.0; projection.columns];
        for row in projection.matrix.chunks_exact(projection.columns) {
            squares.iter_mut().zip(row).for_each(|(sum, value)| *sum += f64::from(*value).powi(2));
        }
        squares.into_iter().map(f64::sqrt).collect()
    }
}

/// √⟨σ²⟩ over the data of a component, for the components of an element.
struct Spread {
    least: f64,
    largest: f64,
}

impl Spread {
    /// Without statistics, ⟨σ²⟩ is at most D. A component with few data gets the largest threshold of its
    /// element.
    fn new(components: &[&Component]) -> Self {
        let spread = |component: &&Component| match component.statistics() {
            Some(statistics) => mean_square(component, &statistics.covariance()).max(0.0).sqrt(),
            None => (component.dimension() as f64).sqrt(),
        };
        let with_data = components.iter().filter(|component| has_data(component)).map(spread);
        let (least, largest) = with_data.fold((f64::INFINITY, 0.0_f64), |(a, b), x| (a.min(x), b.max(x)));
        // A component whose data are all equal has θ = 1.
        Self { least: if least.is_finite() { least } else { 0.0 }, largest: largest.max(1.0) }
    }
}

fn has_data(component: &Component) -> bool {
    component.statistics().is_none_or(|statistics| statistics.effective_count > 0.0)
}

/// tr(SC).
fn mean_square(component: &Component, covariance: &[f64]) -> f64 {
    component.inverse().iter().zip(covariance).map(|(a, b)| a * b).sum()
}

fn check(component: &Component, spread: &Spread, reach: &[f64]) -> Result<(), ComponentFault> {
    check_inverse(component)?;
    check_statistics(component)?;
    check_threshold(component.threshold(), spread)?;
    check_centroid(component, reach)
}

fn check_inverse(component: &Component) -> Result<(), ComponentFault> {
    let (inverse, dimension) = (component.inverse(), component.dimension());
    let found = diagonal(inverse, dimension).fold(0.0, f64::max);
    if found > 2.0 / REGULARISATION {
        return Err(ComponentFault::TooLarge { found });
    }
    match cholesky(inverse, dimension) {
        Some(factor) => {
            // No pivot is smaller than the smallest eigenvalue.
            let least = (0..dimension).map(|k| factor[(k, k)].powi(2)).fold(f64::INFINITY, f64::min);
            match found / least {
                found if found > CONDITION_LIMIT => Err(ComponentFault::Condition { found }),
                _ => Ok(()),
            }
        }
        None => {
            let (least, largest) = extremes(inverse, dimension)?;
            if largest > 0.0 && least > -rounding(largest, dimension) {
                return Ok(());
            }
            Err(ComponentFault::NotPositive { least, largest })
        }
    }
}

fn check_statistics(component: &Component) -> Result<(), ComponentFault> {
    let Some(statistics) = component.statistics() else { return Ok(()) };
    let (count, effective_count) = (statistics.count, statistics.effective_count);
    if (count > 0.0) != (effective_count > 0.0) {
        return Err(ComponentFault::Counts { count, effective_count });
    }
    let dimension = component.dimension();
    let covariance = statistics.covariance();
    let regularised = regularised(&covariance, dimension);
    if cholesky(&regularised, dimension).is_none() {
        let (least, largest) = extremes(&covariance, dimension)?;
        if least < -rounding(largest.max(0.0), dimension) - REGULARISATION {
            return Err(ComponentFault::Scatter { least, largest });
        }
    }
    let found = mean_square(component, &regularised) / dimension as f64;
    let absolute: f64 = component.inverse().iter().zip(&regularised).map(|(a, b)| (a * b).abs()).sum();
    let tolerance = TRACE_TOLERANCE + STORAGE_ROUNDING * absolute / dimension as f64;
    if (found - 1.0).abs() > tolerance {
        return Err(ComponentFault::Inconsistent { found });
    }
    Ok(())
}

fn check_threshold(found: f64, spread: &Spread) -> Result<(), ComponentFault> {
    let least = MIN_THRESHOLD.max(MIN_THRESHOLD_RATIO * spread.least);
    let most = MAX_THRESHOLD_RATIO * spread.largest;
    if (least..=most).contains(&found) {
        Ok(())
    } else {
        Err(ComponentFault::Threshold { found, least, most })
    }
}

fn check_centroid(component: &Component, reach: &[f64]) -> Result<(), ComponentFault> {
    let centroid = component.centroid();
    if !is_used(component) {
        return Ok(());
    }
    if centroid.iter().all(|value| *value == 0.0) {
        return Err(ComponentFault::NoCentroid);
    }
    // Features without a bound from the projection must be smaller than the fill value of unused slots.
    let bounds = reach.iter().map(|reach| CENTROID_TOLERANCE * reach).chain(std::iter::repeat(SENTINEL));
    let mut beyond = centroid.iter().zip(bounds).enumerate();
    match beyond.find(|(_, (value, most))| value.abs() > *most) {
        Some((feature, (&found, most))) => Err(ComponentFault::Centroid { feature, found, most }),
        None => Ok(()),
    }
}

impl Mixture {
    /// Whether a component of this element represents data. Without any, all grades of the element are huge.
    pub fn has_data_of(&self, element: usize) -> bool {
        self.components(element)
            .is_some_and(|components| components.iter().any(|component| is_used(component)))
    }
}

/// Whether a component represents data: it is neither an unused slot nor the placeholder of an element without
/// data.
fn is_used(component: &Component) -> bool {
    if component.statistics().is_some() {
        return has_data(component);
    }
    let stand_in = |value: f64| (value * REGULARISATION - 1.0).abs() < STORAGE_ROUNDING;
    !diagonal(component.inverse(), component.dimension()).all(stand_in)
}

/// If two components share a centroid, the second is never the nearest.
fn unlike(before: &[&Component], component: &Component) -> Result<(), ComponentFault> {
    if !is_used(component) {
        return Ok(());
    }
    match before.iter().position(|other| other.centroid() == component.centroid()) {
        Some(first) => Err(ComponentFault::Duplicate { first }),
        None => Ok(()),
    }
}

fn diagonal(matrix: &[f64], dimension: usize) -> impl Iterator<Item = f64> {
    matrix.iter().step_by(dimension + 1).copied()
}

/// The smallest and the largest eigenvalue.
fn extremes(matrix: &[f64], dimension: usize) -> Result<(f64, f64), LinearError> {
    let values = eigenvalues(view(matrix, dimension, dimension))?;
    Ok((values.first().copied().unwrap_or_default(), values.last().copied().unwrap_or_default()))
}

/// Upper bound of the shift of the eigenvalues by the rounding of a stored matrix: the norm of the error.
fn rounding(largest: f64, dimension: usize) -> f64 {
    STORAGE_ROUNDING * largest * dimension as f64
}
