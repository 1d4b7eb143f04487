//! Biased walks compared with their controls.

use analysis::ERROR_THRESHOLDS;
use monitor::label_statistics::LARGE_FORCE_ERROR;
use monitor::label_statistics::comparison::{
    ConfidenceEstimate, MIN_UNITS, PairedErrors, PairedQuantity, WalkComparison,
};

use super::{PageTable, TableCell, count, real, text};
use crate::wording::comparison as wording;
use crate::wording::comparison::{intervals, larger, probability};

/// Title of a column of intervals.
const INTERVAL: &str = "95 %";

/// All tables of the comparison. Those without rows are left out later.
pub fn all(comparison: &WalkComparison) -> [PageTable; 8] {
    [
        pairs(comparison),
        tests(&comparison.pairs),
        unpaired(&comparison.pairs),
        groups(comparison),
        group_errors(comparison),
        ranks(comparison),
        areas(comparison),
        elements(comparison),
    ]
}

/// Errors over the pairs.
fn pairs(comparison: &WalkComparison) -> PageTable {
    let caption = format!(
        "Biased against control, matched: medians over pairs of a labelled candidate of a biased walk and the labelled frame of its control \
         walk at the same step. Force MAE, mean absolute error of the force components of a structure; mean |ΔF|, mean of \
         |F_{{model}} − F_{{label}}| over its atoms; energy, |E_{{model}} − E_{{label}}| per atom without the offsets of the elements; stress, \
         root mean square error of six components; {}.",
        intervals(&comparison.pairs.units, comparison)
    );
    let mut table = PageTable::new("pairs", &caption, &["error", "of", "pairs", "median", INTERVAL]);
    for (error, quantity) in wording::known_errors(&comparison.pairs) {
        let PairedQuantity { biased, control, difference_of_medians, median_difference, .. } = quantity;
        for (of, estimate) in [
            ("biased", biased),
            ("control", control),
            ("difference of medians", difference_of_medians),
            ("difference within pairs", median_difference),
        ] {
            let mut row = vec![text(error.name), text(of), count(quantity.pairs)];
            row.extend(cells(estimate, error.factor, error.digits));
            table.rows.push(row);
        }
    }
    table
}

/// Tests of the differences within the pairs.
fn tests(pairs: &PairedErrors) -> PageTable {
    let caption = "Tests of the differences within the pairs, biased − control: two-sided probabilities of Wilcoxon’s signed-rank test and of \
                   the sign test as if pairs were independent, and over one difference for each resampled unit (the median of its pairs), \
                   since pairs of one unit resemble each other.";
    let titles = [
        "error",
        "biased larger in",
        "Wilcoxon p",
        "sign test p",
        "over units: biased larger in",
        "Wilcoxon p",
        "sign test p",
    ];
    let mut table = PageTable::new("pair-tests", caption, &titles);
    for (error, quantity) in wording::known_errors(pairs) {
        let mut row = vec![text(error.name)];
        for tests in [&quantity.tests, &quantity.tests_by_unit] {
            row.push(text(larger(tests)));
            row.extend([tests.wilcoxon_p, tests.sign_p].map(probability_cell));
        }
        table.rows.push(row);
    }
    table
}

/// What is not among the pairs, and what the failures could change.
fn unpaired(pairs: &PairedErrors) -> PageTable {
    let caption = "What is among the pairs of biased candidates and control frames, and what is not. Errors of structures whose labels \
                   failed are unknown: the last rows are the ranges of the medians for any errors of theirs.";
    let mut table = PageTable::new("pair-counts", caption, &["", "value"]);
    let counts = &pairs.counts;
    let rows = [
        ("pairs with both labels", counts.pairs),
        ("seed structures of the pairs", pairs.units.seed_structures as u64),
        ("biased walks of the pairs", pairs.units.walks as u64),
        ("left out: one structure on both sides", counts.same_structure),
        ("left out: the biased label failed", counts.biased_failed),
        ("left out: the control label failed", counts.control_failed),
        ("left out: both labels failed", counts.both_failed),
        ("biased structures without a labelled or failed partner", counts.biased_alone),
        ("control frames without a labelled or failed partner", counts.control_alone),
    ];
    if rows.iter().all(|(_, number)| *number == 0) {
        return table;
    }
    table.rows.extend(rows.map(|(name, number)| vec![text(name), count(number)]));
    for (error, sides) in wording::failure_ranges(pairs) {
        let row = |(side, range): (&str, String)| {
            vec![text(format!("median of the {side} side between: {}", error.name)), text(range)]
        };
        table.rows.extend(sides.into_iter().map(row));
    }
    table
}

fn groups(comparison: &WalkComparison) -> PageTable {
    let caption = format!(
        "Labelled structures of biased and control walks. Matched, those of the pairs; pooled, all, with a partner or without. Failed, \
         structures of the same kind whose labels failed: their errors are unknown. T, mean kinetic temperature of the structures (a strong \
         bias heats). The queue chose {} of all {} structures by value; these are no random sample of what was found. {} label jobs are \
         unfinished.",
        comparison.chosen_by_value, comparison.sampled_structures, comparison.unfinished
    );
    let titles = ["", "structures", "failed", "seed structures", "walks", "T (K)", "V/V_{0}"];
    let mut table = PageTable::new("comparison", &caption, &titles);
    for (name, group) in wording::groups(comparison) {
        table.rows.push(vec![
            text(name),
            count(group.structures),
            count(group.failed),
            count(group.units.seed_structures as u64),
            count(group.units.walks as u64),
            real(group.mean_temperature, 0),
            real(group.mean_relative_volume, 3),
        ]);
    }
    table
}

