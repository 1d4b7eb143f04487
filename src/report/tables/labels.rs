//! Force errors by grade, failures, and what has no label because of them.

use analysis::ForceErrors;
use store::{FailureCount, Unlabelled, ValueRange};

use super::{Cell, Table, count, percent, real, text};
use crate::learned::{LARGE, Learned};
use crate::output::range;

/// How grades and errors go together.
pub fn correlations(learned: &Learned) -> Table {
    let caption = format!(
        "Force error |F_{{model}} − F_{{label}}| and the grades under the original mixture: mean error, Spearman’s ρ between grade and \
         error, and ROC-AUC of the grade as a test for errors above {LARGE} eV Å^{{−1}}."
    );
    let titles = [
        "",
        "structures",
        "atoms",
        "mean error (eV Å^{−1})",
        "γ > 1 (%)",
        "γ_{nbr} > 1 (%)",
        "ρ(γ)",
        "ρ(γ_{nbr})",
        "ROC-AUC(γ)",
        "ROC-AUC(γ_{nbr})",
        "sampled atoms",
    ];
    let mut table = Table::new("correlations", &caption, &titles);
    for (name, grades) in [("all", &learned.all), ("biased", &learned.biased), ("control", &learned.control)]
    {
        let (gamma, nbr) = (&grades.gamma, &grades.gamma_nbr);
        if gamma.atoms() > 0 {
            table.rows.push(vec![
                text(name),
                count(grades.structures),
                count(gamma.atoms()),
                real(gamma.mean(), 3),
                percent(gamma.share_above(1.0)),
                percent(nbr.share_above(1.0)),
                real(gamma.spearman(), 3),
                real(nbr.spearman(), 3),
                real(gamma.roc_auc(), 3),
                real(nbr.roc_auc(), 3),
                count(gamma.sampled() as u64),
            ]);
        }
    }
    table
}

/// The table of quantiles by one of the grades, as the paper's.
pub fn quantiles(name: &'static str, grade: &'static str, errors: &ForceErrors) -> Table {
    let caption = format!(
        "Force errors of all labelled atoms (n = {}) by {grade} under the original mixture: percentiles in eV Å^{{−1}}, the share of atoms \
         in each bin, and the share with an error above {LARGE} eV Å^{{−1}}. Without label, atoms of structures whose labels finally \
         failed; possible, that share if every one of them were below or above.",
        super::super::style::grouped(errors.atoms())
    );
    let titles = [
        grade,
        "atoms",
        "atoms (%)",
        "median",
        "p90",
        "p99",
        "> 1 eV Å^{−1} (%)",
        "without label",
        "possible from (%)",
        "to (%)",
    ];
    let mut table = Table::new(name, &caption, &titles);
    for bin in errors.bins().iter().filter(|_| errors.atoms() > 0) {
        let (least, most) = bin.large_between.unzip();
        table.rows.push(vec![
            text(range(bin.above, bin.up_to)),
            count(bin.atoms),
            percent(Some(bin.share)),
            real(bin.median, 3),
            real(bin.p90, 3),
            real(bin.p99, 3),
            percent(bin.large),
            count(bin.unlabelled),
            percent(least),
            percent(most),
        ]);
    }
    table
}

/// What was taken out of energies before errors are shown.
pub fn energy_offsets(learned: &Learned) -> Table {
    let offsets = learned.energies.summary().offsets;
    let caption = format!(
        "Labels and the potential have other zeros of energy: E_{{label}} − E_{{model}} of an atom of each element, by least squares over {} \
         labelled structures ({} more are too far from the others). Energy errors are without these offsets. Where elements are not told \
         apart by the labelled compositions, only sums of their offsets count.",
        offsets.structures, offsets.left_out
    );
    let mut table = Table::new("energy-offsets", &caption, &["element", "offset (eV)", "told apart"]);
    for offset in offsets.elements {
        let separate = if offset.separate { "yes" } else { "no" };
        table.rows.push(vec![text(offset.element), real(offset.offset, 4), text(separate)]);
    }
    table
}

/// Failures by class.
pub fn failures(failures: &[FailureCount]) -> Table {
    let caption = "Label jobs that met a failure, by its class: those that have their labels all the same, those that were given up, and \
                   those that are not done.";
    let mut table =
        Table::new("failures", caption, &["class", "jobs", "labelled later", "given up", "unfinished"]);
    for FailureCount { class, labelled, given_up, unfinished } in failures {
        let all = labelled + given_up + unfinished;
        let counts = [all, *labelled, *given_up, *unfinished].map(count);
        table.rows.push([&[text(class.replace('_', " "))][..], &counts].concat());
    }
    table
}

/// What part of the collected space has no label because labels failed.
pub fn unlabelled(unlabelled: &[Unlabelled]) -> Table {
    let caption = "The part of what was collected that has no label because all attempts failed, by seed structure: ranges of the largest \
                   γ under the original mixture and of V/V_{0}, beside those of what is labelled.";
    let titles = [
        "seed structure",
        "formula",
        "failed",
        "labelled",
        "γ_{max} of failed: from",
        "to",
        "of labelled: from",
        "to",
        "V/V_{0} of failed: from",
        "to",
        "of labelled: from",
        "to",
    ];
    let mut table = Table::new("unlabelled", caption, &titles);
    for part in unlabelled {
        let mut row =
            vec![text(&part.seed_structure), text(&part.formula), count(part.failed), count(part.labelled)];
        row.extend(ends(&part.gamma, 2));
        row.extend(ends(&part.gamma_labelled, 2));
        row.extend(ends(&part.relative_volume, 3));
        row.extend(ends(&part.relative_volume_labelled, 3));
        table.rows.push(row);
    }
    table
}

fn ends(range: &ValueRange, decimals: usize) -> [Cell; 2] {
    [range.low, range.high].map(|end| real(end, decimals))
}
