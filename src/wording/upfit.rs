//! A training, in words.

use std::time::Duration;

use ::upfit::{EnergyDeviations, EnergyZero};

use crate::output::count;

/// Structures named in a warning.
const NAMED: usize = 10;

/// Says how the zero of the energies was moved, if it was.
pub fn zero(zero: &EnergyZero) -> Option<String> {
    if zero.shifts.is_empty() {
        return None;
    }
    let shifts = zero.shifts.iter().map(|shift| format!("{} {:+.4}", shift.element, shift.shift));
    let reason = if zero.is_constant {
        ", the same for each element: compositions do not tell them apart"
    } else {
        ""
    };
    Some(format!(
        "the labels' energies have another zero than the model's; shifts added to it, eV/atom: {}{reason}",
        shifts.collect::<Vec<_>>().join(", ")
    ))
}

/// Warns of energies that may have different zeros, if there are any.
pub fn spread(spread: &EnergyDeviations) -> Option<String> {
    if spread.is_wide() {
        return Some(format!(
            "the labels' energies vary around the model's by {:.3} eV/atom (1.4826 times the median absolute deviation), expected at \
             most 0.2 eV/atom: labels with different zeros may be mixed",
            spread.deviation
        ));
    }
    if spread.far.is_empty() {
        return None;
    }
    let named = spread.far.iter().take(NAMED);
    let named: Vec<_> = named.map(|far| format!("{} ({:+.3} eV/atom)", far.place, far.difference)).collect();
    let more = match spread.far.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!(", and {more} more"),
    };
    Some(format!(
        "the energies of {} are far from the others', as labels with another zero are: {}{more}",
        count(spread.far.len() as u64, "structure"),
        named.join(", ")
    ))
}

/// The expected time to the end; empty if it is not known.
pub fn time_left(seconds: Option<f64>) -> String {
    let left = seconds.map(|seconds| Duration::from_secs_f64(seconds.clamp(0.0, 1e10)));
    left.map(|left| format!(", {} left", indicatif::HumanDuration(left))).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn structures_with_another_zero_are_named() {
        let places: Vec<_> = (0..60).map(|line| format!("a.xyz:{line}")).collect();
        let difference = |line: usize| if line < 12 { -3.0 } else { 0.0 };
        let differences: Vec<_> =
            places.iter().enumerate().map(|(line, place)| (place.as_str(), difference(line))).collect();
        let text = spread(&EnergyDeviations::new(&differences)).unwrap();
        assert!(text.contains("12 structures") && text.contains("a.xyz:0 (-3.000 eV/atom)"), "{text}");
        assert!(text.contains("a.xyz:9 ") && text.ends_with(", and 2 more"), "{text}");
        assert_eq!(spread(&EnergyDeviations::new(&differences[20..])), None);
        let wide = spread(&EnergyDeviations::new(&differences[..24])).unwrap();
        assert!(wide.contains("expected at most 0.2 eV/atom"), "{wide}");
    }
}
