//! A frame of a walk's trajectory: cell and positions at a step. Positions are rounded to a millionth of an Å, so that a frame takes a
//! few bytes for each of them.

use atoms::{Matrix3, Vec3};
use serde::{Deserialize, Serialize};

/// Units of positions in an Å.
const PER_ANGSTROM: f64 = 1e6;
/// The largest position in these units, 2⁴¹ − 1, has 6 bytes in a message.
const LARGEST: f64 = ((1_i64 << 41) - 1) as f64;
const COORDINATE_BYTES: usize = 6;
/// Everything but positions.
const REST_BYTES: usize = 128;

/// Cell and positions of a walk at one step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WalkFrame {
    /// Segment.
    pub segment: u32,
    /// Step, including equilibration.
    pub step: u64,
    /// Time since the start of the walk, fs.
    pub time: f64,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// Lattice vectors as rows, Å.
    pub cell: Matrix3,
    /// [n], 10⁻⁶ Å.
    pub positions: Vec<[i64; 3]>,
}

impl WalkFrame {
    /// The largest size of a frame in a message, bytes.
    pub const fn max_bytes(atoms: usize) -> usize {
        3 * COORDINATE_BYTES * atoms + REST_BYTES
    }

    /// Rounds positions (Å) for a frame.
    pub fn rounded(positions: &[Vec3]) -> Vec<[i64; 3]> {
        let rounded = |x: f64| (PER_ANGSTROM * x).round().clamp(-LARGEST, LARGEST) as i64;
        positions.iter().map(|position| position.map(rounded)).collect()
    }

    /// Positions, Å.
    pub fn angstroms(&self) -> Vec<Vec3> {
        self.positions.iter().map(|position| position.map(|x| x as f64 / PER_ANGSTROM)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_are_rounded_to_a_millionth() {
        let positions = vec![[0.1 + 0.2, -1.0 / 3.0, 12.3456784], [0.0, -0.0, 1e300]];
        let frame = WalkFrame { positions: WalkFrame::rounded(&positions), ..WalkFrame::default() };
        assert_eq!(frame.angstroms()[0], [0.3, -0.333333, 12.345678]);
        assert_eq!(frame.positions[1], [0, 0, LARGEST as i64]);
    }

    #[test]
    fn frames_fit_into_the_size_that_is_given() {
        for (atoms, x) in [(0, 0.0), (1, 1.0), (100, 12.5), (100, -1e300), (1000, 1e300)] {
            let frame = WalkFrame {
                segment: u32::MAX,
                step: u64::MAX,
                positions: WalkFrame::rounded(&vec![[x; 3]; atoms]),
                ..WalkFrame::default()
            };
            let bytes = postcard::to_stdvec(&frame).unwrap();
            assert!(bytes.len() <= WalkFrame::max_bytes(atoms), "{atoms} {x}: {}", bytes.len());
            assert_eq!(postcard::from_bytes::<WalkFrame>(&bytes).unwrap(), frame);
        }
    }
}
