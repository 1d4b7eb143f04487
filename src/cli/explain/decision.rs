//! Prints the decision about a candidate.

use std::io::{self, Write};

use calm::UpdateEnd;
use monitor::candidate_details::{Coverage, DecisionDetails, UpdateDetails};

use super::grades::block;
use super::{SHOWN, line, shortened_list};
use crate::output::{self, TextTable, decimals};

pub fn write(out: &mut dyn Write, decision: &DecisionDetails, atoms: usize) -> io::Result<()> {
    let DecisionDetails { number, round, kind, mixture_version, .. } = decision;
    let round = if *round == 0 { String::new() } else { format!(", round {round}") };
    let what = match (kind.as_str(), decision.reason.as_deref()) {
        ("control", _) => "control frame: labelled, but does not update the mixture".to_owned(),
        ("declined", Some(reason)) => {
            format!("declined: {} ({})", reason.replace('_', " "), describe(reason))
        }
        (kind, _) => kind.to_owned(),
    };
    line(
        out,
        "decision",
        &format!("number {number}{round}: {what}; mixture version {mixture_version} afterwards"),
    )?;
    if let (Some(factor), Some(threshold)) = (decision.raised_by, decision.raised_threshold) {
        line(out, "", &format!("long label queue: threshold multiplied by {factor:.3}, to {threshold:.3}"))?;
    }
    if let (Some(found), Some(least)) = (decision.completion_probability, decision.min_completion_probability)
    {
        let found = format!(
            "predicted probability that the label completes {found:.3} (at least {least:.3} is accepted)"
        );
        line(out, "", &found)?;
    }
    if let Some(update) = &decision.update {
        write_update(out, update, atoms)?;
    }
    write_coverage(out, decision, &decision.coverage)
}

fn describe(reason: &str) -> &'static str {
    match reason {
        "covered" => "no longer new under the selector's mixture",
        "duplicate" => "the same structure is already known",
        "too_close" => "atoms below a limit of guard.min_distances",
        "budget" => "its seed structure or the campaign has reached its limit",
        "backlog" => "new, but below the raised threshold",
        "unlikely_to_complete" => "its label would probably fail (collect.min_completion_probability)",
        "grade_too_large" => "its grade under the original mixture is above guard.max_grade",
        _ => "",
    }
}

fn write_update(out: &mut dyn Write, update: &UpdateDetails, atoms: usize) -> io::Result<()> {
    let found = &update.found;
    let kind = update.covariance_update.as_deref().unwrap_or_default();
    let (rule, counted) = match update.rule {
        Some(rule) => (rule.condition(atoms), rule.goal(atoms).threshold),
        None => ("rule not recorded".to_owned(), f64::NAN),
    };
    line(out, "update", &format!("{kind}, until {rule}"))?;
    let mut table = TextTable::new(&[">α", ">γ_max reached", &format!(">atoms γ > {counted}")]);
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
        &format!(
            "α = {} applied{inflated}: {}; γ_max {after} afterwards",
            found.alpha,
            describe_end(found.ended_by)
        ),
    )?;
    let components = found.components.iter().zip(&update.component_elements);
    let components = components.map(|((element, component), symbol)| match symbol {
        Some(symbol) => format!("component {component} of {symbol}"),
        // The campaign was started before elements were recorded.
        None => format!("component {component} of element {element} of the model (counted from 0)"),
    });
    line(out, "", &format!("components changed: {}", shortened_list(components)))?;
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

fn describe_end(end: UpdateEnd) -> &'static str {
    match end {
        UpdateEnd::MaximumBelowTarget => "γ_max fell below the target",
        UpdateEnd::Inflated => "no α was sufficient, the inflation was",
        UpdateEnd::InflationExhausted => "neither any α nor the bounded inflation was sufficient",
        UpdateEnd::CountBelowLimit => "the number of atoms above the threshold fell below the limit",
        UpdateEnd::FallbackMaximum => {
            "no α brought the number of atoms above the threshold below the limit; this one brought γ_max below the target"
        }
        UpdateEnd::FallbackLast => "no α was sufficient; the last one was applied",
    }
}

fn write_coverage(out: &mut dyn Write, decision: &DecisionDetails, coverage: &Coverage) -> io::Result<()> {
    if decision.reason.as_deref() == Some("covered") {
        let by = match coverage.by.as_slice() {
            [] => "no update unseen by its walker is near in the log".to_owned(),
            updates => format!(
                "updates unseen by its walker, from {}",
                shortened_list(updates.iter().map(|named| &named.candidate))
            ),
        };
        line(out, "covered by", &by)?;
    }
    if decision.update.is_none() {
        return Ok(());
    }
    let searched =
        coverage.searched_until.map_or(String::new(), |last| format!(" (searched up to decision {last})"));
    if coverage.later.is_empty() {
        let none = "no later candidate of a walker that had not seen this update was declined as covered";
        return line(out, "covered", &format!("{none}{searched}"));
    }
    let count = coverage.later.len();
    line(
        out,
        "covered",
        &format!(
            "{} whose walkers had not seen this update{searched}",
            output::count(count, "later candidate")
        ),
    )?;
    for covered in coverage.later.iter().take(SHOWN) {
        let by = match covered.decided - covered.seen {
            1 => "by this update alone".to_owned(),
            updates => format!("by one or more of {updates} updates"),
        };
        line(out, "", &format!("{} (decision {}), {by}", covered.named.candidate, covered.named.decision))?;
    }
    let more = count.saturating_sub(SHOWN);
    if more > 0 { line(out, "", &format!("… and {more} more (use --json)")) } else { Ok(()) }
}
