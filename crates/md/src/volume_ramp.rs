//! The volume ramp.

use atoms::Structure;
use serde::{Deserialize, Serialize};

use crate::state::State;

/// A relative volume V/V₀ that changes linearly with the step and then stays constant.
///
/// Volume means the extent along periodic directions: area for a slab, length for a wire. A cluster has none
/// and does not change.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct VolumeRamp {
    /// V/V₀ at the start.
    pub from: f64,
    /// V/V₀ at the end.
    pub to: f64,
    /// Length of the ramp in steps.
    pub steps: u64,
    /// The step at which it starts.
    pub start: u64,
    /// V₀, Å³ (Å² for a slab, Å for a wire).
    pub reference: f64,
}

impl VolumeRamp {
    /// A ramp that starts at `state`, whose volume is V₀.
    pub fn new(state: &State, from: f64, to: f64, steps: u64) -> Self {
        Self { from, to, steps, start: state.step, reference: extent(&state.structure) }
    }

    /// V/V₀ after `step` steps.
    pub fn relative_volume(&self, step: u64) -> f64 {
        let done = step.saturating_sub(self.start);
        if done >= self.steps {
            return self.to;
        }
        self.from + (self.to - self.from) * done as f64 / self.steps as f64
    }

    /// Scales `structure` to its volume after `step` steps.
    pub fn apply(&self, structure: &mut Structure, step: u64) {
        scale_volume(structure, self.relative_volume(step) * self.reference / extent(structure));
    }

    pub(crate) fn is_valid(&self) -> bool {
        [self.from, self.to, self.reference].iter().all(|x| x.is_finite() && *x > 0.0)
    }
}

/// Scales the volume by `ratio`: the n periodic lattice vectors by `ratio`^(1/n), and all positions affinely
/// with them. Components orthogonal to those directions and the other lattice vectors do not change.
pub fn scale_volume(structure: &mut Structure, ratio: f64) {
    let dimensions = structure.periodic.iter().filter(|periodic| **periodic).count();
    if dimensions == 0 {
        return;
    }
    let factor = ratio.powf(1.0 / dimensions as f64);
    let before = structure.cell.completed(structure.periodic);
    let mut after = before;
    for k in (0..3).filter(|k| structure.periodic[*k]) {
        after.0[k] = before.0[k].map(|x| factor * x);
        structure.cell.0[k] = after.0[k];
    }
    let reciprocal = before.reciprocal();
    for position in &mut structure.positions {
        *position = after.cartesian(reciprocal.map(|b| atoms::cell::dot(b, *position)));
    }
}

/// Volume (Å³), area (Å²) or length (Å) of the periodic directions; 1 for a cluster.
pub fn extent(structure: &Structure) -> f64 {
    structure.cell.completed(structure.periodic).volume()
}

#[cfg(test)]
mod tests {
    use super::*;
    use atoms::cell::{cross, norm, sub};
    use atoms::{Cell, Vec3};

    fn state(cell: Cell, periodic: [bool; 3]) -> State {
        let positions: Vec<Vec3> = vec![[0.3, -0.7, 1.1], [11.0, 2.0, -5.0], [1.0, 40.0, 3.0]];
        let species = vec!["Al".parse().unwrap(); 3];
        let velocities = vec![[0.0; 3]; 3];
        State { structure: Structure { species, positions, cell, periodic }, velocities, step: 0 }
    }

    const OBLIQUE: Cell = Cell([[4.0, 0.3, -0.2], [-1.0, 5.0, 0.2], [0.5, 0.1, 6.0]]);

    fn at_end(state: &State, ramp: &VolumeRamp) -> Structure {
        let mut structure = state.structure.clone();
        (1..=ramp.steps).for_each(|step| ramp.apply(&mut structure, step));
        structure
    }

    #[test]
    fn relative_volume_is_linear_and_then_stays() {
        let mut state = state(OBLIQUE, [true; 3]);
        state.step = 100;
        let ramp = VolumeRamp::new(&state, 1.0, 1.4, 50);
        assert_eq!([0, 100, 125, 150, 900].map(|step| ramp.relative_volume(step)), [1.0, 1.0, 1.2, 1.4, 1.4]);
    }

    #[test]
    fn bulk_keeps_fractional_coordinates_and_reaches_the_volume() {
        let state = state(OBLIQUE, [true; 3]);
        let end = at_end(&state, &VolumeRamp::new(&state, 1.0, 1.4, 15_000));
        assert!((end.cell.volume() / OBLIQUE.volume() - 1.4).abs() < 1e-13);
        for (before, after) in state.structure.positions.iter().zip(&end.positions) {
            let scaled = before.map(|x| 1.4_f64.cbrt() * x);
            assert!(norm(sub(scaled, *after)) < 1e-9);
        }
    }

    #[test]
    fn slab_grows_in_its_plane_only() {
        for third in [[0.0; 3], [0.5, 0.1, 6.0]] {
            let cell = Cell([[4.0, 0.0, 0.0], [1.0, 5.0, 0.0], third]);
            let state = state(cell, [true, true, false]);
            let end = at_end(&state, &VolumeRamp::new(&state, 0.9, 1.2, 100));
            let area = |cell: &Cell| norm(cross(cell.0[0], cell.0[1]));
            assert!((area(&end.cell) / area(&cell) - 1.2).abs() < 1e-13);
            assert_eq!(end.cell.0[2], third);
            for (before, after) in state.structure.positions.iter().zip(&end.positions) {
                assert!((after[2] - before[2]).abs() < 1e-12);
                assert!((0..2).all(|k| (after[k] - 1.2_f64.sqrt() * before[k]).abs() < 1e-11));
            }
        }
    }

    #[test]
    fn wire_grows_along_its_axis_only() {
        let cell = Cell([[1.0, 2.0, 0.0], [0.0, 4.0, 0.0], [0.0; 3]]);
        let state = state(cell, [false, true, false]);
        let end = at_end(&state, &VolumeRamp::new(&state, 1.0, 0.8, 10));
        assert!((end.cell.0[1][1] - 3.2).abs() < 1e-14);
        assert_eq!((end.cell.0[0], end.cell.0[2]), (cell.0[0], cell.0[2]));
        for (before, after) in state.structure.positions.iter().zip(&end.positions) {
            assert!((after[1] - 0.8 * before[1]).abs() < 1e-12);
            assert!((after[0] - before[0]).abs() < 1e-12 && (after[2] - before[2]).abs() < 1e-12);
        }
    }

    #[test]
    fn cluster_is_left_alone() {
        let state = state(Cell([[0.0; 3]; 3]), [false; 3]);
        assert_eq!(at_end(&state, &VolumeRamp::new(&state, 1.0, 1.4, 10)), state.structure);
    }
}
