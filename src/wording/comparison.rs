//! The comparison of biased walks with their controls, in words.

use atoms::units::GPA_PER_EV_A3;
use monitor::label_statistics::comparison::{
    ComparedGroup, ConfidenceEstimate, ElementRanking, MIN_UNITS, PairCounts, PairedErrors, PairedQuantity,
    PairedTests, ResampledUnit, ResamplingUnits, WalkComparison,
};
use serde::Serialize;
use serde_json::{Value, json};

use crate::output::{count, decimals};

/// What the numbers of a comparison are of: the pairs, the intervals, samples. Sentences without a full stop.
pub fn notes(comparison: &WalkComparison) -> Vec<String> {
    let mut notes = vec![pairs(&comparison.pairs)];
    notes.extend(left_out(&comparison.pairs.counts));
    let has_pairs = comparison.pairs.counts.pairs > 0;
    let matched = intervals(&comparison.pairs.units, comparison);
    let pooled = intervals(&comparison.pooled.all.units, comparison);
    match has_pairs {
        true if matched == pooled => notes.push(matched),
        true => notes.extend([format!("matched: {matched}"), format!("pooled: {pooled}")]),
        false => notes.push(pooled),
    }
    if has_pairs {
        notes.extend(by_unit(&comparison.pairs));
    }
    if comparison.pooled.all.units.resampled.is_some() {
        notes.push(format!(
            "no interval where fewer than {MIN_UNITS} of the units that the bootstrap draws have the element, or an error above the threshold"
        ));
    }
    notes.extend(sampled(comparison));
    notes.extend(chosen(comparison));
    notes
}

/// The pairs, or why there are none.
pub fn pairs(pairs: &PairedErrors) -> String {
    if pairs.counts.pairs == 0 {
        return "no pairs: no labelled candidate of a biased walk has a labelled control frame at its step"
            .into();
    }
    let ResamplingUnits { seed_structures, walks, .. } = pairs.units;
    format!(
        "{} of {} and {}",
        count(pairs.counts.pairs, "pair"),
        count(seed_structures as u64, "seed structure"),
        count(walks as u64, "biased walk")
    )
}

/// What is not among the pairs.
fn left_out(counts: &PairCounts) -> Option<String> {
    let PairCounts {
        same_structure,
        biased_failed,
        control_failed,
        both_failed,
        biased_alone,
        control_alone,
        ..
    } = *counts;
    let parts = [
        (same_structure, "of one structure"),
        (biased_failed, "whose biased label failed"),
        (control_failed, "whose control label failed"),
        (both_failed, "whose labels both failed"),
    ];
    let mut parts: Vec<_> = parts
        .into_iter()
        .filter(|(number, _)| *number > 0)
        .map(|(number, why)| format!("{} {why}", count(number, "pair")))
        .collect();
    if biased_alone + control_alone > 0 {
        let (biased, control) =
            (count(biased_alone, "biased structure"), count(control_alone, "control frame"));
        parts.push(format!("{biased} and {control} without a labelled or failed partner"));
    }
    (!parts.is_empty()).then(|| format!("not among the pairs: {}", parts.join(", ")))
}

/// How the intervals of a group came about, or why there are none.
pub fn intervals(units: &ResamplingUnits, comparison: &WalkComparison) -> String {
    let ResamplingUnits { resampled, seed_structures, walks } = *units;
    let (seeds, walks) =
        (count(seed_structures as u64, "seed structure"), count(walks as u64, "biased walk"));
    let level = 100.0 * comparison.level;
    match resampled {
        Some(ResampledUnit::SeedStructures) => {
            format!("{level} % intervals by bootstrap over {seeds} ({} draws)", comparison.draws)
        }
        Some(ResampledUnit::Walks) => format!(
            "{level} % intervals by bootstrap over {walks}, each with its control ({} draws), since {seeds} are too few (at least \
             {MIN_UNITS}); walks from one seed structure resemble each other, so the intervals may be too narrow",
            comparison.draws
        ),
        None => format!(
            "no intervals: {seeds} and {walks} are too few for a bootstrap (at least {MIN_UNITS} of either)"
        ),
    }
}

/// The tests with one difference for each unit. `None` without resampled units.
fn by_unit(pairs: &PairedErrors) -> Option<String> {
    let unit = match pairs.units.resampled? {
        ResampledUnit::SeedStructures => "seed structure",
        ResampledUnit::Walks => "biased walk",
    };
    let tests = &pairs.force_mae.tests_by_unit;
    Some(format!(
        "force MAE with one difference for each {unit}, since its pairs are not independent: larger on the biased side in {} of {}, \
         Wilcoxon p {}, sign test p {}",
        tests.biased_larger,
        tests.biased_larger + tests.control_larger,
        probability(tests.wilcoxon_p),
        probability(tests.sign_p)
    ))
}

