//! The choice of the number of clusters.

/// Values within this distance of the largest count as equally far.
const TOLERANCE: f64 = 1e-3;

/// The number of clusters by the maximum-distance elbow criterion (paper, Methods).
///
/// `candidates` are ascending, `inertia` is the within-cluster sum of squares of each (any multiple of it). The point
/// (2 K_last − K_first, y_last) is appended, so that the last candidate can be chosen. With both axes scaled to
/// \[0, 1\], the distance from the line between (0, 1) and (1, 0) is |k + y − 1|/√2; the smallest candidate within
/// 10⁻³ of the largest distance is the elbow. With at most two candidates, or if the inertia is constant or not finite,
/// it is the first. `None` without candidates.
pub fn elbow(candidates: &[usize], inertia: &[f64]) -> Option<usize> {
    let (&first, &last) = (candidates.first()?, candidates.last()?);
    let least = inertia.iter().copied().fold(f64::INFINITY, f64::min);
    let span = inertia.iter().copied().fold(f64::NEG_INFINITY, f64::max) - least;
    let finite = inertia.iter().all(|y| y.is_finite());
    if candidates.len() <= 2 || !finite || span <= 0.0 {
        return Some(first);
    }
    let width = 2.0 * (last - first) as f64;
    let distance = |(&k, &y): (&usize, &f64)| {
        ((k - first) as f64 / width + (y - least) / span - 1.0).abs() / std::f64::consts::SQRT_2
    };
    let points = || candidates.iter().zip(inertia);
    let largest = points().map(distance).fold(0.0, f64::max);
    points().find(|&point| distance(point) >= largest - TOLERANCE).map(|(&k, _)| k)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::tests::{numbers, unit_cases};

    #[test]
    fn elbows_are_those_of_the_reference() {
        let cases = unit_cases();
        let cases = cases["elbow"].as_array().unwrap();
        assert_eq!(cases.len(), 6);
        for case in cases {
            let candidates: Vec<usize> = serde_json::from_value(case["k"].clone()).unwrap();
            let found = elbow(&candidates, &numbers(&case["inertia"])).unwrap();
            assert_eq!(case["chosen"], found, "{case}");
        }
    }

    #[test]
    fn curves_without_an_elbow_have_the_first_candidate() {
        assert_eq!(elbow(&[], &[]), None);
        assert_eq!(elbow(&[3], &[1.0]), Some(3));
        assert_eq!(elbow(&[1, 2, 4], &[0.0; 3]), Some(1));
        assert_eq!(elbow(&[1, 2, 4], &[f64::NAN, 1.0, 0.5]), Some(1));
        assert_eq!(elbow(&[1, 2, 4], &[f64::INFINITY, 1.0, 0.5]), Some(1));
    }
}
