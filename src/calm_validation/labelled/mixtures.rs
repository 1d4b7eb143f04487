//! What γ ≤ 1 keeps under several mixtures of one model, against their dimension D and their components K (paper, SI, contamination
//! curves).

use calm::Mixture;
use serde::Serialize;

use super::collect::LARGE_ERROR;
use super::report::{LabelledReport, ScoreReport};
use super::tables::{CONTAMINATION, cells};
use crate::page::{PageTable, count, text};

/// A mixture, and what the same labelled structures say about its grades.
#[derive(Clone, Debug, Serialize)]
pub struct ComparedMixture {
    /// Its file.
    pub artifact: String,
    /// D
    pub dimension: usize,
    /// K of each element.
    pub components: Vec<usize>,
    /// γ and γ_nbr.
    pub scores: Vec<ScoreReport>,
}

impl ComparedMixture {
    /// `report` has the grades under this mixture.
    pub fn new(artifact: String, mixture: &Mixture, report: &LabelledReport) -> Self {
        let elements = 0..mixture.element_count();
        Self {
            artifact,
            dimension: mixture.dimension(),
            components: elements.map(|element| mixture.components(element).map_or(0, <[_]>::len)).collect(),
            scores: report.scores.iter().take(2).cloned().collect(),
        }
    }

    /// The smallest and the largest K.
    pub fn range(&self) -> String {
        let [low, high] =
            [self.components.iter().min(), self.components.iter().max()].map(|k| k.copied().unwrap_or(0));
        if low == high { low.to_string() } else { format!("{low}–{high}") }
    }
}

/// The table of several mixtures. `report` is that of any of them.
pub fn table(mixtures: &[ComparedMixture], report: &LabelledReport) -> PageTable {
    let caption = "Atoms with γ or γ_{nbr} up to 1 under several mixtures, by dimension D and components K of each element: their share of all \
                   atoms, the share of them with a force error above 0.5 eV/Å; Spearman’s ρ and ROC-AUC for errors above 1 eV/Å of all atoms";
    let titles = [
        "artifact",
        "D",
        "K",
        "score",
        "kept (%)",
        "interval",
        "above 0.5 (%)",
        "interval",
        "ρ",
        "interval",
        "AUC > 1 eV/Å",
        "interval",
    ];
    let mut table = PageTable::new("mixtures", caption, &titles);
    let (place, large) = (report.threshold(CONTAMINATION), report.threshold(LARGE_ERROR));
    for mixture in mixtures {
        for score in &mixture.scores {
            let kept = score.confident.as_ref();
            let contamination = kept.zip(place).map(|(kept, k)| kept.contamination[k]).unwrap_or_default();
            let mut row = vec![
                text(&*mixture.artifact),
                count(mixture.dimension as u64),
                text(mixture.range()),
                text(::figures::plain(&score.name)),
            ];
            row.extend(cells(kept.map(|kept| kept.retention).unwrap_or_default(), 100.0, 1));
            row.extend(cells(contamination, 100.0, 2));
            row.extend(cells(score.spearman, 1.0, 3));
            row.extend(cells(large.map(|k| score.auc[k]).unwrap_or_default(), 1.0, 3));
            table.rows.push(row);
        }
    }
    table
}
