//! Tables of errors and scores by element and by composition.

use super::report::{ErrorSpread, LabelledReport};
use super::score_name::name;
use crate::page::{PageTable, count, percent, real, text};

/// By element and score; without rows if there is only one element.
pub fn elements(report: &LabelledReport) -> PageTable {
    let caption = "Force errors (eV/Å) and scores of the sampled atoms of each element: mean of the score, share of the atoms beyond its limit, \
                   and Spearman’s ρ of score and force error";
    let titles = [
        "element",
        "sampled atoms",
        "mean error",
        "median error",
        "score",
        "mean score",
        "beyond the limit (%)",
        "ρ",
    ];
    let mut table = PageTable::new("element-errors", caption, &titles);
    if report.elements.len() < 2 {
        return table;
    }
    for of in &report.elements {
        for ((score, found), rho) in report.scores.iter().zip(&of.scores).zip(&of.spearman) {
            table.rows.push(vec![
                text(of.element),
                count(of.atoms as u64),
                real(of.forces.mean, 3),
                real(of.forces.median(), 3),
                name(score),
                real(found.mean, 3),
                percent(found.beyond),
                real(*rho, 3),
            ]);
        }
    }
    table
}

/// By the share of an element in a structure.
pub fn compositions(report: &LabelledReport) -> PageTable {
    let caption = "Errors and γ of structures by the share of an element among their atoms, to the nearest 10 %. Energies \
                   are compared without the offsets of the elements";
    let titles = [
        "element",
        "share (%)",
        "structures",
        "energy MAE (meV/atom)",
        "sampled atoms",
        "mean force error (eV/Å)",
        "mean γ",
        "atoms γ > 1 (%)",
    ];
    let mut table = PageTable::new("composition-errors", caption, &titles);
    for scan in &report.compositions {
        for of in &scan.groups {
            let mean = |errors: Option<ErrorSpread>| errors.map(|errors| errors.mean);
            let gamma = of.scores.first();
            table.rows.push(vec![
                text(scan.element),
                real(100.0 * of.share, 0),
                count(of.structures as u64),
                real(mean(of.energy).map(|error| 1000.0 * error), 2),
                count(of.atoms as u64),
                real(mean(of.forces), 3),
                real(gamma.map(|score| score.mean), 3),
                percent(gamma.and_then(|score| score.beyond)),
            ]);
        }
    }
    table
}
