//! The minimum of a function of a length.

/// (3 − √5)/2, the smaller part of a golden section.
const GOLDEN: f64 = 0.381_966_011_250_105;
/// Relative width at which a minimum is found.
const PRECISION: f64 = 1e-5;

/// The local minimum of `f` nearest to `guess`, on a logarithmic scale, among `guess` · e^`range`: a grid of `points` points,
/// then golden section. `None` if there is none inside. Where `f` is `None` it counts as infinite.
pub fn nearest(
    guess: f64,
    [low, high]: [f64; 2],
    points: usize,
    mut f: impl FnMut(f64) -> Option<f64>,
) -> Option<f64> {
    let mut value = |x: f64| f(guess * x.exp()).filter(|y| y.is_finite()).unwrap_or(f64::INFINITY);
    let grid: Vec<_> = (0..points).map(|k| low + (high - low) * k as f64 / (points - 1) as f64).collect();
    let values: Vec<_> = grid.iter().map(|x| value(*x)).collect();
    let is_minimum = |k: &usize| values[*k] < values[k - 1] && values[*k] <= values[k + 1];
    let inside = (1..points.saturating_sub(1)).filter(is_minimum);
    let best = inside.reduce(|best, k| if grid[k].abs() < grid[best].abs() { k } else { best })?;
    let (mut a, mut b) = (grid[best - 1], grid[best + 1]);
    let (mut x, mut y) = (a + GOLDEN * (b - a), b - GOLDEN * (b - a));
    let (mut of_x, mut of_y) = (value(x), value(y));
    while b - a > PRECISION {
        if of_x < of_y {
            (b, y, of_y) = (y, x, of_x);
            x = a + GOLDEN * (b - a);
            of_x = value(x);
        } else {
            (a, x, of_x) = (x, y, of_y);
            y = b - GOLDEN * (b - a);
            of_y = value(y);
        }
    }
    Some(guess * (0.5 * (a + b)).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_of_two_minima_is_found() {
        // Minima at 1 and 3, and none beyond 0.5, where the function falls without end.
        let f = |x: f64| if x < 0.5 { Some(-1.0 / x) } else { Some(((x - 1.0) * (x - 3.0)).powi(2)) };
        for (guess, expected) in [(1.2, 1.0), (2.7, 3.0)] {
            let found = nearest(guess, [-1.2, 1.0], 61, f).unwrap();
            assert!((found - expected).abs() < 1e-4, "{found}");
        }
        assert_eq!(nearest(1.0, [-0.5, 0.5], 41, Some), None);
        assert_eq!(nearest(1.0, [-0.5, 0.5], 41, |_| None), None);
        let found = nearest(1.0, [-0.5, 0.5], 41, |x| (x > 0.9).then_some((x - 1.1).powi(2))).unwrap();
        assert!((found - 1.1).abs() < 1e-4);
    }
}
