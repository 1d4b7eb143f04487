//! Drift of a component's covariance, and its condition number.

use crate::component::Component;
use crate::linear::{LinearError, cholesky, eigenvalues, solve_lower, view};

/// How far a component's covariance C has drifted from an earlier one, C₀ (both with the regularisation εI).
/// Computed from the generalised eigenvalues λ, C v = λ C₀ v: along v the variance has changed by the factor λ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drift {
    /// √λ_max: the largest factor by which the width has grown along any direction; 1 without drift.
    pub grown: f64,
    /// √λ_min: the smallest such factor (the strongest shrinkage).
    pub shrunk: f64,
    /// √Σ ln²λ: the distance of the two covariances, invariant under linear transformations of the features
    /// (Förstner and Moonen 1999); 0 without drift.
    pub distance: f64,
}

/// Condition number of a component's regularised covariance: largest / smallest eigenvalue. `None` if it
/// exceeds double precision.
///
/// # Errors
/// Eigenvalues that do not converge.
pub fn condition_number(component: &Component) -> Result<Option<f64>, LinearError> {
    let dimension = component.dimension();
    let values = eigenvalues(view(component.inverse(), dimension, dimension))?;
    let (least, largest) = ends(&values);
    Ok((least > 0.0).then(|| largest / least))
}

/// The drift from `before` to `now`. `None` if either covariance is singular in double precision or the
/// dimensions differ.
///
/// # Errors
/// Eigenvalues that do not converge.
pub fn drift(before: &Component, now: &Component) -> Result<Option<Drift>, LinearError> {
    let dimension = now.dimension();
    if before.dimension() != dimension {
        return Ok(None);
    }
    // With S = C⁻¹ = LLᵀ, the eigenvalues are those of L⁻¹S₀L⁻ᵀ.
    let Some(factor) = cholesky(now.inverse(), dimension) else { return Ok(None) };
    let mut half = view(before.inverse(), dimension, dimension).to_owned();
    solve_lower(&factor, &mut half);
    let mut whole = half.transpose().to_owned();
    solve_lower(&factor, &mut whole);
    let values = eigenvalues(whole.as_ref())?;
    let (least, largest) = ends(&values);
    Ok((least > 0.0).then(|| Drift {
        grown: largest.sqrt(),
        shrunk: least.sqrt(),
        distance: values.iter().map(|value| value.ln().powi(2)).sum::<f64>().sqrt(),
    }))
}

/// The first and the last element.
fn ends(ascending: &[f64]) -> (f64, f64) {
    let [first, .., last] = ascending else {
        let only = ascending.first().copied().unwrap_or_default();
        return (only, only);
    };
    (*first, *last)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A component with these variances along axes rotated by `angle` in the plane of the first two.
    fn turned(variances: [f64; 3], angle: f64) -> Component {
        let (s, c) = angle.sin_cos();
        let axes = [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]];
        let mut inverse = vec![0.0; 9];
        for (axis, variance) in axes.iter().zip(variances) {
            for (k, value) in inverse.iter_mut().enumerate() {
                *value += axis[k / 3] * axis[k % 3] / variance;
            }
        }
        Component::new(vec![0.0; 3], inverse, 1.0, None).unwrap()
    }

    fn close(found: f64, expected: f64) -> bool {
        (found - expected).abs() < 1e-12 * expected.abs().max(1.0)
    }

    #[test]
    fn what_has_not_moved_is_at_distance_zero() {
        let component = turned([2.0, 0.5, 3.0], 0.4);
        let Drift { grown, shrunk, distance } = drift(&component, &component).unwrap().unwrap();
        assert!(close(grown, 1.0) && close(shrunk, 1.0) && distance < 1e-12, "{grown} {shrunk} {distance}");
    }

    #[test]
    fn widths_that_change_along_the_axes_are_found_again_however_these_are_turned() {
        let before = turned([2.0, 0.5, 3.0], 0.7);
        let now = turned([8.0, 0.5, 0.75], 0.7);
        let moved = drift(&before, &now).unwrap().unwrap();
        assert!(close(moved.grown, 2.0) && close(moved.shrunk, 0.5), "{moved:?}");
        assert!(close(moved.distance, (2.0 * 4.0_f64.ln().powi(2)).sqrt()), "{moved:?}");
        let back = drift(&now, &before).unwrap().unwrap();
        assert!(close(back.distance, moved.distance) && close(back.grown, 2.0), "{back:?}");
    }

    #[test]
    fn a_condition_number_is_that_of_the_covariance() {
        let found = condition_number(&turned([4.0, 0.25, 1.0], 1.1)).unwrap().unwrap();
        assert!(close(found, 16.0), "{found}");
        let singular = Component::new(vec![0.0; 2], vec![1.0, 0.0, 0.0, 0.0], 1.0, None).unwrap();
        assert_eq!(condition_number(&singular).unwrap(), None);
        assert_eq!(drift(&turned([1.0; 3], 0.0), &singular).unwrap(), None);
        let whole = Component::new(vec![0.0; 2], vec![1.0, 0.0, 0.0, 1.0], 1.0, None).unwrap();
        assert_eq!(drift(&whole, &singular).unwrap(), None);
    }
}
