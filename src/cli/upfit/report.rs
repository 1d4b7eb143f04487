//! What a training says at its end: tables and JSON.

use std::io::{self, Write};
use std::path::Path;

use ::upfit::{EnergyDeviations, EnergyZero, SetErrors, UpfitOutcome};
use serde_json::{Value, json};

use crate::output::{TextTable, count, decimals};

/// Says how the zero of the energies was moved, if it was.
pub fn zero_text(zero: &EnergyZero) -> Option<String> {
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

/// Structures named in a warning.
const NAMED: usize = 10;

/// Warns of energies that may have different zeros, if there are any.
pub fn spread_text(spread: &EnergyDeviations) -> Option<String> {
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

/// The outcome as JSON.
pub fn to_json(outcome: &UpfitOutcome, note: &Value, output: &Path) -> Value {
    json!({
        "output": output.display().to_string(),
        "epochs": outcome.history.len(),
        "epoch": outcome.epoch,
        "updates": outcome.updates,
        "ended_early": outcome.ended_early,
        "energy_zero": outcome.zero,
        "energy_spread": outcome.spread,
        "before": outcome.before,
        "after": outcome.after,
        "history": outcome.history,
        "note": note,
    })
}

/// Errors before and after, and what was written.
pub fn write(out: &mut dyn Write, outcome: &UpfitOutcome, output: &Path) -> io::Result<()> {
    let mut table = TextTable::new(&[
        "set",
        "model",
        ">structures",
        ">energy MAE",
        ">RMSE (meV/atom)",
        ">force MAE",
        ">RMSE (meV/Å)",
        ">stress MAE",
        ">RMSE (meV/Å³)",
    ]);
    let mut add = |set: &str, [before, after]: [&SetErrors; 2]| {
        table.push(row(set, "before", before));
        table.push(row("", "after", after));
    };
    add("training", [&outcome.before.training, &outcome.after.training]);
    if let (Some(before), Some(after)) = (&outcome.before.validation, &outcome.after.validation) {
        add("validation", [before, after]);
    }
    table.write(out)?;
    let epochs = count(outcome.history.len() as u64, "epoch");
    let end = if outcome.ended_early { " (ended early)" } else { "" };
    writeln!(out, "{} in {epochs}{end}", count(outcome.updates, "update"))?;
    let chosen = match outcome.epoch {
        0 => "the weights before the first update, which no epoch improved".to_owned(),
        epoch => format!("the weights after epoch {epoch}"),
    };
    writeln!(out, "wrote {} with {chosen}", output.display())?;
    writeln!(
        out,
        "it has no mixture, since the old one does not fit these weights: build one with calmwalk calm build"
    )
}

fn row(set: &str, model: &str, errors: &SetErrors) -> Vec<String> {
    let milli = |x: f64| decimals(Some(1e3 * x), 2);
    let optional = |x: Option<f64>| decimals(x.map(|x| 1e3 * x), 3);
    vec![
        set.to_owned(),
        model.to_owned(),
        errors.structures.to_string(),
        milli(errors.energy_mae),
        milli(errors.energy_rmse),
        milli(errors.force_mae),
        milli(errors.force_rmse),
        optional(errors.stress_mae),
        optional(errors.stress_rmse),
    ]
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
        let text = spread_text(&EnergyDeviations::new(&differences)).unwrap();
        assert!(text.contains("12 structures") && text.contains("a.xyz:0 (-3.000 eV/atom)"), "{text}");
        assert!(text.contains("a.xyz:9 ") && text.ends_with(", and 2 more"), "{text}");
        assert_eq!(spread_text(&EnergyDeviations::new(&differences[20..])), None);
        let wide = spread_text(&EnergyDeviations::new(&differences[..24])).unwrap();
        assert!(wide.contains("expected at most 0.2 eV/atom"), "{wide}");
    }
}
