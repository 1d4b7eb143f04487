//! The trace of a walk as one column: numbers by quantity, each from the first point to the last.

use wire::TracePoint;

use crate::error::StoreError;
use crate::numbers::{decode_numbers, encode_numbers};

/// Number of quantities of a point. Later versions add theirs at the end: the column says how many it has.
const QUANTITIES: usize = 20;
/// Bytes of a point in the column; the last quantity is γ_max under the original mixture.
pub(crate) const POINT_BYTES: i64 = (QUANTITIES * size_of::<f64>()) as i64;
/// That of the first version, without γ_max under the original mixture.
const FIRST_QUANTITIES: usize = 19;
/// Whole numbers above are not exact in a column of f64.
const LARGEST: f64 = 9_007_199_254_740_992.0;

/// Encodes points for the column. What a point does not have is NaN.
pub(crate) fn encode(points: &[TracePoint]) -> Vec<u8> {
    let rows: Vec<_> = points.iter().map(quantities).collect();
    let by_quantity = (0..QUANTITIES).flat_map(|k| rows.iter().map(move |row| row[k]));
    encode_numbers(&by_quantity.collect::<Vec<_>>())
}

/// Decodes the points of a column with so many.
///
/// # Errors
/// [`StoreError::Damaged`] if the bytes are no trace of so many points.
pub(crate) fn decode(walk: u32, count: usize, bytes: &[u8]) -> Result<Vec<TracePoint>, StoreError> {
    let damaged = |reason: String| StoreError::damaged(format!("the trace of walk {walk}"), reason);
    let numbers = decode_numbers(bytes).map_err(|error| damaged(error.to_string()))?;
    if numbers.len() < count.saturating_mul(FIRST_QUANTITIES) || !numbers.len().is_multiple_of(count.max(1)) {
        return Err(damaged(format!("{} numbers for {count} points", numbers.len())));
    }
    let number = |place: usize| numbers.get(place).copied().unwrap_or(f64::NAN);
    let row = |k: usize| std::array::from_fn(|quantity| number(quantity * count + k));
    let point =
        |k| point(&row(k)).ok_or_else(|| damaged(format!("point {k} has numbers that are not whole")));
    (0..count).map(point).collect()
}

fn quantities(point: &TracePoint) -> [f64; QUANTITIES] {
    let [a, b, c, alpha, beta, gamma] = point.cell.unwrap_or([f64::NAN; 6]);
    [
        point.number as f64,
        point.segment.into(),
        point.step as f64,
        point.time,
        point.temperature,
        point.pressure.unwrap_or(f64::NAN),
        point.relative_volume,
        a,
        b,
        c,
        alpha,
        beta,
        gamma,
        point.conserved_energy.unwrap_or(f64::NAN),
        point.gamma_max.unwrap_or(f64::NAN),
        point.bias_scale,
        point.cell_gain,
        point.bias_share,
        point.bias_work,
        point.gamma_max_original.unwrap_or(f64::NAN),
    ]
}

/// A point from its quantities; `None` if a whole number is not one.
fn point(quantities: &[f64; QUANTITIES]) -> Option<TracePoint> {
    let [
        number,
        segment,
        step,
        time,
        temperature,
        pressure,
        relative_volume,
        a,
        b,
        c,
        alpha,
        beta,
        gamma,
        conserved_energy,
        gamma_max,
        bias_scale,
        cell_gain,
        bias_share,
        bias_work,
        gamma_max_original,
    ] = *quantities;
    let given = |x: f64| (!x.is_nan()).then_some(x);
    Some(TracePoint {
        number: whole(number)?,
        segment: whole(segment)?.try_into().ok()?,
        step: whole(step)?,
        time,
        temperature,
        pressure: given(pressure),
        relative_volume,
        cell: given(a).map(|a| [a, b, c, alpha, beta, gamma]),
        conserved_energy: given(conserved_energy),
        gamma_max: given(gamma_max),
        bias_scale,
        cell_gain,
        bias_share,
        bias_work,
        gamma_max_original: given(gamma_max_original),
    })
}

fn whole(number: f64) -> Option<u64> {
    (number.fract() == 0.0 && (0.0..=LARGEST).contains(&number)).then_some(number as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points() -> Vec<TracePoint> {
        let full = TracePoint {
            number: 3,
            segment: 1,
            step: 150,
            time: 300.0,
            temperature: 612.5,
            pressure: Some(-1.5),
            relative_volume: 1.125,
            cell: Some([4.0, 5.0, 6.0, 90.0, 80.0, 70.0]),
            conserved_energy: Some(-300.25),
            gamma_max: Some(1.75),
            bias_scale: 0.5,
            cell_gain: 0.25,
            bias_share: 0.125,
            bias_work: 2.5,
            gamma_max_original: Some(3.5),
        };
        let cell = None;
        let sparse = TracePoint { number: 4, step: 1 << 53, pressure: None, cell, ..full.clone() };
        let sparse = TracePoint { conserved_energy: None, gamma_max: None, ..sparse };
        vec![full, TracePoint { gamma_max_original: None, ..sparse }]
    }

    #[test]
    fn points_survive_a_round_trip() {
        let (points, bytes) = (points(), encode(&points()));
        assert_eq!(decode(7, 2, &bytes).unwrap(), points);
        assert_eq!(decode(7, 0, &encode(&[])).unwrap(), []);
        // A later version has more quantities.
        let mut numbers = decode_numbers(&bytes).unwrap();
        numbers.extend([9.0; 2]);
        assert_eq!(decode(7, 2, &encode_numbers(&numbers)).unwrap(), points);
    }

    #[test]
    fn points_of_the_first_version_have_no_grade_under_the_original_mixture() {
        let mut numbers = decode_numbers(&encode(&points())).unwrap();
        numbers.truncate(2 * FIRST_QUANTITIES);
        let expected = points().into_iter().map(|point| TracePoint { gamma_max_original: None, ..point });
        let expected: Vec<_> = expected.collect();
        let found = decode(7, 2, &encode_numbers(&numbers)).unwrap();
        assert_eq!(found, expected);
        // Later points of the same walk have it.
        let joined = [found, points()].concat();
        assert_eq!(decode(7, 4, &encode(&joined)).unwrap(), joined);
    }

    #[test]
    fn what_is_no_trace_is_refused() {
        let bytes = encode(&points());
        for count in [1, 3, 5, usize::MAX] {
            let found = decode(7, count, &bytes);
            assert_eq!(found.is_err(), count != 1, "{count}");
        }
        assert!(decode(7, 2, &bytes[..40]).is_err());
        for (place, wrong) in [(0, 0.5), (2, -1.0), (4, 1e300), (3, f64::NAN)] {
            let mut numbers = decode_numbers(&bytes).unwrap();
            numbers[place] = wrong;
            let error = decode(7, 2, &encode_numbers(&numbers)).unwrap_err().to_string();
            assert!(error.contains("the trace of walk 7"), "{error}");
        }
    }
}
