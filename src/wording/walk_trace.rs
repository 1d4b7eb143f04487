//! A point of a walk's trace in words.

use wire::TracePoint;

use crate::output::decimals;

/// The state of the walk and of its bias at a point.
pub fn sentence(point: &TracePoint) -> String {
    let mut parts = vec![format!("{:.0} K", point.temperature)];
    parts.extend(point.pressure.map(|pressure| format!("{pressure:.2} GPa")));
    parts.push(format!("V/V₀ {:.4}", point.relative_volume));
    let original = point.gamma_max_original.map(|gamma| format!(", γ₀_max {gamma:.2}"));
    parts.push(format!("γ_max {}{}", decimals(point.gamma_max, 2), original.unwrap_or_default()));
    if point.bias_scale != 0.0 {
        let share = 100.0 * point.bias_share;
        parts.push(format!("τ_r {:.3} eV, {share:.1} % of the force", point.bias_scale));
    }
    if point.cell_gain != 0.0 {
        parts.push(format!("τ_s {:.3}", point.cell_gain));
    }
    if point.bias_work != 0.0 {
        parts.push(format!("work of the bias so far {:.2} eV", point.bias_work));
    }
    format!("trace at step {}: {}", point.step, parts.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_bias_that_acts_is_named() {
        let mut point =
            TracePoint { step: 150, temperature: 612.4, relative_volume: 1.0, ..TracePoint::default() };
        assert_eq!(sentence(&point), "trace at step 150: 612 K, V/V₀ 1.0000, γ_max –");
        point.pressure = Some(-0.25);
        (point.gamma_max, point.gamma_max_original) = (Some(1.234), Some(2.5));
        (point.bias_scale, point.bias_share, point.bias_work) = (0.5, 0.126, 3.0);
        let expected = "trace at step 150: 612 K, -0.25 GPa, V/V₀ 1.0000, γ_max 1.23, γ₀_max 2.50, τ_r 0.500 eV, 12.6 % of the force, \
                        work of the bias so far 3.00 eV";
        assert_eq!(sentence(&point), expected);
    }
}
