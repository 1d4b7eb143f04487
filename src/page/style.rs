//! Common style of the figures.

use analysis::quantile;
use figures::{Axis, AxisScale, Rectangle};

/// Width of a two-column figure of a journal: 180 mm, in points.
pub const WIDTH: f64 = 510.0;

/// Rectangles of `number` panels side by side, with room for axis labels.
pub fn row(number: usize, [left, gap, right]: [f64; 3], top: f64, height: f64) -> Vec<Rectangle> {
    let n = number as f64;
    let width = (WIDTH - left - right - gap * (n - 1.0)) / n;
    (0..number).map(|k| Rectangle { x: left + k as f64 * (width + gap), y: top, width, height }).collect()
}

/// An axis over the values without 0.1 % at either end, extended to include `must`.
pub fn axis(title: &str, scale: AxisScale, values: &[f64], must: Option<f64>) -> Axis {
    let is_usable = |x: &f64| x.is_finite() && (scale == AxisScale::Linear || *x > 0.0);
    let mut ascending: Vec<_> = values.iter().copied().filter(is_usable).collect();
    ascending.sort_by(f64::total_cmp);
    let ends = quantile(&ascending, 0.001).zip(quantile(&ascending, 0.999));
    let (low, high) = ends.or(must.map(|must| (must, must))).unwrap_or((f64::NAN, f64::NAN));
    let (low, high) = (low.min(must.unwrap_or(low)), high.max(must.unwrap_or(high)));
    match scale {
        AxisScale::Linear => {
            let margin = if high > low { 0.04 * (high - low) } else { 0.02 * high.abs().max(1e-3) };
            Axis::new(title, scale, low - margin, high + margin)
        }
        AxisScale::Logarithmic => {
            let margin = (high / low).powf(0.04).max(1.1);
            Axis::new(title, scale, low / margin, high * margin)
        }
    }
}

/// A large number with no-break spaces between thousands.
pub fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            text.push('\u{a0}');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_hold_what_they_must() {
        let values: Vec<_> = (1..=1000).map(f64::from).collect();
        let linear = axis("x", AxisScale::Linear, &values, Some(-100.0));
        assert!(linear.low < -100.0 && linear.high > 990.0 && linear.high < 1100.0);
        let logarithmic = axis("x", AxisScale::Logarithmic, &[0.0, -1.0, f64::NAN], Some(1.0));
        assert!(logarithmic.low < 1.0 && logarithmic.high > 1.0 && logarithmic.low > 0.5);
        let none = axis("x", AxisScale::Linear, &[], None);
        assert!(none.low < none.high);
    }

    #[test]
    fn thousands_are_apart() {
        assert_eq!([7, 1234, 1_000_000].map(grouped), ["7", "1\u{a0}234", "1\u{a0}000\u{a0}000"]);
    }
}
