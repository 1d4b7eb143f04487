//! What a training says at its end: tables and JSON.

use std::io::{self, Write};
use std::path::Path;

use ::upfit::{SetErrors, UpfitOutcome};
use serde_json::{Value, json};

use crate::output::{TextTable, count, decimals};

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
