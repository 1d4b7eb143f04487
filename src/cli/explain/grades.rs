//! Prints the grades of a candidate: which atoms, under which mixture.

use std::io::{self, Write};

use monitor::candidate_details::{CandidateGrades, GradedAtom, Trigger};

use super::{INDENT, SHOWN, line};
use crate::output::{TextTable, count, decimals};

pub fn write(out: &mut dyn Write, grades: &CandidateGrades) -> io::Result<()> {
    let mut table = TextTable::new(&["mixture", ">version", ">γ_max", ">γ_nbr max", ">atoms γ > 1"]);
    for (name, grade) in
        [("walker's", &grades.walker), ("selector's", &grades.selector), ("original (γ₀)", &grades.original)]
    {
        table.push(vec![
            name.to_owned(),
            grade.mixture_version.to_string(),
            decimals(grade.gamma_max, 3),
            decimals(grade.gamma_nbr_max, 3),
            grade.atoms_above_1.to_string(),
        ]);
    }
    block(out, "grades", &table)?;
    let age = match grades.staleness {
        0 => "the walker's mixture was the newest at the decision".to_owned(),
        age => format!("the selector's mixture was {} newer than the walker's", count(age, "version")),
    };
    line(out, "", &age)?;
    match &grades.trigger {
        Some(trigger) => write_trigger(out, trigger, grades),
        None => Ok(()),
    }
}

fn write_trigger(out: &mut dyn Write, trigger: &Trigger, grades: &CandidateGrades) -> io::Result<()> {
    let Trigger { rule, above_walker, above_selector, .. } = trigger;
    line(out, "trigger", &rule.condition(grades.atoms.len()))?;
    line(
        out,
        "",
        &format!(
            "{} under the walker's mixture, {above_selector} under the selector's",
            count(*above_walker, "atom")
        ),
    )?;
    let triggered = grades.triggered();
    if triggered.is_empty() {
        return Ok(());
    }
    let mut table = TextTable::new(&[
        ">atom",
        "element",
        ">γ walker's",
        ">selector's",
        ">γ₀",
        ">γ_nbr walker's",
        ">selector's",
        ">γ₀_nbr",
    ]);
    triggered.iter().take(SHOWN).for_each(|atom| table.push(row(atom)));
    block(out, "", &table)?;
    let more = triggered.len().saturating_sub(SHOWN);
    if more > 0 { line(out, "", &format!("… and {more} more atoms (use --json)")) } else { Ok(()) }
}

fn row(atom: &GradedAtom) -> Vec<String> {
    let grade = |gamma| decimals(gamma, 3);
    vec![
        atom.atom.to_string(),
        atom.element.to_owned(),
        grade(Some(atom.gamma_walker)),
        grade(atom.gamma_selector),
        grade(atom.gamma_original),
        grade(Some(atom.gamma_nbr_walker)),
        grade(atom.gamma_nbr_selector),
        grade(atom.gamma_nbr_original),
    ]
}

/// A table with a title before its first line.
pub fn block(out: &mut dyn Write, title: &str, table: &TextTable) -> io::Result<()> {
    let mut text = Vec::new();
    table.write(&mut text)?;
    for (k, row) in String::from_utf8_lossy(&text).lines().enumerate() {
        match k {
            0 => line(out, title, row)?,
            _ => writeln!(out, "{INDENT}{row}")?,
        }
    }
    Ok(())
}