/// The samples of a very large campaign.
fn sampled(comparison: &WalkComparison) -> Option<String> {
    let WalkComparison { structures, sampled_structures, atoms, sampled_atoms, .. } = comparison;
    (sampled_structures < structures || sampled_atoms < atoms).then(|| {
        format!(
            "the comparison is of samples: {sampled_structures} of {structures} structures, {sampled_atoms} of {atoms} atoms"
        )
    })
}

/// What labels are missing, and that those by value were chosen.
fn chosen(comparison: &WalkComparison) -> Vec<String> {
    let WalkComparison { sampled_structures, chosen_by_value, unfinished, .. } = comparison;
    let mut notes = Vec::new();
    if *chosen_by_value > 0 {
        notes.push(format!(
            "the queue chose {chosen_by_value} of {sampled_structures} structures by value, which prefers large expected errors: medians, ρ and \
             ROC-AUC are of what was labelled, not of what was found"
        ));
    }
    if *unfinished > 0 {
        notes.push(format!("{} unfinished", count(*unfinished, "label job")));
    }
    notes
}

/// An error as views show it.
#[derive(Clone, Copy, Serialize)]
pub struct ShownError {
    /// Its name and unit.
    pub name: &'static str,
    /// Its key in the JSON of the pairs.
    pub key: &'static str,
    /// The key of its median in the JSON of a group, if that has it.
    pub group_key: Option<&'static str>,
    /// Factor to its unit.
    pub factor: f64,
    /// Number of decimals.
    pub digits: usize,
    #[serde(skip)]
    of: fn(&PairedErrors) -> &PairedQuantity,
    #[serde(skip)]
    of_group: fn(&ComparedGroup) -> Option<&ConfidenceEstimate>,
}