/// The errors of each group.
fn group_errors(comparison: &WalkComparison) -> PageTable {
    let caption = format!(
        "Median errors of the groups of the table before: over structures as for the pairs, and of |ΔF| = |F_{{model}} − F_{{label}}| over atoms. \
         Last column, the range of the median for any errors of the structures whose labels failed. Pooled: {}.",
        intervals(&comparison.pooled.all.units, comparison)
    );
    let titles = ["", "error", "median", INTERVAL, "with failed labels"];
    let mut table = PageTable::new("comparison-errors", &caption, &titles);
    for (name, group) in wording::groups(comparison) {
        for (error, median) in wording::group_errors(group) {
            let mut row = vec![text(name), text(error.name)];
            row.extend(cells(&median, error.factor, error.digits));
            let between = group.median_force_mae_between.filter(|_| error.key == "force_mae");
            row.push(text(between.map_or(String::new(), |range| wording::median_range(range, 1.0, 3))));
            table.rows.push(row);
        }
        let mut row = vec![text(name), text("|ΔF| of atoms (eV/Å)")];
        row.extend(cells(&group.median_error, 1.0, 3));
        row.push(text(""));
        table.rows.push(row);
    }
    table
}

/// How well both grades rank the errors of each group.
fn ranks(comparison: &WalkComparison) -> PageTable {
    let caption = format!(
        "How well the grades under the original mixture rank the force errors of atoms, in the same groups: Spearman’s ρ, and \
         ROC-AUC for errors above {LARGE_FORCE_ERROR} eV Å^{{−1}}. No interval where fewer than {MIN_UNITS} of the resampled units have such \
         an error."
    );
    let titles = ["", "grade", "sampled atoms", "ρ", INTERVAL, "ROC-AUC", INTERVAL];
    let mut table = PageTable::new("comparison-ranks", &caption, &titles);
    for (name, group) in wording::groups(comparison) {
        for (grade, ranking) in [("γ", &group.gamma), ("γ_nbr", &group.gamma_nbr)] {
            let mut row = vec![text(name), text(grade), count(group.sampled_atoms)];
            row.extend(cells(&ranking.spearman, 1.0, 3));
            row.extend(cells(&ranking.area_above(LARGE_FORCE_ERROR), 1.0, 3));
            table.rows.push(row);
        }
    }
    table
}

/// The ROC-AUC of γ_nbr for every threshold of the force error with large and small errors.
fn areas(comparison: &WalkComparison) -> PageTable {
    let caption = format!(
        "ROC-AUC of γ_{{nbr}} under the original mixture as a test for force errors above a threshold, for each threshold with errors on \
         both sides, in the same groups. No interval where fewer than {MIN_UNITS} of the resampled units have such an \
         error."
    );
    let titles = [
        "threshold (eV Å^{−1})",
        "matched biased",
        INTERVAL,
        "matched control",
        INTERVAL,
        "pooled all",
        INTERVAL,
    ];
    let mut table = PageTable::new("auc-by-threshold", &caption, &titles);
    let groups = [&comparison.matched.biased, &comparison.matched.control, &comparison.pooled.all];
    for (place, threshold) in ERROR_THRESHOLDS.iter().enumerate() {
        let of = groups.map(|group| group.gamma_nbr.roc_auc.get(place).copied().unwrap_or_default());
        if of.iter().any(|area| area.value.is_some()) {
            let areas = of.iter().flat_map(|area| cells(area, 1.0, 3));
            table.rows.push([text(threshold.to_string())].into_iter().chain(areas).collect());
        }
    }
    table
}

/// By element, of matched structures and of all; without rows if there is only one element.
fn elements(comparison: &WalkComparison) -> PageTable {
    let caption = format!(
        "The atoms of each element: median force error, and how well the grades rank it (ROC-AUC for errors above {LARGE_FORCE_ERROR} eV \
         Å^{{−1}}). No interval where fewer than {MIN_UNITS} of the resampled units have the element, or such an error of it."
    );
    let titles = [
        "element",
        "of",
        "sampled atoms",
        "median |ΔF| (eV Å^{−1})",
        INTERVAL,
        "ρ(γ_{nbr})",
        INTERVAL,
        "ROC-AUC(γ_{nbr})",
        INTERVAL,
    ];
    let mut table = PageTable::new("elements", &caption, &titles);
    for (name, of) in wording::elements(comparison) {
        let mut row = vec![text(of.element), text(name), count(of.sampled_atoms)];
        let area = of.gamma_nbr.roc_auc.first().copied().unwrap_or_default();
        for estimate in [of.median_error, of.gamma_nbr.spearman, area] {
            row.extend(cells(&estimate, 1.0, 3));
        }
        table.rows.push(row);
    }
    table
}

/// Value and interval.
fn cells(estimate: &ConfidenceEstimate, factor: f64, digits: usize) -> [TableCell; 2] {
    let interval = estimate.interval.map(|(low, high)| [low, high].map(|x| real(factor * x, digits)));
    let text = |of: fn(&TableCell) -> &String| {
        interval.as_ref().map_or(String::new(), |[low, high]| format!("{} to {}", of(low), of(high)))
    };
    let interval =
        TableCell { shown: text(|cell| &cell.shown), exact: text(|cell| &cell.exact), is_number: true };
    [real(estimate.value.map(|value| factor * value), digits), interval]
}

fn probability_cell(p: Option<f64>) -> TableCell {
    TableCell { shown: probability(p), ..real(p, 3) }
}
