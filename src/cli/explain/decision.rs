//! The decision in words.

use std::io::{self, Write};

use calm::rules::atom_limit;
use calm::{UpdateEnd, UpdateRule};

use super::grades::block;
use super::{SHOWN, first, line};
use crate::candidate_details::{Coverage, DecisionDetails, Update};
use crate::output::{Table, decimals};

pub fn write(out: &mut dyn Write, decision: &DecisionDetails, atoms: usize) -> io::Result<()> {
    let DecisionDetails { number, round, kind, mixture_version, .. } = decision;
    let round = if *round == 0 { String::new() } else { format!(", round {round}") };
    let what = match (kind.as_str(), decision.reason.as_deref()) {
        ("control", _) => "a frame of a control: labelled, and no mixture learns from it".to_owned(),
        ("declined", Some(reason)) => format!("declined: {reason}, {}", why(reason)),
        (kind, _) => kind.to_owned(),
    };
    line(
        out,
        "decision",
        &format!("number {number}{round}: {what}; mixture version {mixture_version} afterwards"),
    )?;
    if let (Some(factor), Some(threshold)) = (decision.raised_by, decision.raised_threshold) {
        line(
            out,
            "",
            &format!("many structures waited for labels: threshold raised by {factor:.3} to {threshold:.3}"),
        )?;
    }
    if let Some(update) = &decision.update {
        write_update(out, update, atoms)?;
    }
    write_coverage(out, decision, &decision.coverage)
}

fn why(reason: &str) -> &'static str {
    match reason {
        "covered" => "the selector's mixture does not find it new any more",
        "duplicate" => "the very same structure was known",
        "guard" => "atoms are too near each other",
        "budget" => "its seed structure or the campaign had as many as it may have",
        "backlog" => "new, but not above the raised threshold",
        _ => "",
    }
}

fn write_update(out: &mut dyn Write, update: &Update, atoms: usize) -> io::Result<()> {
    let found = &update.found;
    let combination = update.combination.as_deref().unwrap_or_default();
    let (rule, counted) = match update.rule {
        Some(UpdateRule::MaximumGrade { target }) => {
            (format!("maximum_grade: γ_max below {}", target.get()), target.get())
        }
        Some(UpdateRule::AtomCount { threshold, fraction, least, target }) => {
            let (limit, threshold) = (atom_limit(atoms, fraction, least), threshold.get());
            let target = target.get();
            (
                format!(
                    "atom_count: fewer than {limit} atoms with γ > {threshold}, else γ_max below {target}"
                ),
                threshold,
            )
        }
        None => ("rule not recorded".to_owned(), f64::NAN),
    };
    line(out, "update", &format!("{combination}, until {rule}"))?;
    let mut table = Table::new(&[">α", ">γ_max reached", &format!(">atoms γ > {counted}")]);
    for trial in &found.trials {
        table.push(vec![
            trial.alpha.to_string(),
            decimals(Some(trial.gamma_max), 3),
            trial.above.to_string(),
        ]);
    }
    block(out, "", &table)?;
    let inflated: Vec<_> = found.inflations.iter().map(|factor| format!("{factor:.3}")).collect();
    let inflated = match inflated.as_slice() {
        [] => String::new(),
        factors => format!(", then scatter × {}", factors.join(", × ")),
    };
    let after = decimals(found.gamma_max_after, 3);
    line(
        out,
        "",
        &format!("α = {} taken{inflated}: {}; γ_max {after} afterwards", found.alpha, end(found.ended_by)),
    )?;
    let components = found.components.iter().zip(&update.component_elements);
    let components = components.map(|((element, component), symbol)| match symbol {
        Some(symbol) => format!("component {component} of {symbol}"),
        // Of a campaign that was begun before elements were recorded.
        None => format!("component {component} of element {element} of the model (counted from 0)"),
    });
    line(out, "", &format!("components changed: {}", first(components)))?;
    let Some(training) = &update.training_frames else { return Ok(()) };
    let alarm = if update.forgetting_alarm == Some(true) { ": ALARM, the mixture forgets them" } else { "" };
    line(
        out,
        "",
        &format!(
            "training frames afterwards: median γ {:.3}, 95 % below {:.3}, {:.1} % above 1{alarm}",
            training.median,
            training.percentile_95,
            100.0 * training.share_above_one
        ),
    )
}

fn end(end: UpdateEnd) -> &'static str {
    match end {
        UpdateEnd::MaximumBelowTarget => "it brought γ_max below the target",
        UpdateEnd::Inflated => "no α sufficed, the inflation did",
        UpdateEnd::InflationExhausted => "no α sufficed, and the bounded inflation did not either",
        UpdateEnd::CountBelowLimit => "it left few enough atoms above",
        UpdateEnd::FallbackMaximum => {
            "no α left few enough atoms above, this one brought γ_max below the target"
        }
        UpdateEnd::FallbackLast => "no α sufficed, the last was taken",
    }
}

fn write_coverage(out: &mut dyn Write, decision: &DecisionDetails, coverage: &Coverage) -> io::Result<()> {
    if decision.reason.as_deref() == Some("covered") {
        let by = match coverage.by.as_slice() {
            [] => "no update that its walker had not seen is near in the log".to_owned(),
            updates => format!(
                "updates that its walker had not seen, by {}",
                first(updates.iter().map(|named| &named.candidate))
            ),
        };
        line(out, "covered by", &by)?;
    }
    if decision.update.is_none() {
        return Ok(());
    }
    let looked = coverage.looked_until.map_or(String::new(), |last| format!(" (as far as decision {last})"));
    if coverage.later.is_empty() {
        let none = "no later candidate was declined as covered whose walker had not seen this update";
        return line(out, "covered", &format!("{none}{looked}"));
    }
    let count = coverage.later.len();
    line(
        out,
        "covered",
        &format!("later candidates declined whose walkers had not seen this update: {count}{looked}"),
    )?;
    for covered in coverage.later.iter().take(SHOWN) {
        let by = match covered.decided - covered.seen {
            1 => "by this update alone".to_owned(),
            updates => format!("by this or others of {updates} updates"),
        };
        line(out, "", &format!("{} (decision {}), {by}", covered.named.candidate, covered.named.decision))?;
    }
    let more = count.saturating_sub(SHOWN);
    if more > 0 { line(out, "", &format!("… and {more} more (--json has all)")) } else { Ok(()) }
}
