//! The trace of a walk: its physical state at an interval of steps, thinned to a bounded number of points.
//!
//! Which points remain is a function of their number alone ([`thin`]): the same walk has the same trace, however its
//! points were grouped into reports.

use serde::{Deserialize, Serialize};

/// Largest number of points that are kept of a walk, besides its last one.
pub const MAX_KEPT_POINTS: usize = 512;

/// The state of a walk after one step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TracePoint {
    /// Its number in the walk, from 0, across segments.
    pub number: u64,
    /// Segment.
    pub segment: u32,
    /// Step, including equilibration.
    pub step: u64,
    /// Time since the start of the walk, fs.
    pub time: f64,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// A third of the trace of the pressure tensor, compression positive, GPa, without the bias. `None` without
    /// periodic directions.
    pub pressure: Option<f64>,
    /// V / V₀.
    pub relative_volume: f64,
    /// Lengths a, b, c (Å) and angles α, β, γ (°) of the cell; `None` without periodic directions.
    pub cell: Option<[f64; 6]>,
    /// The conserved quantity of the unbiased motion, eV: the bias changes it by its work, a volume ramp by more. `None` with
    /// a Langevin thermostat.
    pub conserved_energy: Option<f64>,
    /// Largest γ under the walker's mixture; `None` if the structure cannot be graded.
    pub gamma_max: Option<f64>,
    /// τ_r, the factor on ∇Σγ in the force, eV.
    pub bias_scale: f64,
    /// Gain τ_s of the bias on the cell.
    pub cell_gain: f64,
    /// Σ‖τ_r ∇Σγ‖ / Σ‖F‖ over atoms, F being the force of the potential.
    pub bias_share: f64,
    /// Work done by the force of the bias since the start of the walk, along its path, eV.
    pub bias_work: f64,
    /// Largest γ under the original mixture; `None` if the structure cannot be graded, and in points of earlier versions.
    #[serde(default)]
    pub gamma_max_original: Option<f64>,
}

/// Removes points that a walk with so many does not keep. With 2ᵏ the smallest power of two by which the number of points of
/// the walk so far, divided, is not above [`MAX_KEPT_POINTS`], the points whose number is a multiple of 2ᵏ remain, and the
/// last one. `points` are the newest of their walk in order, from any of them on: what remains of them remains of the
/// whole walk too, or is gone when later points are there.
pub fn thin(points: &mut Vec<TracePoint>) {
    let Some(last) = points.last().map(|point| point.number) else { return };
    let stride = stride(last.saturating_add(1));
    points.retain(|point| point.number % stride == 0 || point.number == last);
}

/// Distance between the points that are kept of `all` points.
fn stride(all: u64) -> u64 {
    let mut stride = 1;
    while all.div_ceil(stride) > MAX_KEPT_POINTS as u64 {
        stride *= 2;
    }
    stride
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn point(number: u64) -> TracePoint {
        TracePoint { number, ..TracePoint::default() }
    }

    /// What remains of the points of reports with so many each, thinned in the report, and again where it is added.
    fn kept(reports: &[u64]) -> Vec<u64> {
        let (mut kept, mut next) = (Vec::new(), 0);
        for count in reports {
            let mut reported: Vec<_> = (next..next + count).map(point).collect();
            next += count;
            thin(&mut reported);
            kept.extend(reported);
            thin(&mut kept);
        }
        kept.iter().map(|point| point.number).collect()
    }

    proptest! {
        #[test]
        fn what_remains_depends_on_the_number_of_points_only(
            reports in proptest::collection::vec(prop_oneof![0..5_u64, 0..700_u64, 0..3000_u64], 0..12),
        ) {
            let all: u64 = reports.iter().sum();
            let kept = kept(&reports);
            prop_assert_eq!(&kept, &self::kept(&[all]));
            prop_assert!(kept.len() <= MAX_KEPT_POINTS + 1);
            prop_assert!(kept.is_sorted_by(|a, b| a < b));
            prop_assert_eq!(kept.first().copied(), (all > 0).then_some(0));
            prop_assert_eq!(kept.last().copied(), all.checked_sub(1));
            // Until the limit nothing is removed, and at most half of what could remain.
            prop_assert!(kept.len() as u64 >= all.min(MAX_KEPT_POINTS as u64 / 2), "{} of {}", kept.len(), all);
        }
    }

    #[test]
    fn the_resolution_is_halved_beyond_the_limit() {
        let limit = MAX_KEPT_POINTS as u64;
        assert_eq!(kept(&[limit]), (0..limit).collect::<Vec<_>>());
        let mut halved: Vec<_> = (0..=limit).step_by(2).collect();
        assert_eq!(kept(&[limit + 1]), halved);
        halved.push(limit + 1);
        assert_eq!(kept(&[limit + 2]), halved);
    }

    #[test]
    fn the_largest_number_of_points_ends() {
        let mut points = vec![point(0), point(3), point(u64::MAX)];
        thin(&mut points);
        assert_eq!(points.iter().map(|point| point.number).collect::<Vec<_>>(), [0, u64::MAX]);
    }
}
