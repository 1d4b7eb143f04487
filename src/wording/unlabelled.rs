//! Describes the collected structures whose labels failed for good.

use store::{Unlabelled, ValueRange};

use crate::output::{TextTable, count};

/// A line with a title of `width` characters, then one line for each seed structure and formula, at most `most`.
/// Empty if no label failed.
pub fn describe(unlabelled: &[Unlabelled], width: usize, most: usize) -> String {
    if unlabelled.is_empty() {
        return String::new();
    }
    let failed: u64 = unlabelled.iter().map(|part| part.failed).sum();
    let mut table = TextTable::new(&[
        "  seed structure",
        "formula",
        ">failed",
        ">of",
        "γ₀_max of failed",
        "of labelled",
        "V/V₀ of failed",
        "of labelled",
    ]);
    unlabelled.iter().take(most).for_each(|part| table.push(line(part)));
    let mut text = Vec::new();
    // Writing to memory cannot fail.
    let _ = table.write(&mut text);
    let table = String::from_utf8_lossy(&text).into_owned();
    let more = match unlabelled.len().saturating_sub(most) {
        0 => String::new(),
        more => format!("  … and {more} more: calmwalk status --all shows them\n"),
    };
    let title = "unlabelled";
    format!(
        "{title:<width$}the labels of {} failed, which leaves these ranges without labels:\n{table}{more}",
        count(failed, "structure")
    )
}

fn line(part: &Unlabelled) -> Vec<String> {
    vec![
        format!("  {}", part.seed_structure),
        part.formula.clone(),
        part.failed.to_string(),
        (part.failed + part.labelled).to_string(),
        range(&part.gamma, 2),
        range(&part.gamma_labelled, 2),
        range(&part.relative_volume, 3),
        range(&part.relative_volume_labelled, 3),
    ]
}

fn range(range: &ValueRange, decimals: usize) -> String {
    match (range.low, range.high) {
        (Some(low), Some(high)) if low < high => format!("{low:.decimals$} to {high:.decimals$}"),
        (Some(only), _) => format!("{only:.decimals$}"),
        _ => "–".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failed_ranges_are_compared_with_labelled_ones() {
        let range = |low, high| ValueRange { low: Some(low), high: Some(high) };
        let part = Unlabelled {
            seed_structure: "fcc".into(),
            formula: "Al32".into(),
            failed: 2,
            labelled: 7,
            gamma: range(3.0, 4.0),
            gamma_labelled: range(1.5, 2.25),
            relative_volume: range(1.4, 1.4),
            relative_volume_labelled: ValueRange::default(),
        };
        let text = describe(&[part.clone(), part], 12, 1);
        let lines: Vec<_> = text.lines().collect();
        assert!(lines[0].starts_with("unlabelled  the labels of 4 structures failed"), "{text}");
        let cells: Vec<_> = lines[2].split("  ").map(str::trim).filter(|cell| !cell.is_empty()).collect();
        assert_eq!(cells, ["fcc", "Al32", "2", "9", "3.00 to 4.00", "1.50 to 2.25", "1.400", "–"]);
        assert!(lines[3].contains("1 more") && lines.len() == 4, "{text}");
        assert_eq!(describe(&[], 12, 8), "");
    }
}
