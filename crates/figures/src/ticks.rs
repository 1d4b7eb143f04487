//! Positions and labels of ticks.

/// The mapping of values to positions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AxisScale {
    /// Linear.
    Linear,
    /// Logarithmic.
    Logarithmic,
}

/// A tick; minor ticks have no label.
#[derive(Clone, Debug, PartialEq)]
pub struct Tick {
    /// Position in data coordinates.
    pub position: f64,
    /// Label, empty for a minor tick.
    pub label: String,
}

/// Ticks of an axis from `low` to `high`, about `number` of them labelled.
pub fn choose(scale: AxisScale, low: f64, high: f64, number: usize) -> Vec<Tick> {
    match scale {
        AxisScale::Linear => linear(low, high, number),
        AxisScale::Logarithmic => logarithmic(low, high, number),
    }
}

/// Ticks at multiples of 1, 2 or 5 times a power of ten.
fn linear(low: f64, high: f64, number: usize) -> Vec<Tick> {
    let step = step((high - low) / number.max(1) as f64);
    let decimals = (-step.log10().floor()).max(0.0) as usize;
    // A step such as 2.5 would need one more decimal; the steps of `step` do not.
    let (first, last) = ((low / step - 1e-9).ceil() as i64, (high / step + 1e-9).floor() as i64);
    let tick = |k: i64| {
        let position = k as f64 * step;
        Tick { position, label: minus(format!("{position:.decimals$}")) }
    };
    (first..=last).map(tick).collect()
}

/// The smallest of 1, 2, 5 times a power of ten that is at least `least`.
fn step(least: f64) -> f64 {
    let power = 10_f64.powf(least.log10().floor());
    let of = |factor: f64| factor * power;
    [1.0, 2.0, 5.0, 10.0]
        .map(of)
        .into_iter()
        .find(|step| *step >= least * (1.0 - 1e-9))
        .unwrap_or(10.0 * power)
}

/// Major ticks at powers of ten, minor ticks between them. Below two decades 2 and 5 are labelled too, below
/// one also 3 and 7.
fn logarithmic(low: f64, high: f64, number: usize) -> Vec<Tick> {
    let (first, last) = (low.log10().floor() as i32, high.log10().ceil() as i32);
    let decades = (high / low).log10();
    let every = (decades / number.max(1) as f64).ceil().max(1.0) as i32;
    let mut ticks = Vec::new();
    for power in first..=last {
        for digit in 1..10 {
            let position = f64::from(digit) * 10_f64.powi(power);
            let is_inside = position >= low * (1.0 - 1e-9) && position <= high * (1.0 + 1e-9);
            let has_label = match digit {
                1 => power.rem_euclid(every) == 0,
                2 | 5 => decades < 2.0,
                3 | 7 => decades < 0.95,
                _ => false,
            };
            if is_inside && (every == 1 || digit == 1) {
                ticks.push(Tick {
                    position,
                    label: if has_label { power_of_ten(digit, power) } else { String::new() },
                });
            }
        }
    }
    ticks
}

/// 0.001 to 1000 in decimal notation, others as powers.
fn power_of_ten(digit: i32, power: i32) -> String {
    match power {
        -3..=-1 => format!("{:.*}", power.unsigned_abs() as usize, f64::from(digit) * 10_f64.powi(power)),
        0..=3 => format!("{}", digit * 10_i32.pow(power.unsigned_abs())),
        _ if digit == 1 => format!("10^{{{}}}", minus(power.to_string())),
        _ => format!("{digit}·10^{{{}}}", minus(power.to_string())),
    }
}

/// Replaces the hyphen with a minus sign, which is as wide as a digit.
fn minus(number: String) -> String {
    number.replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn label(ticks: &[Tick]) -> Vec<&str> {
        ticks.iter().map(|tick| tick.label.as_str()).filter(|label| !label.is_empty()).collect()
    }

    #[test]
    fn steps_are_one_two_or_five() {
        assert_eq!(label(&linear(0.0, 1.0, 5)), ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        assert_eq!(label(&linear(0.93, 1.42, 5)), ["1.0", "1.1", "1.2", "1.3", "1.4"]);
        assert_eq!(label(&linear(-3.0, 12.0, 4)), ["0", "5", "10"]);
        assert_eq!(label(&linear(-0.12, 0.1, 3)), ["−0.1", "0.0", "0.1"]);
        assert_eq!(label(&linear(0.0, 23_000.0, 3)), ["0", "10000", "20000"]);
    }

    #[test]
    fn decades_have_small_ticks_between_them() {
        let ticks = logarithmic(0.01, 10.0, 6);
        assert_eq!(label(&ticks), ["0.01", "0.1", "1", "10"]);
        assert_eq!(ticks.len(), 28);
        assert_eq!(label(&logarithmic(0.3, 3.0, 5)), ["0.5", "1", "2"]);
        assert_eq!(label(&logarithmic(18.0, 75.0, 5)), ["20", "30", "50", "70"]);
        assert_eq!(label(&logarithmic(1e-6, 1e6, 4)), ["10^{−6}", "0.001", "1", "1000", "10^{6}"]);
    }
}
