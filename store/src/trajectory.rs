//! A part of the trajectory of a walk as one column: the numbers of its frames, compressed.

use wire::WalkFrame;

use crate::error::StoreError;
use crate::numbers::{compress_numbers, decode_numbers};

/// Numbers of a frame before its positions: segment, step, time, temperature, and the nine of the cell.
const HEAD: usize = 13;
/// Whole numbers above are not exact.
const LARGEST: f64 = 9_007_199_254_740_992.0;

/// Encodes frames of one walk for the column.
pub(crate) fn encode(frames: &[WalkFrame]) -> Vec<u8> {
    let mut numbers = Vec::new();
    for WalkFrame { segment, step, time, temperature, cell, positions } in frames {
        numbers.extend([f64::from(*segment), *step as f64, *time, *temperature]);
        numbers.extend(cell.as_flattened());
        numbers.extend(positions.as_flattened().iter().map(|x| *x as f64));
    }
    compress_numbers(&numbers)
}

/// Decodes the frames of a column with so many.
///
/// # Errors
/// [`StoreError::Damaged`] if the bytes are no such frames.
pub(crate) fn decode(walk: u32, count: usize, bytes: &[u8]) -> Result<Vec<WalkFrame>, StoreError> {
    let damaged = |reason: String| StoreError::damaged(format!("the trajectory of walk {walk}"), reason);
    let numbers = decode_numbers(bytes).map_err(|error| damaged(error.to_string()))?;
    let length = numbers.len().checked_div(count).unwrap_or(0);
    if length < HEAD || length * count != numbers.len() || !(length - HEAD).is_multiple_of(3) {
        return Err(damaged(format!("{} numbers for {count} frames", numbers.len())));
    }
    let frames = numbers.chunks_exact(length).map(|numbers| {
        frame(numbers).ok_or_else(|| damaged("a frame has numbers that are not whole".to_owned()))
    });
    frames.collect()
}

/// A frame from its numbers; `None` if a whole number is not one.
fn frame(numbers: &[f64]) -> Option<WalkFrame> {
    let ([segment, step, time, temperature, cell @ ..], positions) = numbers.split_first_chunk::<HEAD>()?;
    let (rows, _) = cell.as_chunks::<3>();
    let (positions, _) = positions.as_chunks::<3>();
    let positions = positions.iter().map(|[x, y, z]| Some([whole(*x)?, whole(*y)?, whole(*z)?]));
    Some(WalkFrame {
        segment: whole(*segment)?.try_into().ok()?,
        step: whole(*step)?.try_into().ok()?,
        time: *time,
        temperature: *temperature,
        cell: std::array::from_fn(|row| rows[row]),
        positions: positions.collect::<Option<_>>()?,
    })
}

fn whole(number: f64) -> Option<i64> {
    (number.fract() == 0.0 && number.abs() <= LARGEST).then_some(number as i64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(atoms: usize) -> Vec<WalkFrame> {
        let frame = |k: u32| WalkFrame {
            segment: k,
            step: 200 * u64::from(k),
            time: 400.5 * f64::from(k),
            temperature: 612.25,
            cell: [[4.0, 0.1, 0.0], [0.0, 5.0, 0.0], [-0.25, 0.0, 6.0]],
            positions: (0..atoms as i64).map(|atom| [atom, -1_234_567 * atom, (1 << 41) - 1]).collect(),
        };
        (0..3).map(frame).collect()
    }

    #[test]
    fn frames_survive_a_round_trip() {
        for atoms in [1, 2, 64] {
            assert_eq!(decode(7, 3, &encode(&frames(atoms))).unwrap(), frames(atoms), "{atoms}");
        }
    }

    #[test]
    fn a_position_takes_less_than_half_of_its_bytes() {
        let position = |atom: i64, axis: i64| (atom * 2_654_435_761 + axis * 40_503 * atom) % 20_000_000;
        let positions = (0..5000).map(|atom| [position(atom, 1), position(atom, 2), position(atom, 3)]);
        let frame = WalkFrame { positions: positions.collect(), ..WalkFrame::default() };
        assert!(encode(&[frame]).len() < 12 * 5000);
    }

    #[test]
    fn what_are_no_frames_is_refused() {
        let bytes = encode(&frames(2));
        for count in [0, 1, 2, 4, 5, usize::MAX] {
            assert!(decode(7, count, &bytes).is_err(), "{count}");
        }
        assert!(decode(7, 3, &bytes[..bytes.len() - 2]).is_err());
        for (place, wrong) in [(0, 0.5), (0, -1.0), (1, f64::NAN), (14, 1e300), (13, f64::INFINITY)] {
            let mut numbers = decode_numbers(&bytes).unwrap();
            numbers[place] = wrong;
            let error = decode(7, 3, &compress_numbers(&numbers)).unwrap_err().to_string();
            assert!(error.contains("the trajectory of walk 7"), "{error}");
        }
    }
}
