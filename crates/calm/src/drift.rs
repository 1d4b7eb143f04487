//! How far a covariance has moved from another, and how well it is conditioned.

use crate::component::Component;
use crate::linear::{LinearError, cholesky, eigenvalues, solve_lower, view};

/// How a component's covariance C has moved since another, C₀ (both with the regularisation εI): from the eigenvalues λ of C
/// relative to C₀, C v = λ C₀ v, each a direction of feature space in which the variance has become λ times as large.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drift {
    /// √λ_max: by what factor the width has grown in the direction in which it grew most; 1 if it has not moved.
    pub grown: f64,
    /// √λ_min: the same of the direction in which it shrank most.
    pub shrunk: f64,
    /// √Σ ln²λ: the distance of the two, which does not depend on the scale or the axes of features (Förstner and Moonen
    /// 1999); 0 if it has not moved.
    pub distance: f64,
}

/// Condition number of a component's regularised covariance: the largest of its eigenvalues by the smallest. `None` where that is
/// beyond double precision.
///
/// # Errors
/// Eigenvalues that do not converge.
pub fn condition_number(component: &Component) -> Result<Option<f64>, LinearError> {
    let dimension = component.dimension();
    let values = eigenvalues(view(component.inverse(), dimension, dimension))?;
    let (least, largest) = ends(&values);
    Ok((least > 0.0).then(|| largest / least))
}

/// How far `now` has moved from `before`. `None` where the covariance of either is singular in double precision, or their
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

/// The first and the last of ascending numbers.
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

    /// A component with these variances along axes that are turned by an angle in the plane of the first two.
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
