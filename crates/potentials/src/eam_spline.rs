//! Piecewise cubic interpolation of embedded-atom tables.

/// Coefficients of c₀ + c₁ p + c₂ p² + c₃ p³; p is the fraction of the interval.
pub(crate) type Cubic = [f64; 4];

/// The cubic Hermite pieces through `values` (at least five), one per value; the last is a straight line.
///
/// Continuous with its first derivative. The derivative at a point is the five-point difference f′ = (f₋₂ − 8
/// f₋₁ + 8 f₊₁ − f₊₂) / 12, next to the ends the three-point one, and at the ends the two-point one. Setfl
/// tables are published for this interpolation.
pub(crate) fn cubic_pieces(values: &[f64]) -> Vec<Cubic> {
    let last = values.len() - 1;
    let derivative = |k: usize| match k {
        0 => values[1] - values[0],
        _ if k == last => values[k] - values[k - 1],
        _ if k == 1 || k == last - 1 => (values[k + 1] - values[k - 1]) / 2.0,
        _ => (values[k - 2] - values[k + 2] + 8.0 * (values[k + 1] - values[k - 1])) / 12.0,
    };
    let between = (0..last).map(|k| {
        let (left, right) = (derivative(k), derivative(k + 1));
        let step = values[k + 1] - values[k];
        [values[k], left, 3.0 * step - 2.0 * left - right, left + right - 2.0 * step]
    });
    between.chain([[values[last], derivative(last), 0.0, 0.0]]).collect()
}

/// The piece that contains `x` (in units of the spacing), and p.
#[inline]
pub(crate) fn locate(x: f64, pieces: usize) -> (usize, f64) {
    let k = (x as usize).min(pieces - 1);
    (k, x - k as f64)
}

/// The value at p.
#[inline]
pub(crate) fn value(c: &Cubic, p: f64) -> f64 {
    ((c[3] * p + c[2]) * p + c[1]) * p + c[0]
}

/// The derivative by p.
#[inline]
pub(crate) fn slope(c: &Cubic, p: f64) -> f64 {
    (3.0 * c[3] * p + 2.0 * c[2]) * p + c[1]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Five-point derivatives are exact for quartics, so cubics are reproduced to rounding.
    #[test]
    fn a_cubic_is_reproduced_away_from_the_ends() {
        let f = |x: f64| 1.0 + x * (-0.5 + x * (0.25 - 0.125 * x));
        let values: Vec<f64> = (0..9).map(|k| f(f64::from(k))).collect();
        let pieces = cubic_pieces(&values);
        for x in [2.0, 2.3, 3.5, 4.99, 5.75] {
            let (k, p) = locate(x, pieces.len());
            assert!((value(&pieces[k], p) - f(x)).abs() < 1e-13, "{x}");
            let derivative = -0.5 + x * (0.5 - 0.375 * x);
            assert!((slope(&pieces[k], p) - derivative).abs() < 1e-13, "{x}");
        }
    }

    #[test]
    fn the_points_are_met_and_a_straight_line_follows() {
        let values = [3.0, -1.0, 4.0, 1.0, -5.0, 9.0];
        let pieces = cubic_pieces(&values);
        for (k, expected) in values.iter().enumerate() {
            let (piece, p) = locate(k as f64, pieces.len());
            assert_eq!((value(&pieces[piece], p), p), (*expected, 0.0));
        }
        let before = &pieces[4];
        assert!((value(before, 1.0) - 9.0).abs() < 1e-14 && (slope(before, 1.0) - 14.0).abs() < 1e-13);
        let (piece, p) = locate(7.5, pieces.len());
        assert_eq!((value(&pieces[piece], p), slope(&pieces[piece], p)), (9.0 + 2.5 * 14.0, 14.0));
    }
}
