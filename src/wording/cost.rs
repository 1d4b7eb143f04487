//! Costs of labels, in words.

use monitor::label_cost::{CoreHours, RelabelCost};

use crate::output::count;

/// The expected value with its interval.
pub fn core_hours(hours: &CoreHours) -> String {
    let [expected, low, high] = [hours.expected, hours.low, hours.high].map(two_digits);
    format!("{expected} core-hours (90 % interval: {low} to {high})")
}

/// The expected cost of making labels again, with its source.
pub fn relabel_cost(cost: &RelabelCost) -> String {
    let RelabelCost { hours, measured, protocol } = cost;
    match hours {
        Some(hours) => {
            let measured = count(*measured, "label");
            format!("about {}, estimated from {measured} by '{protocol}'", core_hours(hours))
        }
        None => "unknown: no label has a measured cost".to_owned(),
    }
}

/// Formats with two significant digits, and as a whole number from ten on.
pub fn two_digits(x: f64) -> String {
    if !(x.is_finite() && x > 0.0) {
        return format!("{x}");
    }
    let decimals = (1.0 - x.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{x:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hours_have_two_digits() {
        for (x, text) in [
            (0.0, "0"),
            (0.001_234, "0.0012"),
            (0.5, "0.50"),
            (3.26, "3.3"),
            (42.7, "43"),
            (12_345.6, "12346"),
        ] {
            assert_eq!(two_digits(x), text);
        }
        let hours = CoreHours { expected: 2.0, low: 1.0, high: 5.0 };
        assert_eq!(core_hours(&hours), "2.0 core-hours (90 % interval: 1.0 to 5.0)");
    }
}
