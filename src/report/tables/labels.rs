//! Force errors by grade, failures, and unlabelled structures.

use analysis::ForceErrors;
use monitor::label_statistics::{ErrorsByGrade, LARGE_FORCE_ERROR, LabelStatistics};
use store::{FailureCount, Unlabelled, ValueRange};

use super::{PageTable, TableCell, count, percent, real, text};
use crate::output::range;

/// Correlation of grades and errors.
pub fn correlations(statistics: &LabelStatistics) -> PageTable {
    let caption = format!(
        "Force error |F_{{model}} − F_{{label}}| and the grades under the original mixture, of all labelled structures (biased walks and \
         their controls, with intervals, are in the tables before): mean error, Spearman’s ρ between grade and \
         error, and ROC-AUC of the grade as a test for errors above {LARGE_FORCE_ERROR} eV Å^{{−1}}."
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
    let mut table = PageTable::new("correlations", &caption, &titles);
    let grades = &statistics.all;
    if grades.gamma.atoms() > 0 {
        let mut row = vec![
            text("all"),
            count(grades.structures),
            count(grades.gamma.atoms()),
            real(grades.gamma.mean(), 3),
            percent(grades.gamma.fraction_above(1.0)),
            percent(grades.gamma_nbr.fraction_above(1.0)),
        ];
        row.extend(ranking(grades));
        table.rows.push(row);
    }
    table
}

/// How well γ and γ_nbr rank the errors: ρ of both, ROC-AUC of both, and the number of atoms they are from.
pub fn ranking(grades: &ErrorsByGrade) -> [TableCell; 5] {
    let (gamma, nbr) = (&grades.gamma, &grades.gamma_nbr);
    [
        real(gamma.spearman(), 3),
        real(nbr.spearman(), 3),
        real(gamma.roc_auc(), 3),
        real(nbr.roc_auc(), 3),
        count(gamma.sampled() as u64),
    ]
}

/// The table of quantiles by one of the grades, as in the paper.
pub fn quantiles(name: &'static str, grade: &'static str, errors: &ForceErrors) -> PageTable {
    let caption = format!(
        "Force errors of all labelled atoms (n = {}) by {grade} under the original mixture: percentiles in eV Å^{{−1}}, the share of atoms \
         in each bin, and the share with an error above {LARGE_FORCE_ERROR} eV Å^{{−1}}. Without label: atoms of structures whose labels failed \
         for good. Possible: the range of that share if all of them were below or above.",
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
    let mut table = PageTable::new(name, &caption, &titles);
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

/// Element offsets that are removed from energies before errors are shown.
pub fn energy_offsets(statistics: &LabelStatistics) -> PageTable {
    let offsets = statistics.energies.summary().offsets;
    let caption = format!(
        "Offsets between the energy references of labels and potential: E_{{label}} − E_{{model}} per atom of each element, by least squares \
         over {} labelled structures ({} outliers excluded). Energy errors exclude these offsets. Where the labelled compositions do not \
         determine the offsets separately, only their sums are meaningful.",
        offsets.structures, offsets.left_out
    );
    let mut table = PageTable::new("energy-offsets", &caption, &["element", "offset (eV)", "separate"]);
    for offset in offsets.elements {
        let separate = if offset.separate { "yes" } else { "no" };
        table.rows.push(vec![text(offset.element), real(offset.offset, 4), text(separate)]);
    }
    table
}

/// Failures by class.
pub fn failures(failures: &[FailureCount]) -> PageTable {
    let caption = "Label jobs with a failure, by its class: those labelled later, those that failed for good, and those that are \
                   unfinished.";
    let mut table =
        PageTable::new("failures", caption, &["class", "jobs", "labelled later", "failed", "unfinished"]);
    for FailureCount { class, labelled, failed, unfinished } in failures {
        let all = labelled + failed + unfinished;
        let counts = [all, *labelled, *failed, *unfinished].map(count);
        table.rows.push([&[text(class.replace('_', " "))][..], &counts].concat());
    }
    table
}

/// The part of the collected space without labels because of failures.
pub fn unlabelled(unlabelled: &[Unlabelled]) -> PageTable {
    let caption = "Collected structures without a label because all attempts failed, by seed structure: ranges of the largest γ under the \
                   original mixture (of the version of the potential that this report shows) and of V/V_{0}, compared with those \
                   of labelled structures.";
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
    let mut table = PageTable::new("unlabelled", caption, &titles);
    for part in unlabelled {
        let mut row =
            vec![text(&part.seed_structure), text(&part.formula), count(part.failed), count(part.labelled)];
        row.extend(range_cells(&part.gamma, 2));
        row.extend(range_cells(&part.gamma_labelled, 2));
        row.extend(range_cells(&part.relative_volume, 3));
        row.extend(range_cells(&part.relative_volume_labelled, 3));
        table.rows.push(row);
    }
    table
}

fn range_cells(range: &ValueRange, decimals: usize) -> [TableCell; 2] {
    [range.low, range.high].map(|end| real(end, decimals))
}
