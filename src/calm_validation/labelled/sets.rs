//! Several sets of labelled structures beside each other (paper, contamination curves and figure of the training-data dependence).

use serde::Serialize;

use super::collect::LARGE_ERROR;
use super::mixtures::ComparedMixture;
use super::report::{LabelledReport, ScoreReport};
use super::score_name::name;
use super::tables::{CONTAMINATION, cells};
use crate::page::{PageTable, count, real, text};

/// The labelled structures of a file, and what they say.
#[derive(Clone, Debug, Serialize)]
pub struct LabelledSet {
    /// The file.
    pub file: String,
    /// The model's errors, and what its scores say about them.
    pub report: LabelledReport,
    /// The same structures under several mixtures, that of the scores first; empty if no other was given.
    pub mixtures: Vec<ComparedMixture>,
    /// The same structures under further models.
    pub models: Vec<ComparedModel>,
}

/// What the grades of another model say about that model's errors.
#[derive(Clone, Debug, Serialize)]
pub struct ComparedModel {
    /// Its file.
    pub model: String,
    /// γ.
    pub grade: ScoreReport,
    /// γ_nbr.
    pub average: ScoreReport,
}

impl ComparedModel {
    /// With the report of the structures under this model; `None` without its scores.
    pub fn new(model: String, report: &LabelledReport) -> Option<Self> {
        let (grade, average) = (report.grade()?.clone(), report.average()?.clone());
        Some(Self { model, grade, average })
    }
}

/// A table with every score of every set, the sets below each other; without rows for a single set.
pub fn table(sets: &[LabelledSet]) -> PageTable {
    let caption = "The sets of labelled structures side by side: means of the absolute errors of energies without the offsets of the elements \
                   and of force components; for each score Spearman’s ρ with the force error, ROC-AUC for errors above 1 eV/Å, the share of \
                   the atoms within its limit, and the share of these with a force error above 0.5 eV/Å";
    let titles = [
        "score",
        "set",
        "structures",
        "atoms",
        "energy MAE (meV/atom)",
        "force MAE (meV/Å)",
        "ρ",
        "interval",
        "AUC > 1 eV/Å",
        "interval",
        "kept (%)",
        "interval",
        "above 0.5 (%)",
        "interval",
    ];
    let mut table = PageTable::new("labelled-sets", caption, &titles);
    let [first, _, ..] = sets else { return table };
    // All sets have the same scores.
    for k in 0..first.report.scores.len() {
        for set in sets {
            let report = &set.report;
            let score = &report.scores[k];
            let kept = score.confident.as_ref();
            let at = |threshold| report.threshold(threshold);
            let contamination = kept.zip(at(CONTAMINATION)).map(|(kept, k)| kept.contamination[k]);
            let milli = |error: Option<f64>| real(error.map(|error| 1000.0 * error), 2);
            let mut row = vec![
                name(score),
                text(&*set.file),
                count(report.structures),
                count(report.atoms),
                milli(report.energy_without_offsets.mean_absolute.value),
                milli(report.forces.mean_absolute.value),
            ];
            row.extend(cells(score.spearman, 1.0, 3));
            row.extend(cells(at(LARGE_ERROR).map(|k| score.auc[k]).unwrap_or_default(), 1.0, 3));
            row.extend(cells(kept.map(|kept| kept.retention).unwrap_or_default(), 100.0, 1));
            row.extend(cells(contamination.unwrap_or_default(), 100.0, 2));
            table.rows.push(row);
        }
    }
    table
}
