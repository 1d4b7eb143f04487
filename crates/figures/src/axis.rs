//! The axes of a panel.

use crate::ticks::{self, AxisScale, Tick};

/// An axis with its range and ticks.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// The quantity with its unit.
    pub title: String,
    /// The mapping of values to positions.
    pub scale: AxisScale,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    ticks: Vec<Tick>,
}

/// Approximate number of labelled ticks.
const DEFAULT_TICKS: usize = 5;

impl Axis {
    /// An axis with automatic ticks. Replaces an invalid range: not finite, empty, or not positive on a
    /// logarithmic scale.
    pub fn new(title: &str, scale: AxisScale, low: f64, high: f64) -> Self {
        let (low, high) = range(scale, low, high);
        let ticks = ticks::choose(scale, low, high, DEFAULT_TICKS);
        Self { title: title.into(), scale, low, high, ticks }
    }

    /// A categorical axis: the first category is centred at ½, the next at 1½, and so on.
    pub fn categorical(title: &str, names: &[String]) -> Self {
        let tick = |(k, name): (usize, &String)| Tick { position: k as f64 + 0.5, label: name.clone() };
        let ticks = names.iter().enumerate().map(tick).collect();
        let high = names.len().max(1) as f64;
        Self { title: title.into(), scale: AxisScale::Linear, low: 0.0, high, ticks }
    }

    /// An axis of equally wide bins with labels at these positions; 1 is the end of the first bin.
    pub fn binned(title: &str, bins: usize, words: impl IntoIterator<Item = (f64, String)>) -> Self {
        let ticks = words.into_iter().map(|(position, label)| Tick { position, label }).collect();
        let high = bins.max(1) as f64;
        Self { title: title.into(), scale: AxisScale::Linear, low: 0.0, high, ticks }
    }

    /// Sets the approximate number of ticks.
    pub fn with_ticks(mut self, number: usize) -> Self {
        self.ticks = ticks::choose(self.scale, self.low, self.high, number);
        self
    }

    /// Sets the title.
    pub fn with_title(mut self, title: &str) -> Self {
        title.clone_into(&mut self.title);
        self
    }

    /// Removes the ticks.
    pub fn without_ticks(mut self) -> Self {
        self.ticks.clear();
        self
    }

    /// Relative position of a value: 0 at the start, 1 at the end. Values without a position are far before the
    /// start.
    pub fn position(&self, value: f64) -> f64 {
        let of = |x: f64| if self.scale == AxisScale::Linear { x } else { x.ln() };
        let position = (of(value) - of(self.low)) / (of(self.high) - of(self.low));
        if position.is_nan() { -MAX_POSITION } else { position.clamp(-MAX_POSITION, MAX_POSITION) }
    }

    /// The ticks.
    pub(crate) fn ticks(&self) -> &[Tick] {
        &self.ticks
    }
}

/// Positions are clamped to this many axis lengths.
const MAX_POSITION: f64 = 10.0;

fn range(scale: AxisScale, low: f64, high: f64) -> (f64, f64) {
    let is_usable = |x: f64| x.is_finite() && (scale == AxisScale::Linear || x > 0.0);
    match (is_usable(low), is_usable(high)) {
        (true, true) if low < high => (low, high),
        (true, true) if low == high && scale == AxisScale::Logarithmic => (low / 2.0, low * 2.0),
        // A single value at zero has no scale; assume positive values, because quantities are rarely negative.
        (true, true) if low == 0.0 && high == 0.0 => (0.0, 1.0),
        (true, true) if low == high => (low - 0.1 * low.abs(), low + 0.1 * low.abs()),
        _ if scale == AxisScale::Logarithmic => (0.1, 10.0),
        _ => (0.0, 1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_shares_of_the_axis() {
        let axis = Axis::new("x", AxisScale::Linear, -1.0, 3.0);
        assert_eq!([-1.0, 0.0, 3.0, 5.0].map(|x| axis.position(x)), [0.0, 0.25, 1.0, 1.5]);
        let axis = Axis::new("x", AxisScale::Logarithmic, 0.01, 100.0);
        assert!((axis.position(1.0) - 0.5).abs() < 1e-12 && (axis.position(0.1) - 0.25).abs() < 1e-12);
        assert_eq!(
            [0.0, -1.0, f64::NAN, f64::INFINITY].map(|x| axis.position(x)),
            [-MAX_POSITION, -MAX_POSITION, -MAX_POSITION, MAX_POSITION]
        );
    }

    #[test]
    fn a_single_value_has_its_own_sign_on_its_axis() {
        for (value, low, high) in
            [(0.0, 0.0, 1.0), (2.0, 1.8, 2.2), (-2.0, -2.2, -1.8), (1e-6, 0.9e-6, 1.1e-6)]
        {
            let axis = Axis::new("x", AxisScale::Linear, value, value);
            assert!((axis.low - low).abs() < 1e-12 && (axis.high - high).abs() < 1e-12, "{axis:?}");
        }
    }

    #[test]
    fn no_range_becomes_one() {
        for (scale, low, high) in [
            (AxisScale::Linear, f64::NAN, 1.0),
            (AxisScale::Linear, 2.0, 2.0),
            (AxisScale::Logarithmic, 0.0, 1.0),
            (AxisScale::Logarithmic, 3.0, 3.0),
            (AxisScale::Linear, 2.0, 1.0),
        ] {
            let axis = Axis::new("x", scale, low, high);
            assert!(axis.low < axis.high && !axis.ticks().is_empty(), "{axis:?}");
        }
    }
}