/// A group of structures as views show it.
#[derive(Clone, Copy, Serialize)]
pub struct ShownGroup {
    /// Its name.
    pub name: &'static str,
    /// Its keys in the JSON of the comparison.
    pub place: [&'static str; 2],
    /// Whether views show its elements.
    pub by_element: bool,
    #[serde(skip)]
    of: fn(&WalkComparison) -> &ComparedGroup,
}

/// All errors, in the order in which they are shown.
const ERRORS: [ShownError; 4] = [
    ShownError {
        name: "force MAE (eV/Å)",
        key: "force_mae",
        group_key: Some("median_force_mae"),
        factor: 1.0,
        digits: 3,
        of: |pairs| &pairs.force_mae,
        of_group: |group| Some(&group.median_force_mae),
    },
    ShownError {
        name: "mean |ΔF| (eV/Å)",
        key: "mean_force_error",
        group_key: None,
        factor: 1.0,
        digits: 3,
        of: |pairs| &pairs.mean_force_error,
        of_group: |_| None,
    },
    ShownError {
        name: "energy error (meV/atom)",
        key: "energy",
        group_key: Some("median_energy"),
        factor: 1000.0,
        digits: 1,
        of: |pairs| &pairs.energy,
        of_group: |group| Some(&group.median_energy),
    },
    ShownError {
        name: "stress error (GPa)",
        key: "stress",
        group_key: Some("median_stress"),
        factor: GPA_PER_EV_A3,
        digits: 3,
        of: |pairs| &pairs.stress,
        of_group: |group| Some(&group.median_stress),
    },
];

/// All groups: matched, then pooled.
const GROUPS: [ShownGroup; 5] = [
    ShownGroup {
        name: "matched biased",
        place: ["matched", "biased"],
        by_element: true,
        of: |all| &all.matched.biased,
    },
    ShownGroup {
        name: "matched control",
        place: ["matched", "control"],
        by_element: true,
        of: |all| &all.matched.control,
    },
    ShownGroup { name: "pooled all", place: ["pooled", "all"], by_element: true, of: |all| &all.pooled.all },
    ShownGroup {
        name: "pooled biased",
        place: ["pooled", "biased"],
        by_element: false,
        of: |all| &all.pooled.biased,
    },
    ShownGroup {
        name: "pooled control",
        place: ["pooled", "control"],
        by_element: false,
        of: |all| &all.pooled.control,
    },
];

/// What views show of the JSON of a comparison: errors of `pairs` if there are pairs with them, groups if they have structures.
pub fn shown() -> Value {
    json!({ "errors": ERRORS, "groups": GROUPS })
}

/// The errors that are known of any pairs.
pub fn known_errors(pairs: &PairedErrors) -> Vec<(ShownError, &PairedQuantity)> {
    let all = ERRORS.into_iter().map(|error| (error, (error.of)(pairs)));
    all.filter(|(_, quantity)| quantity.pairs > 0).collect()
}

/// For each error of pairs with failed labels: what the errors of those could make of the medians of either side.
pub fn failure_ranges(pairs: &PairedErrors) -> Vec<(ShownError, Vec<(&'static str, String)>)> {
    let ranges = |(error, quantity): (ShownError, &PairedQuantity)| {
        let sides = [("biased", quantity.biased_between), ("control", quantity.control_between)].into_iter();
        let shown =
            sides.filter_map(|(side, range)| Some((side, median_range(range?, error.factor, error.digits))));
        (error, shown.collect::<Vec<_>>())
    };
    known_errors(pairs).into_iter().map(ranges).filter(|(_, sides)| !sides.is_empty()).collect()
}

/// The medians over the structures of a group of each error that is known of any.
pub fn group_errors(group: &ComparedGroup) -> Vec<(ShownError, ConfidenceEstimate)> {
    let all = ERRORS.into_iter().filter_map(|error| Some((error, *(error.of_group)(group)?)));
    all.filter(|(_, median)| median.value.is_some()).collect()
}

/// The groups with structures by name.
pub fn groups(comparison: &WalkComparison) -> Vec<(&'static str, &ComparedGroup)> {
    shown_groups(comparison).map(|(shown, group)| (shown.name, group)).collect()
}

fn shown_groups(comparison: &WalkComparison) -> impl Iterator<Item = (ShownGroup, &ComparedGroup)> {
    let all = GROUPS.into_iter().map(|shown| (shown, (shown.of)(comparison)));
    all.filter(|(_, group)| group.structures > 0)
}

/// The elements of matched structures and of all, with the name of their group; none if all groups have one element.
pub fn elements(comparison: &WalkComparison) -> Vec<(&'static str, &ElementRanking)> {
    let groups = shown_groups(comparison).filter(|(shown, _)| shown.by_element);
    let groups: Vec<_> = groups.map(|(shown, group)| (shown.name, group)).collect();
    if groups.iter().all(|(_, group)| group.elements.len() < 2) {
        return Vec::new();
    }
    let mut all: Vec<_> = groups
        .into_iter()
        .flat_map(|(name, group)| group.elements.iter().map(move |of| (name, of)))
        .collect();
    // Stable: the groups of an element stay in order.
    all.sort_by_key(|(_, of)| of.element);
    all
}

/// The numbers of pairs in which either side is larger, `60 of 71`.
pub fn larger(tests: &PairedTests) -> String {
    format!("{} of {}", tests.biased_larger, tests.biased_larger + tests.control_larger)
}

/// A probability, with two digits where it is small.
pub fn probability(p: Option<f64>) -> String {
    match p {
        Some(p) if p < 1e-3 => format!("{p:.1e}"),
        p => decimals(p, 3),
    }
}

/// The range of a median whatever the errors of failed labels are, times a factor: `0.610 to 0.720`, or without an upper end
/// `at least 0.610`.
pub fn median_range((low, high): (f64, Option<f64>), factor: f64, places: usize) -> String {
    let low = factor * low;
    match high {
        Some(high) => format!("{low:.places$} to {:.places$}", factor * high),
        None => format!("at least {low:.places$}"),
    }
}

/// An estimate with its interval, times a factor: `0.680 (0.610 to 0.720)`.
pub fn estimate(estimate: &ConfidenceEstimate, factor: f64, places: usize) -> String {
    let value = decimals(estimate.value.map(|x| factor * x), places);
    match estimate.interval {
        Some((low, high)) => format!("{value} ({:.places$} to {:.places$})", factor * low, factor * high),
        None => value,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_digits_that_matter() {
        let found = ConfidenceEstimate { value: Some(0.68), interval: Some((0.61, 0.7249)) };
        assert_eq!(estimate(&found, 1.0, 3), "0.680 (0.610 to 0.725)");
        assert_eq!(estimate(&ConfidenceEstimate::default(), 1.0, 3), "–");
        assert_eq!(["2.6e-9", "0.039", "–"], [Some(2.6e-9), Some(0.039), None].map(probability));
        assert_eq!(median_range((0.6, None), 10.0, 2), "at least 6.00");
        assert_eq!(median_range((0.6, Some(0.7)), 1.0, 1), "0.6 to 0.7");
    }

    #[test]
    fn what_is_missing_is_said() {
        assert_eq!(left_out(&PairCounts { pairs: 9, ..PairCounts::default() }), None);
        let counts =
            PairCounts { same_structure: 2, control_failed: 1, biased_alone: 1, ..PairCounts::default() };
        let expected = "not among the pairs: 2 pairs of one structure, 1 pair whose control label failed, 1 biased structure and \
                        0 control frames without a labelled or failed partner";
        assert_eq!(left_out(&counts).as_deref(), Some(expected));
    }
}
