//! Costs of labels, in words.

use monitor::label_cost::{CoreHours, RelabelCost, SECONDS_PER_HOUR};

use crate::campaign::WalkTime;
use crate::output::count;

/// The expected value with its interval.
pub fn core_hours(hours: &CoreHours) -> String {
    let (unit, factor) = core_unit(hours.expected);
    let [expected, low, high] = [hours.expected, hours.low, hours.high].map(|x| two_digits(factor * x));
    format!("{expected} {unit} (90 % interval: {low} to {high})")
}

/// A cost in core-hours, below one in core-seconds.
pub fn core_time(hours: f64) -> String {
    let (unit, factor) = core_unit(hours);
    format!("{} {unit}", two_digits(factor * hours))
}

fn core_unit(hours: f64) -> (&'static str, f64) {
    if hours < 1.0 { ("core-seconds", SECONDS_PER_HOUR) } else { ("core-hours", 1.0) }
}

/// The time of all walks.
pub fn walks(time: WalkTime) -> String {
    let [biased, control] = [time.biased, time.control].map(wall_time);
    let controls = match time.control > 0.0 {
        true => format!(", and at most {control} for their control walks"),
        false => String::new(),
    };
    format!("about {biased} of one walker for all biased walks{controls} (from steps measured on this host)")
}

/// A time in s, min or h, with two significant digits.
pub fn wall_time(seconds: f64) -> String {
    match seconds {
        ..60.0 => format!("{} s", two_digits(seconds)),
        60.0..3600.0 => format!("{} min", two_digits(seconds / 60.0)),
        _ => format!("{} h", two_digits(seconds / 3600.0)),
    }
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
    fn times_have_a_unit() {
        for (seconds, text) in [
            (0.0, "0 s"),
            (0.25, "0.25 s"),
            (59.0, "59 s"),
            (90.0, "1.5 min"),
            (3600.0, "1.0 h"),
            (7.2e5, "200 h"),
        ] {
            assert_eq!(wall_time(seconds), text);
        }
    }

    #[test]
    fn small_costs_are_in_core_seconds() {
        let texts = [0.0, 2.8e-5, 0.5, 1.0, 1234.0].map(core_time);
        assert_eq!(
            texts,
            ["0 core-seconds", "0.10 core-seconds", "1800 core-seconds", "1.0 core-hours", "1234 core-hours"]
        );
    }

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
